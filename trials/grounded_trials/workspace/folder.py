"""Workspace: a folder with a task, its trials and its candidates; all state is derived from them.

    grounded.toml  model.py  target.csv  trials/  candidates/  reports/

Trials are the store's (content-addressed, never rewritten). Candidates are files c0001.mcap ...;
one that got lost is taken from the trial that ran it, which carries it as an attachment.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from grounded.errors import GroundedError, nearest
from grounded.model import Model
from grounded.search.standing import Candidate
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


@dataclass(frozen=True, eq=False)
class StoredTrial:
    """A trial of the store with what its file says of it."""

    stored: Stored
    trial: Trial  # .id is its short name (t0007); short gaps are bridged
    meta: dict[str, str]
    measured: Trial  # as it was logged, gaps and all

    @property
    def is_data(self) -> bool:
        """A log that ran no candidate: for fitting and diagnosis only."""
        return not self.trial.candidate


class Workspace:
    """A folder; nothing is read before it is asked for, and nothing is cached on disk.

    Args:
        folder: the workspace; `read_config` complains when it is none.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.store = Store(self.folder / "trials", prefix="t")
        self.reports = self.folder / "reports"

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

    def candidate_path(self, identity: str) -> Path:
        """candidates/c0001.mcap and so on."""
        return self.folder / "candidates" / f"{identity}.mcap"

    def candidate_ids(self) -> list[str]:
        """Every candidate that was ever proposed, whether its file is there or only its trial."""
        ids = {path.stem for path in (self.folder / "candidates").glob("c*.mcap") if path.is_file()}
        ids |= {t.trial.candidate for t in self.trials()}
        return sorted(filter(_ID.fullmatch, ids), key=lambda name: int(name[1:]))

    def save_candidate(self, candidate: Candidate, task: Task, kind: str = "search") -> Path:
        """Writes candidates/cNNNN.mcap, complete or not at all."""
        path = self.candidate_path(candidate.id)
        path.parent.mkdir(parents=True, exist_ok=True)
        meta = {
            "kind": kind,
            "id": candidate.id,
            "iteration": str(candidate.iteration),
            "alpha": repr(candidate.alpha),
            "base": candidate.base,
            "model": candidate.model,
            "task": task.hash,
            "predicted_utility": repr(candidate.predicted_utility),
            "predicted_gain": repr(candidate.predicted_gain),
            "damping": repr(candidate.damping),
            "caution": str(candidate.caution),
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

    def candidate(self, identity: str) -> tuple[Candidate, dict[str, str]]:
        """A candidate and its metadata, from its file or from a trial that ran it.

        Raises:
            GroundedError: if neither is there, or the file is damaged.
        """
        return candidate_of(self.candidate_bytes(identity), f"candidates/{identity}.mcap")

    def candidate_bytes(self, identity: str) -> bytes:
        """The candidate's file.

        Raises:
            GroundedError: if there is none of that name.
        """
        path = self.candidate_path(identity)
        if path.is_file():
            return path.read_bytes()
        for stored in self.store.list():
            trial, _, policy = read_trial(self.store.read(stored), stored.path.name)
            if trial.candidate == identity and policy is not None:
                return policy
        raise GroundedError(
            f"there is no candidate '{identity}': {nearest(identity, self.candidate_ids())}"
        )

    def search_candidates(self) -> list[Candidate]:
        """The candidates of the search for the present task, in order of proposal.

        Probes and candidates of an earlier task (other target, reward, limits) are left out.
        """
        found = []
        for identity in self.candidate_ids():
            candidate, meta = self.candidate(identity)
            if meta.get("kind") == "search" and meta.get("task") == self.task.hash:
                found.append(candidate)
        return found

    def next_id(self) -> str:
        """The name of the next candidate."""
        ids = self.candidate_ids()
        return f"c{(int(ids[-1][1:]) if ids else 0) + 1:04d}"

    def trials(self) -> tuple[StoredTrial, ...]:
        """Every stored trial, in order of arrival.

        Raises:
            GroundedError: if one is damaged, naming it.
        """
        if self._trials is None:
            self._trials = tuple(self._read_trials())
        return self._trials

    _trials: tuple[StoredTrial, ...] | None = None

    def forget(self) -> None:
        """Trials and candidates are read again when they are asked for next."""
        self._trials = None

    def _read_trials(self) -> Iterator[StoredTrial]:
        for stored in self.store.list():
            trial, meta, _ = read_trial(self.store.read(stored), stored.path.name)
            logged = replace(trial, id=stored.id)
            yield StoredTrial(stored, interpolate_gaps(logged).trial, meta, logged)

    def estimated_states(self) -> tuple[str, ...]:
        """States that some stored trial did not measure: the smoother's, no evidence."""
        found = {n for t in self.trials() for n in t.meta.get("estimated", "").split(",") if n}
        return tuple(name for name in self.base_model.state_names if name in found)

    def task_trials(self, *, measured: bool = False) -> list[Trial]:
        """The trials whose states and inputs are this model's and whose dt is this task's.

        Args:
            measured: as they were logged; else short gaps are bridged.
        """
        names = (self.base_model.state_names, self.base_model.input_names)
        dt = self.config.task.dt
        return [
            t.measured if measured else t.trial
            for t in self.trials()
            if (t.trial.state_names, t.trial.input_names) == names and abs(t.trial.dt - dt) < 1e-9
        ]


def candidate_of(data: bytes, name: str) -> tuple[Candidate, dict[str, str]]:
    """A candidate and its metadata from the bytes of its file, called `name` in messages."""
    policy, states, inputs, meta = read_candidate(data, name)
    try:
        candidate = Candidate(
            id=meta["id"],
            policy=policy,
            iteration=int(meta["iteration"]),
            alpha=float(meta["alpha"]),
            base=meta["base"],
            model=meta["model"],
            predicted_states=states,
            predicted_inputs=inputs,
            predicted_utility=float(meta["predicted_utility"]),
            predicted_gain=float(meta.get("predicted_gain", "nan")),
            damping=float(meta.get("damping", "1.0")),
            caution=int(meta.get("caution", "0")),
        )
    except (KeyError, ValueError, json.JSONDecodeError) as error:
        raise GroundedError(
            f"{name}: its metadata lacks or garbles {error}; it was not written by grounded propose"
        ) from None
    return candidate, meta
