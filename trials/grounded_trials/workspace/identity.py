"""Names of candidates and trials: candidate files, and the notes stored beside the trials.

A policy is identified by the bytes of its file. Notes record the hashes of the files that were
handed out under each name, so that rewritten files are found even with a valid checksum; they also
record which trials were set aside.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from grounded.checks import list_of, refused, wrong
from grounded.errors import GroundedError, NextCommand
from grounded.findings import found
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.formats.mcap_walk import DamagedFile
from grounded_trials.plain_file import unreadable
from grounded_trials.store.candidate_file import encoded_candidate, read_candidate
from grounded_trials.store.store import Lost, Store, Stored
from grounded_trials.wording import ranges

if TYPE_CHECKING:
    from grounded_trials.workspace.folder import Folder

# keys of a log's metadata
ROWS = "rows_s"  # time between rows of a table that repeats commands
INTERPOLATED = "interpolated_s"  # by which responses may begin early between samples
ESTIMATED_WITH = "estimated_with"  # adopted effects of the model that estimated its speeds
READ_BY = "read_by"  # how [log] read its signals
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
    "sample_age": float,
    "seen": lambda text: tuple(filter(None, text.split(","))),
}
# of files of earlier versions
_ABSENT = dict.fromkeys(("way", "slopes", "seen"), "") | {"predicted_gain": "nan", "damping": "1.0"}
_ABSENT |= dict.fromkeys(("caution", "sample_age"), "0.0")


@dataclass(frozen=True, eq=False)
class StoredTrial:
    """A trial of the store, with its metadata and the candidate it ran."""

    stored: Stored
    trial: Trial  # .id is its short name (t0007); short gaps are bridged
    meta: dict[str, str]
    measured: Trial  # as logged, with its gaps
    policy: bytes | None  # the contents of the candidate file that it ran

    @cached_property
    def ran(self) -> str:
        """SHA-256 of the candidate file that it contains, "" for none."""
        return sha256(self.policy) if self.policy else ""

    def within(self, group: str) -> Self:
        """Return it with the condition that it was run in."""
        trial, measured = (replace(each, group=group) for each in (self.trial, self.measured))
        return replace(self, trial=trial, measured=measured) if group else self


@dataclass(frozen=True, eq=False)
class Noted:
    """The contents of a folder's notes; trials are named by hash, or by file if copies exist."""

    aside: dict[str, str] = field(default_factory=dict)  # discarded trial -> reason
    kept: set[str] = field(default_factory=set)  # trials that were discarded and restored
    handed: dict[str, set[str]] = field(default_factory=dict)  # candidate -> SHA-256 of its files
    last: set[str] = field(default_factory=set)  # the last trial file at each hand-out, or ""
    asked: dict[str, str] = field(default_factory=dict)  # trial to be discarded -> the finding
    groups: dict[str, str] = field(default_factory=dict)  # trial -> the condition it was run in

    def why_aside(self, stored: Stored) -> str | None:
        """Return why a trial is set aside, or None if it is not."""
        return self.aside.get(stored.path.stem, self.aside.get(stored.digest))

    def gone(self, store: Store) -> Iterator[Lost]:
        """Yield the trials that were stored but are missing now."""
        numbers, lost = set[int](), self.last - {""}
        for stored in store.list():
            numbers.add(stored.number)
            lost.discard(stored.path.stem)
        gaps = set(range(1, max(numbers, default=0))) - numbers
        if not (gaps or lost):
            return
        names = {name.split("-")[0] for name in lost}
        names |= {f"{store.prefix}{number:04d}" for number in gaps}
        for name in sorted(names):
            reason = f"trials/ has no file with the number {name}: it was removed"
            yield Lost(str(store.folder / name), reason)


def noted(notes: Iterable[Mapping[str, str]]) -> Noted:
    """Combine notes; later ones override earlier ones."""
    found = Noted()
    for note in notes:
        kind = note["note"]
        if kind == "discard":
            found.aside[note["trial"]] = note["why"]
        elif kind == "restore":
            found.aside.pop(note["trial"], None)
            found.kept.add(note["trial"])
        elif kind == "hand-out":
            found.handed.setdefault(note["candidate"], set()).add(note["sha256"])
            found.last.add(note["after"])
        elif kind == "asked" and "finding" in note:
            found.asked[note["trial"]] = note["finding"]
        elif kind == "group":
            found.groups[note["trial"]] = note["group"]
    return found


_DECODED: dict[tuple[str, str], tuple[Candidate, dict[str, str]]] = {}  # by hash


def sha256(data: bytes) -> str:
    """Return the hash that identifies a candidate's file."""
    return hashlib.sha256(data).hexdigest()


