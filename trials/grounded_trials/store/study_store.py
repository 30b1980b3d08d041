"""Results of a study's jobs on disk, one small file each: a study that was cut off goes on.

A file is named by the hash of the job's key and holds key and result; one that can't be read, or
that holds another key, counts as not there.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from typing import Any

from grounded.errors import GroundedError
from grounded_trials.store.store import write_atomically


class StudyStore(MutableMapping[str, dict[str, Any]]):
    """Job key -> result, kept in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise GroundedError(f"{folder} can't be made: {error.strerror}") from None

    def _path(self, key: str) -> Path:
        return self.folder / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.json"

    def _read(self, path: Path) -> tuple[str, dict[str, Any]] | None:
        try:
            entry = json.loads(path.read_text(encoding="utf-8"))
            return str(entry["key"]), dict(entry["result"])
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def __getitem__(self, key: str) -> dict[str, Any]:
        entry = self._read(self._path(key))
        if entry is None or entry[0] != key:
            raise KeyError(key)
        return entry[1]

    def __setitem__(self, key: str, value: dict[str, Any]) -> None:
        text = json.dumps({"key": key, "result": value})
        write_atomically(self._path(key), text.encode())

    def __delitem__(self, key: str) -> None:
        self._path(key).unlink()

    def __iter__(self) -> Iterator[str]:
        entries = (self._read(path) for path in sorted(self.folder.glob("*.json")))
        return (entry[0] for entry in entries if entry is not None)

    def __len__(self) -> int:
        return sum(1 for _ in self)
