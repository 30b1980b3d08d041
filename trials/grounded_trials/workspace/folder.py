"""A workspace as it lies on the disk: its task, its trials and its candidates.

    grounded.toml  model.py  target.csv  trials/  candidates/  reports/

All state is derived from these files. Trials are the store's (content-addressed, never rewritten).
Candidates are files c0001.mcap ...; one that got lost is taken from the trial that ran it, which
carries it as an attachment.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grounded.errors import GroundedError, nearest
from grounded.model import Model
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.store.candidate_file import candidate_bytes, read_candidate
from grounded_trials.store.store import Store, Stored, write_atomically
from grounded_trials.store.trial_file import read_trial
from grounded_trials.workspace.config import Config, read_config
from grounded_trials.workspace.model_file import check_names, load_module, model_in
from grounded_trials.workspace.task_file import build_task

if TYPE_CHECKING:
    from grounded.search.planner import Planner

_ID = re.compile(r"c\d{4,}")
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
    "caution": int,
    "way": str,
}
_ABSENT = {"predicted_gain": "nan", "damping": "1.0", "caution": "0", "way": ""}  # in files of 0.1


@dataclass(frozen=True, eq=False)
class StoredTrial:
    """A trial of the store with what its file says of it."""

    stored: Stored
    trial: Trial  # .id is its short name (t0007); short gaps are bridged
    meta: dict[str, str]
    measured: Trial  # as it was logged, gaps and all
    policy: bytes | None  # the file of the candidate that it ran


@dataclass(frozen=True)
class Lost:
    """A file that should be there, or be readable, and why it is not."""

    file: str
    reason: str


@dataclass(frozen=True, eq=False)
class Contents:
    """What a workspace holds, and what was lost of it."""

    trials: tuple[StoredTrial, ...]  # in order of arrival
    candidates: tuple[Candidate, ...]  # the search's for the present task, in order of proposal
    lost: tuple[Lost, ...]


class Folder:
    """The files of a workspace; nothing is read before it is asked for, nothing cached on disk.

    Args:
        folder: the workspace; `read_config` complains when it is none.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.store = Store(self.folder / "trials", prefix="t")
        self.reports = self.folder / "reports"

    @property
    def address(self) -> str | None:
        """The folder as commands name it; None where it is the current one."""
        return None if self.folder == Path() else str(self.folder)

    @cached_property
    def config(self) -> Config:
        """The checked grounded.toml."""
        return read_config(self.folder)

    @cached_property
    def base_model(self) -> Model:
        """The crude model of model.py with [model] params, without adopted effects."""
        table = self.config.model
        model = model_in(load_module(self.folder, table.file, table.module))
        check_names(table.params, list(model.params), "grounded.toml: [model] params: parameter")
        return model.with_values(table.params)

    @cached_property
    def task(self) -> Task:
        """The task with the crude model: it judges trials."""
        return build_task(self.config, self.base_model, self.folder)

    @cached_property
    def planner(self) -> Planner:
        """The task as the search plans it, with all effects that were adopted."""
        from grounded.search.planner import Planner

        if not self.config.model.effects:
            return Planner(self.task, self.task)
        from grounded_trials.workspace.adopted import planner_with

        return planner_with(self.task, self.config.model.effects)

    @cached_property
    def _trials(self) -> tuple[StoredTrial, ...]:
        return tuple(self._read_trials(None))

    def forget(self) -> None:
        """Everything is read again when it is asked for next."""
        for name in ("config", "base_model", "task", "planner", "_trials"):
            vars(self).pop(name, None)

    def forget_trials(self) -> None:
        """Trials are read again when they are asked for next."""
        vars(self).pop("_trials", None)

    def read(self, *, strict: bool = True) -> Contents:
        """The trials, and the search's candidates for the present task.

        Probes and candidates of an earlier task (other target, reward, limits) are left out.

        Args:
            strict: complain about a file that is damaged; else it is left out and named in `lost`.

        Raises:
            GroundedError: if the task can't be built; if strict, also for what is damaged.
        """
        lost: list[Lost] | None = None if strict else []
        trials = self._trials if lost is None else tuple(self._read_trials(lost))
        candidates = tuple(self._read_candidates(trials, lost))
        return Contents(trials, candidates, tuple(lost or ()))

    def trials(self) -> tuple[StoredTrial, ...]:
        """Every stored trial, in order of arrival.

        Raises:
            GroundedError: if one is damaged, naming it.
        """
        return self._trials

    def fits(self, trial: Trial) -> bool:
        """Whether a trial's states and inputs are this model's, and its dt is this task's."""
        names = (self.base_model.state_names, self.base_model.input_names)
        same = (trial.state_names, trial.input_names) == names
        return same and abs(trial.dt - self.config.task.dt) < 1e-9

    def task_trials(self, *, measured: bool = False) -> list[Trial]:
        """The trials that fit this task.

        Args:
            measured: as they were logged; else short gaps are bridged.
        """
        fitting = [t for t in self.trials() if self.fits(t.trial)]
        return [t.measured if measured else t.trial for t in fitting]

    def estimated_states(self) -> tuple[str, ...]:
        """States that some stored trial did not measure: the smoother's, no evidence."""
        found = {n for t in self.trials() for n in t.meta.get("estimated", "").split(",") if n}
        return tuple(name for name in self.base_model.state_names if name in found)

    def candidate_path(self, identity: str) -> Path:
        """candidates/c0001.mcap and so on."""
        return self.folder / "candidates" / f"{identity}.mcap"

    def candidate_ids(self) -> list[str]:
        """Every candidate that was ever proposed, whether its file is there or only its trial."""
        return self._ids(self.trials())

    def next_id(self) -> str:
        """The name of the next candidate."""
        ids = self.candidate_ids()
        return f"c{(int(ids[-1][1:]) if ids else 0) + 1:04d}"

    def candidate(self, identity: str) -> tuple[Candidate, dict[str, str]]:
        """A candidate and its metadata, from its file or from a trial that ran it.

        Raises:
            GroundedError: if neither is there, or the file is damaged.
        """
        return candidate_of(self.candidate_bytes(identity), identity)

    def candidate_bytes(self, identity: str) -> bytes:
        """The candidate's file.

        Raises:
            GroundedError: if there is none of that name.
        """
        for source in self._sources(identity):
            return source
        raise GroundedError(
            f"there is no candidate '{identity}': {nearest(identity, self.candidate_ids())}"
        )

    def save_candidate(self, candidate: Candidate, task: Task, kind: str = "search") -> Path:
        """Writes candidates/cNNNN.mcap, complete or not at all."""
        path = self.candidate_path(candidate.id)
        path.parent.mkdir(parents=True, exist_ok=True)
        values = vars(candidate) | {"task": task.hash}
        meta = {"kind": kind} | {
            name: repr(values[name]) if of is float else str(values[name])
            for name, of in _FIELDS.items()
        }
        data = candidate_bytes(
            candidate.policy,
            candidate.predicted_states,
            candidate.predicted_inputs,
            meta,
            state_units=dict(task.model.states),
            input_units=dict(task.model.inputs),
        )
        write_atomically(path, data)
        return path

    def _read_trials(self, lost: list[Lost] | None) -> Iterator[StoredTrial]:
        """The stored trials; those that are damaged or gone are put into `lost` if it is there."""
        entries = self.store.list()
        for stored in entries:
            try:
                trial, meta, policy = read_trial(self.store.read(stored), stored.path.name)
            except GroundedError as error:
                if lost is None:
                    raise
                lost.append(Lost(stored.path.name, str(error)))
                continue
            logged = replace(trial, id=stored.id)
            yield StoredTrial(stored, interpolate_gaps(logged).trial, meta, logged, policy)
        numbers = {stored.number for stored in entries}
        for number in sorted(set(range(1, max(numbers, default=0))) - numbers):
            if lost is not None:
                name = f"{self.store.prefix}{number:04d}"
                reason = f"trials/ has no file of the number {name}: it was removed"
                lost.append(Lost(name, reason))

    def _read_candidates(
        self, trials: tuple[StoredTrial, ...], lost: list[Lost] | None
    ) -> Iterator[Candidate]:
        """The search's candidates; unless strict, a trial's copy stands in for a damaged file."""
        for identity in self._ids(trials):
            why = GroundedError("its file is gone and no trial carries it")
            for data in self._sources(identity, trials):
                try:
                    candidate, meta = candidate_of(data, identity)
                except GroundedError as error:
                    if lost is None:
                        raise
                    why = error
                    continue
                if meta.get("kind") == "search" and meta.get("task") == self.task.hash:
                    yield candidate
                break
            else:
                if lost is None:
                    raise GroundedError(f"candidates/{identity}.mcap can't be read: {why}")
                lost.append(Lost(f"{identity}.mcap", str(why)))

    def _ids(self, trials: tuple[StoredTrial, ...]) -> list[str]:
        ids = {path.stem for path in (self.folder / "candidates").glob("c*.mcap") if path.is_file()}
        ids |= {t.trial.candidate for t in trials}
        return sorted(filter(_ID.fullmatch, ids), key=lambda name: int(name[1:]))

    def _sources(
        self, identity: str, trials: tuple[StoredTrial, ...] | None = None
    ) -> Iterator[bytes]:
        """The copies of a candidate: its file, then those in the trials that ran it."""
        path = self.candidate_path(identity)
        if path.is_file():
            yield path.read_bytes()
        for one in self.trials() if trials is None else trials:
            if one.trial.candidate == identity and one.policy is not None:
                yield one.policy


def candidate_of(data: bytes, identity: str) -> tuple[Candidate, dict[str, str]]:
    """A candidate and its metadata from the bytes of its file.

    Args:
        data: the file.
        identity: what the file is named, c0001; the candidate must have this id.

    Raises:
        GroundedError: if the file is damaged, rewritten, or another candidate's.
    """
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
