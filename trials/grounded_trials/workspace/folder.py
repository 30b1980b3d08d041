"""A workspace on disk: its task, its trials and its candidates.

    grounded.toml  model.py  target.csv  trials/  candidates/  reports/

All state is derived from these files. Trials are in a store (content-addressed, never rewritten).
Candidates are files c0001.mcap ...; a missing one is restored from a trial that ran it, which has
it as an attachment. Trials that were set aside are left out everywhere (see `identity`).
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Self

from grounded.checks import known, refused
from grounded.errors import GroundedError
from grounded.model import Model
from grounded.search.candidate import Candidate
from grounded.search.planner import Planner
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.plain_file import read_file, unreadable
from grounded_trials.store.documents import Notes
from grounded_trials.store.store import Lost, Store, Stored, made_folder, write_atomically
from grounded_trials.store.trial_file import read_trial
from grounded_trials.workspace.identity import (
    Noted,
    StoredTrial,
    candidate_of,
    encoded,
    noted,
    sha256,
    unknown_candidate,
)
from grounded_trials.workspace.user_files.config import Config, read_config
from grounded_trials.workspace.user_files.model_file import load_module, model_in
from grounded_trials.workspace.user_files.task_file import build_task

if TYPE_CHECKING:
    from grounded.search.standing import Standing
    from grounded_trials.logs.log_table import LogMapping

_ID = re.compile(r"c\d{4,}")


@dataclass(frozen=True, eq=False)
class Contents:
    """The trials and candidates of a workspace, and its lost files."""

    trials: tuple[StoredTrial, ...]  # in order of arrival
    candidates: tuple[Candidate, ...]  # those of the search for this task, in order of proposal
    lost: tuple[Lost, ...]
    errors: tuple[GroundedError, ...]  # about damaged files, also where another copy was read
    # of the search, without some trials
    standings: dict[frozenset[str], Standing] = field(init=False, default_factory=dict)


class Folder:
    """The files of a workspace, read lazily."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.store = Store(self.folder / "trials", prefix="t")
        self.notes = Notes(self.folder / "trials")
        self.reports = self.folder / "reports"

    @property
    def address(self) -> str | None:
        """The folder as an argument of commands; None if it is the current one."""
        return None if self.folder == Path() else str(self.folder)

    @cached_property
    def config(self) -> Config:
        """The checked grounded.toml."""
        for name in ("trials", "candidates", "runs", "reports"):
            place = self.folder / name
            if place.is_symlink() and not place.resolve().is_relative_to(self.folder.resolve()):
                raise unreadable(place, f"link to {place.resolve()}")
        return read_config(self.folder)

    @cached_property
    def base_model(self) -> Model:
        """The crude model of model.py with [model] params, without adopted effects."""
        params, model = self.config.model.params, self._written
        known("parameter", params, model.params, "the model", "grounded.toml: [model] params")
        return model.with_values(params)

    @cached_property
    def log_mapping(self) -> LogMapping | None:
        """Where [log] finds the signals of the model; None without that table."""
        if not self.config.log.values:
            return None
        from grounded_trials.logs.log_table import log_mapping

        model = self.base_model
        return log_mapping(self.config.log, model.state_names, model.input_names)

    @cached_property
    def _written(self) -> Model:
        table = self.config.model
        return model_in(load_module(self.folder, table.file, table.module))

    @cached_property
    def task(self) -> Task:
        """The task with the crude model, in which trials are judged."""
        return build_task(self.config, self.base_model, self.folder)

    @property
    def origin(self) -> Task:
        """The task with the unchanged model of model.py: nothing fitted, nothing adopted."""
        return self.task.with_model(self._written)

    @cached_property
    def planner(self) -> Planner:
        """The task in which the search plans, with all adopted effects and [model] priors."""
        table, planner = self.config.model, Planner(self.task, self.task)
        if table.effects:
            from grounded_trials.workspace.adopted import planner_of

            planner = planner_of(self.task, table.effects)
        if not table.priors:
            return planner
        model = planner.plan.model
        known("parameter", table.priors, model.params, "the model", "grounded.toml: [model] priors")
        own = {name: replace(model.params[name], std=std) for name, std in table.priors.items()}
        return planner.with_model(replace(model, params={**model.params, **own}))

    @cached_property
    def _trials(self) -> tuple[tuple[StoredTrial, ...], tuple[Lost, ...], list[GroundedError]]:
        """The stored trials, the damaged and missing files, and the errors about damaged ones."""
        broken, found, errors = list[Lost](), list[StoredTrial](), list[GroundedError]()
        try:
            known = self.noted
        except GroundedError as error:
            errors.append(error)
            known = noted(self.notes.read(broken))
        for stored in self.store.list():
            try:
                if known.why_aside(stored) is None:
                    group = known.groups.get(stored.digest, "")
                    found.append(self._whole(stored).within(group))
            except GroundedError as error:
                errors.append(error)
                broken.append(Lost(str(stored.path), str(error)))
        lost = list[Lost]()
        for gone in (*broken, *known.gone(self.store)):
            lost.append(replace(gone, file=Path(gone.file).name))
        return tuple(found), tuple(lost), errors

    @cached_property
    def _decoded(self) -> dict[str, StoredTrial]:
        """The trials that were read, by the names of their files."""
        return {}

    @cached_property
    def _contents(self) -> dict[frozenset[str], Contents]:
        """What was read, by the names of the files."""
        return {}

    @cached_property
    def noted(self) -> Noted:
        """The notes of the workspace."""
        return noted(self.notes.read())

    def note(self, **note: str) -> None:
        """Add a note unless an equal one exists; nothing is recorded in a read-only folder."""
        try:
            self.notes.add(note, again=False)
        except GroundedError:
            if os.access(self.folder, os.W_OK):
                raise
        vars(self).pop("noted", None)

    def forget(self) -> Self:
        """Forget everything that was read, since files may have changed; return the folder."""
        for name, kept in vars(Folder).items():
            if isinstance(kept, cached_property):
                vars(self).pop(name, None)
        return self

    def forget_trials(self) -> None:
        """Forget the trials that were read, so that they are read again when needed."""
        for name in ("_trials", "_contents", "noted"):
            vars(self).pop(name, None)

    def read(self, *, strict: bool = True) -> Contents:
        """Read the trials, and the search's candidates for the current task.

        Probes and candidates of an earlier task (other target, reward, limits) are left out. So are
        damaged files, named in `lost`, unless `strict`, which raises for them.
        """
        names = self.names()
        if names not in self._contents:
            trials, missing, damaged = self._trials
            lost, errors = [*missing], [*damaged]
            candidates = tuple(self._read_candidates(trials, lost, errors))
            self._contents[names] = Contents(trials, candidates, tuple(lost), tuple(errors))
        found = self._contents[names]
        for error in found.errors if strict else ():
            raise error
        return found

    def trials(self) -> tuple[StoredTrial, ...]:
        """Return every stored trial that is not set aside, in order of arrival."""
        trials, _, errors = self._trials
        for error in errors:
            raise error
        return trials

    def whole_trials(self) -> tuple[StoredTrial, ...]:
        """Return the stored trials that are not damaged."""
        return self._trials[0]

    def discarded(self) -> dict[str, str]:
        """Return the trials that are set aside, t0004 -> why."""
        found = dict[str, str]()
        for one in self.store.list() if self.noted.aside else ():
            if (why := self.noted.why_aside(one)) is not None:
                found[one.id] = why
        return found

    def aside_trials(self) -> Iterator[StoredTrial]:
        """Yield the trials that are set aside and not damaged, with short gaps bridged."""
        aside = self.discarded()
        for stored in self.store.list() if aside else ():
            if stored.id in aside:
                with suppress(GroundedError):
                    yield self._whole(stored)

    def fits(self, trial: Trial) -> bool:
        """Return whether a trial has this model's states and inputs, and this task's dt."""
        names = (self.base_model.state_names, self.base_model.input_names)
        same = (trial.state_names, trial.input_names) == names
        return same and abs(trial.dt - self.config.task.dt) < 1e-9

    def task_trials(self, *, measured: bool = False) -> list[Trial]:
        """Return the trials that fit this task, as logged or with short gaps bridged."""
        return [t.measured if measured else t.trial for t in self.trials() if self.fits(t.trial)]

    def candidate_path(self, identity: str) -> Path:
        """Return the path of a candidate's file, candidates/c0001.mcap for example."""
        return self.folder / "candidates" / f"{identity}.mcap"

    def candidate_ids(self) -> list[str]:
        """Return all candidates that have a file or were run by a trial, in order of number."""
        return self._ids(self.trials())

    def next_id(self, *, handed: bool = False) -> str:
        """Return the name of the next candidate; `handed`: none that was handed out before."""
        ids = self.candidate_ids()
        if handed:
            ids = sorted({*ids, *self.noted.handed}, key=lambda name: int(name[1:]))
        return f"c{(int(ids[-1][1:]) if ids else 0) + 1:04d}"

    def candidate(self, identity: str) -> tuple[Candidate, dict[str, str]]:
        """Read a candidate and its metadata, from its file or from a trial that ran it."""
        return candidate_of(self.candidate_bytes(identity), identity)

    def candidate_bytes(self, identity: str) -> bytes:
        """Return the contents of a candidate's file, or the copy in a trial that ran it."""
        for read in self._sources(identity):
            return read()
        raise unknown_candidate(self, identity)

    def names(self) -> frozenset[str]:
        """Return the file names of all trials and candidates."""
        found: set[str] = set()
        for place, first in (("trials", "t"), ("candidates", "c")):
            with suppress(FileNotFoundError):
                for name in os.listdir(self.folder / place):  # noqa: PTH208 (many times quicker)
                    if name.startswith(first):
                        found.add(name)
        return frozenset(found)

    def bring_back(self, identity: str) -> Path:
        """Return the path of a candidate's file; restore it from a trial if it is missing."""
        path = self.candidate_path(identity)
        if not path.is_file():
            write_atomically(path, self.candidate_bytes(identity))
        return path

    def save_candidate(
        self, candidate: Candidate, seen: frozenset[str] | None = None, kind: str = "search"
    ) -> Candidate | None:
        """Write candidates/cNNNN.mcap atomically; existing files are never replaced.

        Returns the candidate, under a later name if its own was handed out for another policy. None
        if trials or candidates were added since it was planned with the `names` `seen`.
        """
        data = encoded(candidate, self.task, kind)
        if sha256(data) not in self.noted.handed.get(candidate.id, {sha256(data)}):
            candidate = replace(candidate, id=self.next_id(handed=True))
            data = encoded(candidate, self.task, kind)
        path = self.candidate_path(candidate.id)
        made_folder(path.parent)
        with self.store.locked():
            if path.exists() or seen not in (None, self.names()):
                return None
            write_atomically(path, data)
        return candidate

    def save_probe(self, candidate: Candidate) -> Candidate:
        """Write a candidate that is none of the search, under the first name that is free."""
        while (saved := self.save_candidate(candidate, kind="probe")) is None:
            self.forget_trials()  # another process took the name
            candidate = replace(candidate, id=self.next_id())
        return saved

    def _whole(self, stored: Stored) -> StoredTrial:
        """Return a stored trial; what was read of its file holds, since none is rewritten."""
        name = stored.path.name
        if name not in self._decoded:
            trial, meta, policy = read_trial(self.store.read(stored), name)
            trial = replace(trial, id=stored.id)
            bridged = interpolate_gaps(trial).trial
            self._decoded[name] = StoredTrial(stored, bridged, meta, trial, policy)
        return self._decoded[name]

    def _read_candidates(
        self, trials: tuple[StoredTrial, ...], lost: list[Lost], errors: list[GroundedError]
    ) -> Iterator[Candidate]:
        """Yield the search's candidates; a trial's copy replaces a damaged file."""
        for identity in self._ids(trials):
            file, why = f"candidates/{identity}.mcap", None
            for read in self._sources(identity, trials):
                try:
                    data = read()
                    made, meta = candidate_of(data, identity)
                    for one in trials:
                        if one.trial.candidate == identity and one.ran not in ("", sha256(data)):
                            raise refused("file.changed", file, what="policy", lost=one.stored.id)
                except GroundedError as error:
                    errors.append(why := error)
                    continue
                if (meta.get("kind"), meta.get("task")) == ("search", self.task.hash):
                    yield made
                break
            else:
                if why is None:
                    why = unreadable(file, "its file is missing and no trial contains it")
                    errors.append(why)
                lost.append(Lost(f"{identity}.mcap", str(why)))

    def _ids(self, trials: tuple[StoredTrial, ...]) -> list[str]:
        ids = set[str]()
        for one in trials:
            ids.add(one.trial.candidate)
        with suppress(FileNotFoundError), os.scandir(self.folder / "candidates") as entries:
            for entry in entries:
                if entry.name.endswith(".mcap") and entry.is_file():
                    ids.add(entry.name[:-5])
        return sorted(sorted(filter(_ID.fullmatch, ids)), key=len)  # by number

    def _sources(
        self, identity: str, trials: tuple[StoredTrial, ...] | None = None
    ) -> Iterator[Callable[[], bytes]]:
        """Yield how to read the copies of a candidate: its file, then those in trials that ran it.

        A copy is read when it is asked for: the file may be damaged.
        """
        path = self.candidate_path(identity)
        if path.is_file():
            yield partial(read_file, path, follow=False)
        for one in self.trials() if trials is None else trials:
            if one.trial.candidate == identity and one.policy is not None:
                yield partial(bytes, one.policy)
