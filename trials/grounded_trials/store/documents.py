"""JSON files: documents with a checksum, notes on trials.

A document's file begins with the SHA-256 of all bytes that follow, so that a flipped bit is
detected:

    {
     "sha256": "3f9a...",
     "verdict": ...

A note records a user's decision, or a file that was handed out. Notes are files of the store,
numbered and named by their hashes, never rewritten or deleted. A later note overrides an earlier
one, and copying the folder copies the notes.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from grounded.checks import refused
from grounded.errors import GroundedError
from grounded.result import MALFORMED, Document
from grounded_trials.plain_file import open_file, unreadable
from grounded_trials.store.store import Lost, Store, write_atomically

D = TypeVar("D", bound=Document)
_SEALED = re.compile(rb'\{\n "sha256": "([0-9a-f]{64})",(\n.*)', re.DOTALL)


def write_document(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON document with its checksum, atomically."""
    text = json.dumps(dict(document), indent=1, ensure_ascii=False, allow_nan=False)
    rest = text[1:].encode() + b"\n"
    digest = hashlib.sha256(rest).hexdigest()
    write_atomically(path, b'{\n "sha256": "' + digest.encode() + b'",' + rest)


def read_document(path: Path) -> dict[str, Any]:
    """Read a document without its checksum; a missing file is a FileNotFoundError."""
    try:
        with open_file(path, follow=False) as stream:
            data = stream.read()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise unreadable(path, error) from None
    found = _SEALED.fullmatch(data)
    if found is None:
        raise refused("file.changed", path, what="none")
    if hashlib.sha256(found[2]).hexdigest() != found[1].decode():
        raise refused("file.changed", path, what="checksum")
    document: dict[str, Any] = json.loads(b"{" + found[2])
    return document


def read_as(path: Path, kind: type[D], **facts: Any) -> D | None:
    """Read a document as a type; None if there is no such file; `facts` see `unreadable`."""
    try:
        return kind.from_json(read_document(path))
    except FileNotFoundError:
        return None
    except (*MALFORMED, GroundedError) as error:
        raise unreadable(path, error, **facts) from None


class Notes:
    """Notes on trials and candidates, stored as n0001-<hash>.json beside the trials."""

    def __init__(self, folder: Path) -> None:
        self.store = Store(folder, prefix="n")

    def add(self, note: Mapping[str, str], *, again: bool = True) -> None:
        """Add a note; an equal one is not repeated unless `again`."""
        with self.adding(note, again=again):
            pass

    @contextmanager
    def adding(self, note: Mapping[str, str], *, again: bool = False) -> Iterator[None]:
        """Add a note as `add` does; removed if the `with` body raises."""
        text = json.dumps(dict(note), sort_keys=True)
        with self.store.adding(text.encode(), ".json", again=again):
            yield

    def read(self, lost: list[Lost] | None = None) -> Iterator[dict[str, str]]:
        """Yield all notes in order of creation; damaged ones are added to `lost`, else raised."""
        for entry in self.store.list():
            try:
                note: dict[str, str] = json.loads(self.store.read(entry))
            except GroundedError as error:
                if lost is None:
                    raise
                lost.append(Lost(str(entry.path), str(error)))
                continue
            yield note
