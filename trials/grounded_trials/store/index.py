"""An index of a workspace's files, so that commands need not read every file each time.

trials/.index.json is derived data: a document that may be deleted, and is rebuilt if it is missing,
damaged or of another version. It holds what was found out about files that were read and verified,
which is used as long as a file's size, times and inode are unchanged. Arrays are read on first
access.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import Any, Self, cast

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array, readonly
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.store.documents import read_document, write_document

Worth = Callable[[str, Callable[[], float]], float]
ARRAYS = ("policy", "predicted_states", "predicted_inputs")  # of a candidate
VERSION = 6  # of the result of `about_trial`


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
        return self._read.states

    @cached_property
    def inputs(self) -> Array:
        """(T, m), read on first access."""
        return self._read.inputs

    @cached_property
    def _read(self) -> Trial:
        return cast(Trial, vars(self)["_load"]())

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


def about_trial(trial: Trial, meta: dict[str, str], policy: bytes | None) -> dict[str, Any]:
    """Return what an index keeps of a trial: all but its arrays."""
    held, finite = trial.start_inputs, bool(np.isfinite(trial.states).all())
    return {
        "print": hashlib.sha256(trial.states.tobytes()).hexdigest() if finite else "",
        "id": trial.id,
        "candidate": trial.candidate,
        "dt": trial.dt,
        "states": trial.state_names,
        "inputs": trial.input_names,
        "start_inputs": None if held is None else held.tolist(),
        "start_states": dict(trial.start_states),
        "gaps": interpolate_gaps(trial).trial is not trial,
        "ran": "" if policy is None else hashlib.sha256(policy).hexdigest(),
        "meta": meta,
    } | {name: getattr(trial, name) for name in ("steps", "finite_steps", "known_steps")}


class KnownCandidate(Candidate):
    """A candidate whose policy and prediction are read on first access."""

    @classmethod
    def of(cls, load: Callable[[], Candidate], about: dict[str, Any]) -> Self:
        """Create a candidate whose fields, except for the arrays, are in `about`."""
        made = object.__new__(cls)
        vars(made).update(about, seen=tuple(about["seen"]), _load=load)
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


class Index:
    """What was found out about the files of a workspace.

    Args:
        folder: the folder of the trials and of the index.
    """

    def __init__(self, folder: Path) -> None:
        self._path, self._changed = folder / ".index.json", False
        self._rows: dict[str, list[Any]] = {}  # stamp and what was found out, by name
        with suppress(OSError, ValueError, RecursionError, GroundedError):
            document = read_document(self._path)
            if document["version"] == VERSION:
                self._rows = document["rows"]

    def known(self, name: str, path: Path, learn: Callable[[], Any]) -> Any:
        """Return what is known of a file; reads the file if it is new or has changed.

        Args:
            name: what is asked of it, unique in the workspace: the file's name, or longer.
            path: its path.
            learn: reads and verifies the file, and returns a JSON value.
        """
        stamp, row = _stamp(path), self._rows.get(name)
        if row is None or row[0] != stamp:
            row = self._rows[name] = [stamp, json.loads(json.dumps(learn()))]
            self._changed = True
        return row[1]

    def trial(
        self, path: Path, read: Callable[[], tuple[Trial, dict[str, str], bytes | None]]
    ) -> tuple[Trial, Trial, dict[str, Any]]:
        """Return a trial with short gaps bridged, the one as logged, and `about_trial`.

        Args:
            path: its file.
            read: reads and verifies the file.
        """
        about = self.known(path.name, path, lambda: about_trial(*read()))

        def worth(task: str, compute: Callable[[], float]) -> float:
            return float(self.known(f"{path.name} {task}", path, compute))

        measured = KnownTrial.of(lambda: read()[0], about, worth)
        return (interpolate_gaps(read()[0]).trial if about["gaps"] else measured), measured, about

    def candidate(
        self, path: Path, read: Callable[[], tuple[Candidate, dict[str, str]]]
    ) -> tuple[Candidate, dict[str, str]]:
        """Return a candidate, and what else is known of its file.

        Args:
            path: its file.
            read: reads and verifies the file.
        """

        def learn() -> dict[str, Any]:
            made, about = read()
            names = (one.name for one in fields(Candidate) if one.name not in ARRAYS)
            return {"own": {name: getattr(made, name) for name in names}} | about

        known = dict(self.known(path.name, path, learn))
        return KnownCandidate.of(lambda: read()[0], known.pop("own")), known

    def save(self) -> None:
        """Write new entries; if that fails, their files are read again by the next command."""
        if self._changed:
            rows, self._changed = {"version": VERSION, "rows": self._rows}, False
            with suppress(GroundedError):
                write_document(self._path, rows, nan=True, indent=None)


def _stamp(path: Path) -> str:
    """Return a file's size, times and inode as text, "" if it does not exist."""
    try:
        found = os.stat(path)  # noqa: PTH116 (faster)
    except OSError:
        return ""
    return f"{found.st_size}-{found.st_mtime_ns}-{found.st_ctime_ns}-{found.st_ino}"
