"""What the files of a large workspace hold, in one file, so that not each is read at every command.

trials/.index.sqlite is derived: it may be deleted, and is made again where it is missing, damaged
or of another version. A row stands for a file as it was read and proven; it is believed while the
file has the same size, times and place, and its own checksum fits. Numbers are read when they are
asked for.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from grounded.trial import Trial, interpolate_gaps
from grounded_trials.store.known import KnownTrial, Worth
from grounded_trials.store.store import Stored

KEPT = 2**20  # [bytes] numbers of a longer trial are read from its own file
_VERSION = 3  # of the tables, and of what `_about` says
_TABLES = """
CREATE TABLE files (name TEXT PRIMARY KEY, stamp TEXT, about TEXT, proof BLOB);
CREATE TABLE numbers (name TEXT PRIMARY KEY, states BLOB, inputs BLOB, proof BLOB);
CREATE TABLE worth (name TEXT, task TEXT, utility TEXT, proof BLOB, PRIMARY KEY (name, task));
"""
_KNOWN = ("steps", "finite_steps", "known_steps")

Reader = Callable[[Stored], tuple[Trial, dict[str, str], bytes | None]]


class Index:
    """The index of a workspace's trials and candidates.

    Args:
        folder: where the trials lie, and the index.
        read: reads and proves a trial, `.id` its short name.
    """

    def __init__(self, folder: Path, read: Reader) -> None:
        self._path, self._read = folder / ".index.sqlite", read
        self._rows: dict[str, tuple[str, dict[str, Any]]] = {}
        self._worth: dict[str, dict[str, float]] = {}
        self._file = self._opened()

    def __del__(self) -> None:
        if file := getattr(self, "_file", None):
            file.close()

    def _opened(self) -> sqlite3.Connection:
        """The file; where it can't be used, an empty one in memory."""
        for path in (self._path, self._path, ":memory:"):
            with suppress(sqlite3.Error, OSError):
                file = sqlite3.connect(path, timeout=2.0)
                try:
                    if file.execute("PRAGMA user_version").fetchone()[0] != _VERSION:
                        file.executescript(f"BEGIN;{_TABLES}PRAGMA user_version={_VERSION};COMMIT;")
                    self._load(file)
                    return file
                except sqlite3.Error:
                    file.close()
                    raise
            with suppress(OSError):  # damaged, or of another version
                self._path.unlink(missing_ok=True)
        raise AssertionError("a database in memory can always be made")

    def _load(self, file: sqlite3.Connection) -> None:
        """Takes in the rows that prove themselves; one parse of all texts is the quickest."""
        query = "SELECT name, stamp, about, proof FROM files"
        rows = [row for row in file.execute(query) if _proof(row[1], row[2]) == row[3]]
        abouts = json.loads(f"[{','.join(row[2] for row in rows)}]")
        self._rows = {row[0]: (row[1], about) for row, about in zip(rows, abouts, strict=True)}
        for *row, proof in file.execute("SELECT name, task, utility, proof FROM worth"):
            if _proof(*row) == proof:
                self._worth.setdefault(row[0], {})[row[1]] = float(row[2])
        file.execute("SELECT 1 FROM numbers LIMIT 1")

    def of_trial(self, stored: Stored) -> dict[str, Any]:
        """What is known of a trial: its metadata, names, steps, and the hash of what it ran.

        Raises:
            GroundedError: if the file is damaged.
        """
        name = stored.path.name

        def learn() -> dict[str, Any]:
            trial, meta, policy = self._read(stored)
            self._write("DELETE FROM worth WHERE name = ?", (name,))
            self._worth.pop(name, None)
            if trial.states.nbytes + trial.inputs.nbytes < KEPT:
                blobs = (trial.states.tobytes(), trial.inputs.tobytes())
                numbers = (name, *blobs, _proof(_stamp(stored.path), *blobs))
                self._write("INSERT OR REPLACE INTO numbers VALUES (?, ?, ?, ?)", numbers)
            return _about(trial, meta, policy)

        return self.known(name, stored.path, learn)

    def known(self, name: str, path: Path, learn: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """What was learnt of a file when it was read and proven, as it is now.

        Args:
            name: the file's, which no other file of the workspace has.
            path: where it is.
            learn: reads it, where it is new or has changed.
        """
        stamp, row = _stamp(path), self._rows.get(name)
        if row is not None and row[0] == stamp:
            return row[1]
        about = learn()
        text = json.dumps(about)
        self._rows[name] = stamp, json.loads(text)
        values = (name, stamp, text, _proof(stamp, text))
        self._write("INSERT OR REPLACE INTO files VALUES (?, ?, ?, ?)", values)
        return self._rows[name][1]

    def trial(self, stored: Stored, about: dict[str, Any], *, bridged: bool) -> Trial:
        """A trial whose numbers are read when they are asked for.

        Args:
            stored: its file.
            about: what `of_trial` said.
            bridged: short gaps are interpolated.
        """
        if bridged and about["gaps"]:
            return interpolate_gaps(self._loaded(stored, about)).trial
        return KnownTrial.of(
            lambda: self._loaded(stored, about), about, self._worth_of(stored.path.name)
        )

    def _loaded(self, stored: Stored, about: dict[str, Any]) -> Trial:
        name = stored.path.name
        with suppress(sqlite3.Error):
            query = "SELECT states, inputs, proof FROM numbers WHERE name = ?"
            row = self._file.execute(query, (name,)).fetchone()
            if row is not None and _proof(self._rows[name][0], *row[:2]) == row[2]:
                n, m = len(about["states"]), len(about["inputs"])
                states = np.frombuffer(row[0]).reshape(-1, n)
                return Trial(
                    states=states,
                    inputs=np.frombuffer(row[1]).reshape(-1, m),
                    dt=about["dt"],
                    state_names=tuple(about["states"]),
                    input_names=tuple(about["inputs"]),
                    id=about["id"],
                    candidate=about["candidate"],
                    start_inputs=about["start_inputs"] and np.array(about["start_inputs"]),
                )
        return self._read(stored)[0]

    def _worth_of(self, name: str) -> Worth:
        def worth(task: str, compute: Callable[[], float]) -> float:
            known = self._worth.setdefault(name, {})
            if task not in known:
                known[task] = compute()
                row = (name, task, repr(float(known[task])))
                values = (*row, _proof(*row))
                self._write("INSERT OR REPLACE INTO worth VALUES (?, ?, ?, ?)", values)
            return known[task]

        return worth

    def _write(self, command: str, values: tuple[Any, ...]) -> None:
        with suppress(sqlite3.Error):  # read-only, full, or another process writes: only slower
            self._file.execute(command, values)

    def save(self) -> None:
        """Keeps what was learnt; where that fails it is learnt again."""
        with suppress(sqlite3.Error):
            self._file.commit()


def _about(trial: Trial, meta: dict[str, str], policy: bytes | None) -> dict[str, Any]:
    whole = interpolate_gaps(trial).trial
    held = trial.start_inputs
    finite = bool(np.isfinite(trial.states).all())
    return {
        "print": hashlib.sha256(trial.states.tobytes()).hexdigest() if finite else "",
        "id": trial.id,
        "candidate": trial.candidate,
        "dt": trial.dt,
        "states": trial.state_names,
        "inputs": trial.input_names,
        "start_inputs": None if held is None else held.tolist(),
        "gaps": whole is not trial,
        "ran": "" if policy is None else hashlib.sha256(policy).hexdigest(),
        "meta": meta,
    } | {name: getattr(trial, name) for name in _KNOWN}


def _stamp(path: Path) -> str:
    """What changes with a file: size, times, place."""
    try:
        found = os.stat(path)  # noqa: PTH116 (quicker)
    except OSError:
        return ""
    return f"{found.st_size}-{found.st_mtime_ns}-{found.st_ctime_ns}-{found.st_ino}"


def _proof(*parts: str | bytes) -> bytes:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part if isinstance(part, bytes) else str(part).encode())
    return digest.digest()
