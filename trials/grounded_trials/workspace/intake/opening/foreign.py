"""Foreign logs (not written by grounded): read once, mapped by [log], cut to their trial.

States that are not measured are estimated along the whole log, see `estimating`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np

from grounded.checks import refused
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, found
from grounded.model import Model
from grounded.places import integrals
from grounded.trial import Trial
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.log_files import log_records, read_apart
from grounded_trials.logs.log_paths import log_files
from grounded_trials.logs.log_table import LogMapping, log_mapping, mapped_signals, misread
from grounded_trials.logs.resample import Gridded, Span, to_grid
from grounded_trials.logs.samples import MIXED_S
from grounded_trials.logs.signals import Series, read_signals
from grounded_trials.workspace.adopted import but_late_sensors, planner_of
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import (
    ESTIMATED_WITH,
    INTERPOLATED,
    ROWS,
    StoredTrial,
)
from grounded_trials.workspace.intake.opening.estimating import (
    EstimateTable,
    read_estimate,
    with_estimates,
)
from grounded_trials.workspace.intake.opening.reading import (
    Read,
    about,
    check_candidate,
    encode,
    outstanding,
)
from grounded_trials.workspace.intake.opening.run_start import Recording, recording
from grounded_trials.workspace.intake.opening.stored_before import refuse_as_another
from grounded_trials.workspace.readings import read_by, twice_in_time
from grounded_trials.workspace.user_files.config import FILE
from grounded_trials.workspace.where_to_mend import hashed

SLOWER = 1.5  # commands with intervals above this multiple of dt were sent on another grid
EARLY_SHARE = 0.002  # of a control step, by which interpolated states may be early
SIGNALS_LISTED = 12  # largest number of a log's signals that a message lists


@dataclass(frozen=True, eq=False)
class ForeignLog:
    """The samples of a foreign log, to be cut where its run begins."""

    workspace: Folder
    path: Path
    mapping: LogMapping
    estimate: EstimateTable | None
    series: dict[str, Series]  # the mapped signals
    source: dict[str, str]  # its name, hash and estimated states, for the trial's metadata
    own: Mapping[str, Series] = field(default_factory=dict)  # states its program estimated itself

    def cut(self, candidate: str, start: float | None = None) -> tuple[Trial, Gridded]:
        """Cut the trial from the log; also return how it was sampled.

        It begins `start` seconds after the log's first sample, None: as in [log.span]. Data ("")
        may be longer than the task.
        """
        model, task = self.workspace.base_model, self.workspace.config.task
        past = {n: s.before for n, s in self.mapping.inputs.items() if s.before is not None}
        rest = np.array([{**task.start, **past}.get(name, 0.0) for name in model.input_names])
        found = to_grid(
            self.whole,
            task.dt,
            model.state_names,
            model.input_names,
            self.mapping.span if start is None else Span(start=start),
            angles=model.angles,
            steps=task.horizon if candidate else None,
            rest=None if candidate else rest,
            rates=rates_of(model),
            past=self.workspace.task.past if candidate and start is not None else None,
        )
        logged = tuple(one for one in found.reports if one.name in self.series), found.findings
        found = replace(found, told=lambda: logged)
        trial = Trial(
            states=found.states,
            inputs=found.inputs,
            dt=task.dt,
            state_names=model.state_names,
            input_names=model.input_names,
            candidate=candidate,
            start_inputs=found.start_inputs,
            start_states=found.start_states if candidate else {},
        )
        return trial, found

    @cached_property
    def stored(self) -> tuple[StoredTrial, ...]:
        """The trials that were made from a file with the same bytes, whatever its name."""
        key = "source_sha256"
        trials = self.workspace.whole_trials()
        return tuple(one for one in trials if one.meta.get(key) == self.source[key])

    @property
    def _beside(self) -> tuple[str, ...]:
        """States that are mapped in [log] but not listed in [estimate] measured."""
        if not self.estimate:
            return ()
        names, measured = self.workspace.base_model.state_names, self.estimate.measured
        return tuple(n for n in names if n in self.mapping.states and n not in measured)

    @cached_property
    def whole(self) -> Mapping[str, Series]:
        """The samples of every state and input, also of estimated states."""
        if not self.estimate:
            return self.series
        here, effects = self.workspace, self.workspace.config.model.effects
        kept = but_late_sensors(effects)
        planner = here.planner if len(kept) == len(effects) else planner_of(here.task, kept)
        names = here.base_model.state_names
        return {**with_estimates(self.series, self.estimate, planner.plan, names), **self.own}

    @cached_property
    def as_seen(self) -> ForeignLog | None:
        """The log as the robot's program saw it; None if it is the same.

        Late states are as late as they arrived, and speeds that the program computed itself (by
        differences, a filter, an observer) replace those of the smoother. A delay_s above MIXED_S
        or below zero corrects another clock and is kept.
        """
        states = self.workspace.base_model.state_names
        late = {
            name: one
            for name, one in self.series.items()
            if name in states and 0 < one.spec.delay_s <= MIXED_S
        }
        seen = {n: replace(s, spec=replace(s.spec, delay_s=0.0)) for n, s in late.items()}
        own = dict[str, Series]()
        if specs := {n: self.mapping.states[n] for n in self._beside}:
            with suppress(GroundedError):  # a log may lack them
                own = read_signals(log_files(self.path), specs, self.mapping.layout)
        if not seen and not own:
            return None
        return replace(self, series={**self.series, **seen, **own}, own=own)

    @cached_property
    def recording(self) -> Recording | None:
        """The log in which a run may begin anywhere; None if [log.span] is set."""
        return None if self.spanned else self.anywhere

    @cached_property
    def anywhere(self) -> Recording | None:
        """The log in which a run may begin anywhere, ignoring [log.span]; None if unusable."""
        return recording(self.series, self.workspace.task, self.whole)

    @property
    def spanned(self) -> bool:
        """Whether [log.span] sets where its run begins."""
        return bool(self.workspace.config.log.sub("span").values)


def mapping_of(workspace: Folder, path: Path) -> LogMapping:
    """Return the [log] table, for this log; an error if there is none, or the file is no log."""
    model, files = workspace.base_model, log_files(path)
    mapping = log_mapping(workspace.config.log, model.state_names, model.input_names)
    if mapping is not None:
        return mapping
    if (path / FILE).is_file():
        raise refused("file.no_log", path, own=1)
    read_apart(files, _first_records)
    raise refused("file.no_mapping", path, then=NextCommand("inspect", (str(path),)))


def _first_records(files: tuple[Path, ...]) -> None:
    """Raise an error unless each file is a log."""
    for file in files:
        next(iter(log_records(file)), None)


def read_foreign(workspace: Folder, path: Path, mapping: LogMapping) -> ForeignLog:
    """Read a log through the [log] table, which must map every state and input."""
    model, config, files = workspace.base_model, workspace.config, log_files(path)
    estimate = read_estimate(config.estimate, model) if config.estimate.values else None
    states = tuple(estimate.measured) if estimate else model.state_names
    missing = [s for s in states if s not in mapping.states]
    missing += [i for i in model.input_names if i not in mapping.inputs]
    if missing:
        raise _unmapped(model, mapping, missing[0], path, estimated=estimate is not None)
    source = {"source": path.name, "source_sha256": hashed(files)}
    source |= read_by(mapping)
    if guessed := [name for name in model.state_names if name not in states]:
        source["estimated"] = ",".join(guessed)
        kept = but_late_sensors(config.model.effects)
        source[ESTIMATED_WITH] = ",".join(kept)
    series = mapped_signals(files, mapping, states, model.input_names)
    return ForeignLog(workspace, path, mapping, estimate, series, source)


def _unmapped(
    model: Model, mapping: LogMapping, name: str, path: Path, *, estimated: bool
) -> GroundedError:
    """Return the error for a state or an input that [log] does not map."""
    numbers = inspect_log(path, mapping.layout).moving
    few = {"path": path.name, "numbers": tuple(numbers) if len(numbers) <= SIGNALS_LISTED else None}
    if name in model.input_names:
        return refused("log.no_signal", name, what="input", **few)
    if estimated:
        return refused("log.no_signal", name, what="estimated")
    known = [f"{one} = 0.01" for one in model.state_names if one in mapping.states]
    if not known:
        return refused("log.no_signal", name, what="any", **few)
    return refused("log.no_signal", name, what="state", measured="{ " + ", ".join(known) + " }")


def rates_of(model: Model) -> tuple[str, ...]:
    """Return the states that are velocities, which are zero while the robot is at rest."""
    said = (model.roles.get("speed"), model.roles.get("heading_rate"))
    found = {model.state_names[one.j] for one in integrals(model)} | {*said}
    return tuple(name for name in model.state_names if name in found)


def begun(grid: Gridded, dt: float, inputs: Sequence[str]) -> Iterator[Finding]:
    """Yield a dt that does not fit the commands."""
    slow = [one for one in grid.reports if one.name in inputs and 0 < one.rate_hz * dt < 1 / SLOWER]
    if slow:
        every = 1 / max(one.rate_hz for one in slow)
        yield found("start.interval", *(one.name for one in slow), every=every, dt=dt)


# --- the trial in it ------------------------------------------------------------------------------


def read_log_file(
    workspace: Folder,
    path: Path,
    candidate: str | None,
    data: bool,
    sent_before: Mapping[str, float] = MappingProxyType({}),
) -> Read:
    """Read a foreign log through [log]; `sent_before`: inputs' values until their first samples.

    Raises:
        GroundedError: if it can't be mapped or sampled, if no candidate is outstanding, or if [log]
            removes a delay that the model has as well.
    """
    if twice := twice_in_time(workspace):
        raise GroundedError(twice)
    log = read_foreign(workspace, path, mapping_of(workspace, path).since(sent_before))
    ran = candidate or (log.stored[-1].trial.candidate if log.stored else "")
    refuse_as_another(workspace, path, log.stored, "" if data else candidate)
    chosen = "" if data else ran or outstanding(workspace, path)
    if chosen:
        check_candidate(workspace, path, chosen)
    return cut_log(log, chosen)


def cut_log(log: ForeignLog, candidate: str, start: float | None = None) -> Read:
    """Cut the trial from a log, from `start` [s] on; None: from [log.span] or the first command."""
    trial, grid = log.cut(candidate, start)
    facts = about(log.workspace, candidate) | log.source
    facts |= {ROWS: f"{grid.row_s:.6g}"} if grid.row_s and not candidate else {}
    early = grid.interpolated_s / trial.dt > EARLY_SHARE
    facts |= {INTERPOLATED: f"{grid.interpolated_s:.3g}"} if early else {}
    encoded = encode(log.workspace, trial, facts, grid.start_ns)
    remarks = next(iter(log.series.values())).findings
    return Read(
        trial,
        encoded,
        (
            *misread(log.workspace.base_model, log.mapping),
            *remarks,
            *grid.findings,
            *(() if candidate else begun(grid, trial.dt, trial.input_names)),
        ),
        log=log,
        cut=grid,
    )


def cut_short(read: Read, steps: int, fell: Finding | None = None) -> Read:
    """Cut a run in a foreign log after `steps`, where it failed, if it is longer."""
    if read.log is None or read.cut is None or read.trial.steps <= steps:
        return read
    trial, workspace = read.trial.until(steps), read.log.workspace
    facts = about(workspace, trial.candidate) | read.log.source
    data = encode(workspace, trial, facts, read.cut.start_ns)
    return replace(read, trial=trial, data=data).telling(*([fell] if fell else []))
