"""What a name stands for: candidates as files, and what the notes of a folder say of them.

A policy is known by the bytes of its file. The notes beside the trials say which bytes were handed
out under a name, so that a file that was written again is found whatever its checksum; and which
trials were set aside. Where two folders were joined and two policies are called c0002, the trials
of the second are data, called c0002~3f9a0c2d after the hash of what they ran.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grounded.errors import GroundedError
from grounded.result import Result
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.store.candidate_file import candidate_bytes, read_candidate
from grounded_trials.store.store import Damaged, Store, Stored

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from grounded_trials.workspace.folder import Folder

ROWS = "rows_s"  # of a log's metadata: the time between a table's rows that repeat a command
ESTIMATED_WITH = "estimated_with"  # likewise: adopted effects of the model that found its speeds
LASTED = "source_seconds"  # likewise: how long the log is
READ_BY = "read_by"  # likewise: the keys of [log] that changed its signals
# a candidate's metadata, in the order of the file
_FIELDS: Mapping[str, Callable[[str], Any]] = {
    "id": str,
    "iteration": int,
    "alpha": float,
    "base": str,
    "model": str,
    "task": str,
    "predicted_utility": float,
    "predicted_gain": float,
    "damping": float,
    "caution": float,
    "way": str,
    "slopes": str,
    "base_as_run": float,
    "likely_off": float,
}
_ABSENT = {
    "predicted_gain": "nan",
    "damping": "1.0",
    "caution": "0",
    "way": "",
    "slopes": "",
    "base_as_run": "nan",
    "likely_off": "0.0",
}


@dataclass(frozen=True, eq=False)
class StoredTrial:
    """A trial of the store with what its file says of it."""

    stored: Stored
    trial: Trial  # .id is its short name (t0007); short gaps are bridged
    meta: dict[str, str]
    measured: Trial  # as it was logged, gaps and all
    ran: str  # SHA-256 of the candidate's file that it carries, "" for none
    policy_of: Callable[[], bytes | None]

    @property
    def policy(self) -> bytes | None:
        """The file of the candidate that it ran."""
        return self.policy_of() if self.ran else None


@dataclass(frozen=True, eq=False)
class StoredCandidate:
    """A candidate with what its file says of it."""

    candidate: Candidate
    kind: str  # search or probe
    task: str  # the hash of its task
    sha256: str  # of its file

    def about(self) -> dict[str, Any]:
        """All but the numbers, for an index."""
        fields = {key: getattr(self.candidate, key) for key in _FIELDS if key != "task"}
        return {"kind": self.kind, "task": self.task, "sha256": self.sha256, "candidate": fields}

    @classmethod
    def known(cls, about: dict[str, Any], load: Callable[[], Candidate]) -> StoredCandidate:
        """The same from what `about` said; `load` reads the numbers when they are asked for."""
        from grounded_trials.store.known import KnownCandidate

        fields = KnownCandidate.of(load, about["candidate"])
        return cls(fields, about["kind"], about["task"], about["sha256"])


@dataclass(frozen=True, eq=False)
class Noted:
    """What the notes of a folder say; trials are named by their hashes, copies by their files."""

    aside: dict[str, str] = field(default_factory=dict)  # discarded and not restored -> why
    handed: dict[str, set[str]] = field(default_factory=dict)  # candidate -> SHA-256 of its files
    ran: dict[str, str] = field(default_factory=dict)  # trials without a policy -> its SHA-256
    last: set[str] = field(default_factory=set)  # the last file of a trial at each hand-out, or ""

    def why_aside(self, stored: Stored) -> str | None:
        """Why a trial is set aside; None where it isn't."""
        return self.aside.get(stored.path.stem, self.aside.get(stored.digest))

    def gone(self, store: Store) -> Iterator[Damaged]:
        """Trials that were stored, and are not there any more."""
        entries = store.list()
        numbers = {stored.number for stored in entries}
        gaps = set(range(1, max(numbers, default=0))) - numbers
        lost = self.last - {stored.path.stem for stored in entries} - {""}
        names = {name.split("-")[0] for name in lost}
        names |= {f"{store.prefix}{number:04d}" for number in gaps}
        for name in sorted(names):
            reason = f"trials/ has no file of the number {name}: it was removed"
            yield Damaged(store.folder / name, reason)


def noted(notes: Iterable[Mapping[str, str]]) -> Noted:
    """What notes say, taken together: the later one holds."""
    found = Noted()
    for note in notes:
        kind = note["note"]
        if kind == "discard":
            found.aside[note["trial"]] = note["why"]
        elif kind == "restore":
            found.aside.pop(note["trial"], None)
        elif kind == "hand-out":
            found.handed.setdefault(note["candidate"], set()).add(note["sha256"])
            found.last.add(note["after"])
        elif kind == "run":
            found.ran[note["trial"]] = note["sha256"]
    return found