def encoded(candidate: Candidate, task: Task, kind: str) -> bytes:
    """Encode a candidate as the bytes of its file; `kind` is "search" or "probe".

    `candidate_of` knows these bytes from then on: the process that wrote a file need not decode it.
    """
    values = vars(candidate) | {"task": task.hash, "seen": ",".join(candidate.seen)}
    meta = {"kind": kind} | {
        name: repr(float(values[name])) if of is float else str(values[name])
        for name, of in _FIELDS.items()
    }
    data, table = encoded_candidate(
        candidate.policy,
        candidate.predicted_states,
        candidate.predicted_inputs,
        meta,
        state_units=dict(task.model.states),
        input_units=dict(task.model.inputs),
    )
    _DECODED[sha256(data), candidate.id] = candidate, table
    return data


def candidate_of(data: bytes, identity: str) -> tuple[Candidate, dict[str, str]]:
    """Decode a candidate and its metadata from the bytes of its file."""
    key = sha256(data), identity
    if key not in _DECODED:
        _DECODED[key] = _decoded(data, identity)
    candidate, meta = _DECODED[key]
    return candidate, dict(meta)


def _decoded(data: bytes, identity: str) -> tuple[Candidate, dict[str, str]]:
    name = f"candidates/{identity}.mcap"
    try:
        policy, states, inputs, meta = read_candidate(data, name)
    except DamagedFile as error:
        raise unreadable(name, error, mend="candidate", then=NextCommand("propose")) from None
    try:
        about, known = dict[str, Any](), _ABSENT | meta
        for key, of in _FIELDS.items():
            if key != "task":
                about[key] = of(known[key])
    except (KeyError, ValueError) as error:
        raise unreadable(name, error, mend="candidate", then=NextCommand("propose")) from None
    if about["id"] != identity:
        raise refused("file.changed", name, what="name", lost=about["id"][:40])
    about["units"] = json.loads(meta["states"]) | json.loads(meta["inputs"])
    return Candidate(policy=policy, predicted_states=states, predicted_inputs=inputs, **about), meta


def other_task(task: Task, made: Candidate) -> str:
    """Return in what a task differs from that of a candidate, as far as the candidate shows it."""
    policy, model = made.policy, task.model
    if (policy.state_names, policy.input_names) != (model.state_names, model.input_names):
        return "another model"
    own, now = np.stack([policy.low, policy.high], axis=1), np.stack([task.low, task.high], axis=1)
    told = [
        f"limits of {name}: [{low:g}, {high:g}] then"
        for j, (name, (low, high)) in enumerate(zip(model.input_names, own, strict=True))
        if not np.allclose(own[j], now[j])
    ]
    if policy.horizon != task.horizon:
        told.append(f"a horizon of {policy.horizon} steps then")
    if not np.allclose(made.predicted_states[0], task.start):
        told.append("another start then")
    return "; ".join(told) or "another target, reward or feedback"


def unsure_times(stored: Iterable[StoredTrial], trials: Collection[str]) -> tuple[float, float]:
    """Return the largest `row_s` and `interpolated_s` of the logs of some trials, see `Gridded`."""
    logs = [one.meta for one in stored if one.stored.id in trials]
    rows, early = ([float(meta.get(key, 0.0)) for meta in logs] for key in (ROWS, INTERPOLATED))
    return max(rows, default=0.0), max(early, default=0.0)


def unknown_trial(workspace: Folder, name: str) -> GroundedError:
    """Return the error for a name that is no stored trial, or that of one that is set aside."""
    given, aside = name.lower(), workspace.discarded()
    if given in aside:
        then = NextCommand("restore", (given,))
        return GroundedError(found("search.aside", given, then=then, why=aside[given]))
    return _unknown(name, "trial", [one.id for one in workspace.store.list()])


def unknown_candidate(workspace: Folder, name: str) -> GroundedError:
    """Return the error for a name that is no candidate."""
    return _unknown(name, "candidate", workspace.candidate_ids())


def _unknown(name: str, kind: str, known: Sequence[str]) -> GroundedError:
    meant = f"{kind[0]}{name.lstrip('ctCT').zfill(4)}"  # t2, T0002 or 2
    there = {"meant": meant} if meant in known else {"known": ranges(known) or "none yet"}
    return refused("search.unknown", name, kind=kind, **there)


def named_trials(workspace: Folder, names: Sequence[str], usable: Sequence[str]) -> tuple[str, ...]:
    """Return the trials that fit and diagnose are to use, in lower case; empty: all usable ones."""
    if isinstance(names, str):
        raise wrong("trials", names, must="names", like=f"['{names}']")
    given = list_of(names, str, "trials")
    aside = [*workspace.discarded()]
    if not usable:
        then = NextCommand("restore", (aside[-1],)) if aside else None
        raise refused("search.no_trial", *aside, then=then)
    for name in given:
        if (low := name.lower()) not in usable:
            if low in {one.id for one in workspace.store.list()}.difference(aside):
                facts = {"unusable": True, "known": ranges(usable)}
                raise refused("search.unknown", low, kind="trial", **facts)
            raise unknown_trial(workspace, name)
    return tuple(name.lower() for name in given)
