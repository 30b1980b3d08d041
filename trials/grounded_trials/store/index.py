"""An index of a workspace's files, so that commands need not read every file each time.

trials/.index.sqlite is derived data: it may be deleted, and is rebuilt if it is missing, damaged or
of another version. A row describes a file that was read and verified; it is used as long as the
file's size, times and inode are unchanged and the row's own checksum matches. Arrays are read on
first access.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np

from grounded.frozen import Array, readonly
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.store.store import Stored

Worth = Callable[[str, Callable[[], float]], float]


class KnownTrial(Trial):
    """A trial whose arrays are read on first access."""

    @classmethod
    def of(cls, load: Callable[[], Trial], about: dict[str, Any], worth: Worth) -> KnownTrial:
        """Create a trial from its index entry; `load` reads the file, `worth` caches utilities."""
        made = object.__new__(cls)
        held = about["start_inputs"]
        vars(made).update(
            dt=about["dt"],
            state_names=tuple(about["states"]),
            input_names=tuple(about["inputs"]),
            id=about["id"],
            candidate=about["candidate"],
            start_inputs=None if held is None else readonly(held),
            start_states=about["start_states"],
            _known=about,
            _load=load,
            _worth=worth,
        )
        return made

    @cached_property
    def states(self) -> Array:
        """(T + 1, n), read on first access."""
        return cast(Array, vars(self)["_load"]().states)

    @cached_property
    def inputs(self) -> Array:
        """(T, m), read on first access."""
        return cast(Array, vars(self)["_load"]().inputs)

    @property
    def steps(self) -> int:
        """T, without reading the arrays."""
        return self._of("steps")

    @property
    def finite_steps(self) -> int:
        """As `Trial.finite_steps`, without reading the arrays."""
        return self._of("finite_steps")

    @property
    def known_steps(self) -> int:
        """As `Trial.known_steps`, without reading the arrays."""
        return self._of("known_steps")

    def _of(self, name: str) -> int:
        known = vars(self).get("_known")  # a changed copy has none
        return int(known[name] if known else getattr(Trial, name).fget(self))

    def repeats(self, other: Trial) -> bool:
        """As `Trial.repeats`, by comparing the hashes of the states where they are known."""
        mine, its = (vars(one).get("_known", {}).get("print") for one in (self, other))
        return bool(mine == its) if mine and its else super().repeats(other)

    def worth(self, task: str, compute: Callable[[], float]) -> float:
        """Return the utility in a task, computed once."""
        worth = vars(self).get("_worth")
        return compute() if worth is None else worth(task, compute)


class KnownCandidate(Candidate):
    """A candidate whose policy and prediction are read on first access."""

    @classmethod
    def of(cls, load: Callable[[], Candidate], about: dict[str, Any]) -> KnownCandidate:
        """Create a candidate whose fields, except for the arrays, are in `about`."""
        made = object.__new__(cls)
        vars(made).update(about, _load=load)
        return made

    @cached_property
    def _read(self) -> Candidate:
        return cast(Candidate, vars(self)["_load"]())

    @cached_property
    def policy(self) -> Policy:
        """What the robot runs, read on first access."""
        return self._read.policy

    @cached_property
    def predicted_states(self) -> Array:
        """(H + 1, n), read on first access."""
        return self._read.predicted_states

    @cached_property
    def predicted_inputs(self) -> Array:
        """(H, m), read on first access."""
        return self._read.predicted_inputs


KEPT_BYTES = 2**20  # [bytes] arrays of larger trials are not kept in the index
_VERSION = 5  # of the tables and of the result of `_about`
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
        folder: the folder of the trials and of the index.
        read: reads and verifies a trial; sets its `id` to its short name.
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
        """Open the index; if it can't be used, return an empty one in memory."""
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
            with suppress(OSError):  # it is damaged, or of another version
                self._path.unlink(missing_ok=True)
        raise AssertionError("a database in memory can always be made")

    def _load(self, file: sqlite3.Connection) -> None:
        """Load the rows whose checksums match; parsing all texts at once is the fastest."""
        query = "SELECT name, stamp, about, proof FROM files"
        rows = [row for row in file.execute(query) if _proof(row[1], row[2]) == row[3]]
        abouts = json.loads(f"[{','.join(row[2] for row in rows)}]")
        self._rows = {row[0]: (row[1], about) for row, about in zip(rows, abouts, strict=True)}
        for *row, proof in file.execute("SELECT name, task, utility, proof FROM worth"):
            if _proof(*row) == proof:
                self._worth.setdefault(row[0], {})[row[1]] = float(row[2])
        file.execute("SELECT 1 FROM numbers LIMIT 1")

    def of_trial(self, stored: Stored) -> dict[str, Any]:
        """Return a trial's metadata, names, steps, and the hash of the policy that it ran.

        Raises:
            GroundedError: if the file is damaged.
        """
        name = stored.path.name

        def learn() -> dict[str, Any]:
            trial, meta, policy = self._read(stored)
            self._write("DELETE FROM worth WHERE name = ?", (name,))
            self._worth.pop(name, None)
            if trial.states.nbytes + trial.inputs.nbytes < KEPT_BYTES:
                blobs = (trial.states.tobytes(), trial.inputs.tobytes())
                numbers = (name, *blobs, _proof(_stamp(stored.path), *blobs))
                self._write("INSERT OR REPLACE INTO numbers VALUES (?, ?, ?, ?)", numbers)
            return _about(trial, meta, policy)

        return self.known(name, stored.path, learn)

    def known(self, name: str, path: Path, learn: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return the entry of a file; reads the file if it is new or has changed.

        Args:
            name: the file's name, unique in the workspace.
            path: its path.
            learn: reads and verifies the file, and returns its entry.
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
        """Return a trial whose arrays are read on first access.

        Args:
            stored: its file.
            about: its entry, from `of_trial`.
            bridged: interpolate short gaps; a trial that has gaps is then read at once.
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
                    start_states=about["start_states"],
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
        with suppress(sqlite3.Error):  # read-only, disk full or locked: the next command is slower
            self._file.execute(command, values)

    def save(self) -> None:
        """Commit new entries; if that fails, their files are read again by the next command."""
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
        "start_states": dict(trial.start_states),
        "gaps": whole is not trial,
        "ran": "" if policy is None else hashlib.sha256(policy).hexdigest(),
        "meta": meta,
    } | {name: getattr(trial, name) for name in _KNOWN}


def _stamp(path: Path) -> str:
    """Return a file's size, times and inode as text, "" if it does not exist."""
    try:
        found = os.stat(path)  # noqa: PTH116 (faster)
    except OSError:
        return ""
    return f"{found.st_size}-{found.st_mtime_ns}-{found.st_ctime_ns}-{found.st_ino}"


def _proof(*parts: str | bytes) -> bytes:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part if isinstance(part, bytes) else str(part).encode())
    return digest.digest()