@dataclass(frozen=True, repr=False)
class SetAside(Result):
    """What `discard` and `restore` answer: the trials that were named, and all that are aside."""

    trials: tuple[str, ...]
    discarded: dict[str, str]  # t0004 -> why

    def summary(self) -> str:
        """All that are set aside."""
        return f"set aside: {', '.join(self.discarded) or 'none'}"

    def to_json(self) -> dict[str, Any]:
        """The document of `discard --json` and of `restore --json`."""
        return {"trials": list(self.trials), "discarded": self.discarded}


def set_aside(workspace: Folder, note: str, trials: Sequence[str], why: str) -> SetAside:
    """Notes that trials were discarded, or restored: see `Workspace.discard`."""
    found = [workspace.store.find(name.lower()) for name in trials]
    digests = [stored.digest for stored in workspace.store.list()]
    for one in found:
        if (workspace.noted.why_aside(one) is None) == (note == "discard"):
            copied = digests.count(one.digest) > 1 and one.digest not in workspace.noted.aside
            trial = one.path.stem if copied else one.digest
            workspace.notes.add({"note": note, "trial": trial, "why": why})
    workspace.forget_trials()
    return SetAside(tuple(one.id for one in found), workspace.discarded())


@lru_cache(maxsize=4)
def sha256(data: bytes) -> str:
    """The hash that names a candidate's file."""
    return hashlib.sha256(data).hexdigest()


def named_apart(
    trials: Sequence[StoredTrial], known: Noted, path_of: Callable[[str], Path]
) -> tuple[StoredTrial, ...]:
    """Trials of another policy of the same name get a name of their own.

    The policy of a name is that of its file if that was run or handed out, else the first that ran.

    Args:
        trials: as their files name them.
        known: what the notes say.
        path_of: the file of a candidate's name.
    """
    prints = [one.ran or known.ran.get(one.stored.digest, "") for one in trials]
    policies: dict[str, list[str]] = {}
    for one, ran in zip(trials, prints, strict=True):
        if one.trial.candidate and ran:
            policies.setdefault(one.trial.candidate, []).append(ran)
    own = {}
    for name, several in policies.items():
        path = path_of(name)
        file = sha256(path.read_bytes()) if len({*several}) > 1 and path.is_file() else ""
        own[name] = file if file in {*several, *known.handed.get(name, ())} else several[0]
    found = []
    for one, ran in zip(trials, prints, strict=True):
        if ran != own.get(one.trial.candidate, ran) and ran:
            other = f"{one.trial.candidate}~{ran[:8]}"
            trial, measured = (replace(t, candidate=other) for t in (one.trial, one.measured))
            found.append(replace(one, trial=trial, measured=measured))
        else:
            found.append(one)
    return tuple(found)


def encoded(candidate: Candidate, task: Task, kind: str) -> bytes:
    """A candidate's file, kind search or probe."""
    values = vars(candidate) | {"task": task.hash}
    meta = {"kind": kind} | {
        name: repr(values[name]) if of is float else str(values[name])
        for name, of in _FIELDS.items()
    }
    return candidate_bytes(
        candidate.policy,
        candidate.predicted_states,
        candidate.predicted_inputs,
        meta,
        state_units=dict(task.model.states),
        input_units=dict(task.model.inputs),
    )


def candidate_of(data: bytes, identity: str) -> tuple[Candidate, dict[str, str]]:
    """A candidate and its metadata from the bytes of its file.

    Args:
        data: the file.
        identity: what the file is named, c0001; the candidate must have this id.

    Raises:
        GroundedError: if the file is damaged, rewritten, or another candidate's.
    """
    candidate, meta = _proven(data, identity)
    return candidate, dict(meta)


@lru_cache(maxsize=4)
def _proven(data: bytes, identity: str) -> tuple[Candidate, dict[str, str]]:
    """The same, kept: one command meets the bytes of a candidate up to three times."""
    name = f"candidates/{identity}.mcap"
    policy, states, inputs, meta = read_candidate(data, name)
    try:
        about = {key: of((_ABSENT | meta)[key]) for key, of in _FIELDS.items() if key != "task"}
    except (KeyError, ValueError) as error:
        raise GroundedError(
            f"{name}: its metadata lacks or garbles {error}; it was not written by `propose`"
        ) from None
    if about["id"] != identity:
        raise GroundedError(
            f"{name} holds the candidate '{about['id'][:40]}': a file has the name of its "
            "candidate. Give it its own name again, or delete it if that one is there"
        )
    return Candidate(policy=policy, predicted_states=states, predicted_inputs=inputs, **about), meta


def stored_candidate(data: bytes, identity: str) -> StoredCandidate:
    """As `candidate_of`, with the kind, the task and the hash of the file."""
    candidate, meta = candidate_of(data, identity)
    return StoredCandidate(candidate, meta.get("kind", ""), meta.get("task", ""), sha256(data))
