"""Checks on a candidate at the moment it is handed over, whenever it was made.

`propose`, `run` and `export` use these checks. The configuration, the model and the file may have
changed since a candidate was proposed, so everything is checked again:

    the file      holds the candidate it is named after, as it was proposed (never overridden)
    the robot     state and input names (never overridden), units, dt
    [log]         maps every input, if it maps anything: else no one knows what an input is there;
                  removes no delay that an adopted effect has in the model as well
    the task      the task hash; another task's candidate is only exported, if a trial ran it
    [limits]      the policy's own limits, and what it sends and holds, are inside the current ones
    the model     a candidate that no trial ran is void once the model was changed
    [safety]      the predicted run; if the model was changed since, the runs of it
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from grounded.checks import refused
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, Quantity, Weight, found, settle
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.search.difference import in_question
from grounded.search.safety import coasts_out, objections, spread
from grounded.search.standing import Standing
from grounded.task import Task
from grounded.trial import Trial, mean_trial
from grounded_trials.wording import what_became
from grounded_trials.workspace.candidates.search_state import standing_of
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import candidate_of, other_task, sha256
from grounded_trials.workspace.readings import twice_in_time

if TYPE_CHECKING:
    from grounded.search.candidate import Tried

INSPECT = NextCommand("inspect", ("LOG",))  # lists what [log] may map
PROPOSE = NextCommand("propose")


@dataclass(frozen=True, eq=False)
class Handed:
    """A candidate that may be handed over, as the bytes that were checked."""

    candidate: Candidate
    meta: dict[str, str]
    data: bytes
    check: Check
    overridden: tuple[Finding, ...] = ()  # reasons to refuse it, overridden by `anyway`

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is told of the candidate, the heaviest first."""
        return settle(one for one in self.check.notes() if one)


class Void(GroundedError):
    """Raised for a candidate that must not be handed over; `reasons` has a finding for each."""

    def __init__(self, identity: str, reasons: Sequence[Finding]) -> None:
        self.reasons = tuple(reasons)
        then = NextCommand("propose")
        super().__init__(found("plan.refused", identity, then=then, why=in_words(reasons)))


def in_words(findings: Sequence[Finding]) -> str:
    """Return findings as a fact of another one."""
    return "; ".join(one.sentence for one in findings)


def checked_candidate(
    workspace: Folder,
    identity: str,
    *,
    anyway: bool = False,
    other_task: bool = False,
    now: Standing | None = None,
) -> Handed:
    """Read a candidate, check it against the current workspace, and note that it was handed over.

    Args:
        workspace: the workspace whose model, task, [limits] and [safety] apply.
        identity: the candidate's name, such as c0003.
        anyway: hand it over despite reasons against it, which are then in `overridden`.
        other_task: accept a candidate of another task if a trial ran it.
        now: the standing of the search, if known.
    """
    data = workspace.candidate_bytes(identity)
    candidate, meta = candidate_of(data, identity)
    check = Check(workspace, candidate, meta, other_task, now)
    check.refuse_foreign(sha256(data))
    if not anyway:
        check_log(workspace)
    reasons = tuple(check.reasons())
    if reasons and not anyway:
        raise Void(identity, reasons)
    if (lost := unmapped(workspace)) is not None:
        reasons = (lost, *reasons)
    stored = workspace.store.list()
    after = stored[-1].path.stem if stored else ""
    workspace.note(note="hand-out", candidate=identity, sha256=sha256(data), after=after)
    return Handed(candidate, meta, data, check, tuple(one.weighing(Weight.WARN) for one in reasons))


def unmapped(workspace: Folder) -> Finding | None:
    """Return which inputs [log] lacks although it maps others; None for none, or without [log].

    What such an input is on the robot was never compared with a log: a speed in m/s may arrive as
    the duty of a motor. A system that `run` reaches gets the model's inputs, and needs no [log].
    """
    mapping = workspace.log_mapping
    if mapping is None or not (mapping.states or mapping.inputs):
        return None
    if workspace.config.reachable:
        return None
    lost = [name for name in workspace.base_model.input_names if name not in mapping.inputs]
    file = workspace.config.model.file or workspace.config.model.module
    return found("plan.unmapped", *lost, then=INSPECT, file=file) if lost else None


def check_log(workspace: Folder) -> None:
    """Refuse to plan for inputs that [log] lacks, or for delays that count twice."""
    for one in (twice_in_time(workspace), unmapped(workspace)):
        if one is not None:
            raise GroundedError(one)


@dataclass(frozen=True)
class Check:
    """A candidate checked against the current workspace; damaged trial files are ignored."""

    workspace: Folder
    candidate: Candidate
    meta: dict[str, str]
    other_task: bool
    now: Standing | None

    @cached_property
    def standing(self) -> Standing:
        """The standing of the search."""
        return self.now or standing_of(self.workspace, self.workspace.read(strict=False))

    @property
    def same_task(self) -> bool:
        """Whether the candidate was made for the current task."""
        return self.meta.get("task") == self.workspace.task.hash

    def refuse_foreign(self, found_hash: str) -> None:
        """Refuse a candidate for another robot, or one not equal to what was handed out or run."""
        made, model = self.candidate, self.workspace.base_model
        for names, own in (
            (made.policy.state_names, model.state_names),
            (made.policy.input_names, model.input_names),
        ):
            if names != own:
                raise refused(
                    "given.fit", made.id, then=PROPOSE, what="signals", theirs=names, own=own
                )
        file, then = f"candidates/{made.id}.mcap", PROPOSE
        if found_hash not in self.workspace.noted.handed.get(made.id, {found_hash}):
            raise GroundedError(found("file.changed", file, then=then, what="candidate"))
        for one in self.workspace.whole_trials():
            if one.trial.candidate == made.id and one.ran not in ("", found_hash):
                ran = one.stored.id
                raise GroundedError(found("file.changed", file, then=then, what="policy", lost=ran))

    def reasons(self) -> Iterator[Finding]:
        """Yield the reasons why it must not be handed over."""
        made, config, name = self.candidate, self.workspace.config, self.candidate.id
        if abs(made.policy.dt - config.task.dt) > 1e-9:
            own, now = Quantity(made.policy.dt, "s"), Quantity(config.task.dt, "s")
            yield found("given.fit", name, what="dt", theirs=own, own=now)
        model = self.workspace.base_model
        for kind, own_units in (("states", model.states), ("inputs", model.inputs)):
            for signal, unit in json.loads(self.meta[kind]).items():
                if unit != own_units[signal]:
                    wanted = own_units[signal]
                    yield found("given.fit", signal, what="unit", theirs=unit, own=wanted)
        yield from outside_limits(self.workspace.task, made.policy)
        if not self.same_task and not (self.other_task and self._ran):
            yield found(
                "plan.other_task",
                name,
                what=other_task(self.workspace.task, made),
                never=int(self.other_task),
            )
        elif self.void:
            yield found("plan.outdated", name, weight=Weight.REFUSE, candidate=name)
        yield from self._unsafe()

    def notes(self) -> Iterator[Finding | None]:
        """Yield what the user should know although it does not prevent its use."""
        made, name, best = self.candidate, self.candidate.id, self.standing.incumbent
        if best is not None and not self._runs:
            yield in_question(made, best, self.workspace.config.search.repeats)
        yield from self._became()
        if not self.same_task:
            yield found("plan.other_task", name, weight=Weight.NOTE)
            return
        if self._changed:
            yield found("plan.outdated", name, candidate=name)

        # Where the robot goes after the run, with the input held then.
        planner, policy = self.workspace.planner, made.policy
        held = np.clip(policy.past, policy.low, policy.high)
        yield coasts_out(planner.task, planner.plan, planner.lift(made.predicted_run), held)

    def _became(self) -> Iterator[Finding]:
        """Yield that its trials were set aside, or those that it was made from."""
        name = self.candidate.id
        tried = next((t for t in self.standing.history if t.candidate.id == name), None)
        aside = self.workspace.discarded()
        if tried is not None and tried.void:
            yield disowned(tried, aside)
        for one in self.workspace.aside_trials():
            if one.trial.candidate == name:
                told = found("search.aside", one.stored.id, candidate=name, weight=Weight.NOTE)
                yield told.also(why=aside[one.stored.id])

    @property
    def void(self) -> bool:
        """Whether it is a step of the search, planned with another model, that no trial ran."""
        searched = self.meta.get("kind") == "search" and self.same_task
        return searched and not self._runs and self._changed

    @property
    def _changed(self) -> bool:
        return self.candidate.model != self.workspace.planner.fingerprint

    @cached_property
    def _ran(self) -> list[Trial]:
        """Its runs, also those that no longer fit the task, whose files are intact."""
        every = (one.trial for one in self.workspace.whole_trials())
        return [trial for trial in every if trial.candidate == self.candidate.id]

    @property
    def _runs(self) -> list[Trial]:
        return [trial for trial in self._ran if self.workspace.fits(trial)]

    def _unsafe(self) -> tuple[Finding, ...]:
        """Return objections of [safety]; a step not run yet gets a margin for how runs strayed.

        If the model was changed since it ran, its runs count instead of the prediction.
        """
        made, task, strays = self.candidate, self.workspace.task, None
        same = made.policy.horizon == task.horizon and abs(made.policy.dt - task.dt) <= 1e-9
        runs = [one.until(task.horizon) for one in self._runs]
        whole = [one for one in runs if one.finite_steps == task.horizon]
        if self._changed and same and whole:
            mean = mean_trial(whole, task.model.angle_mask)
            made = replace(made, predicted_states=mean.states)
        if same and not runs:
            strays = spread(task, self.standing.history, made.model)
        return objections(task, made, strays)


def outside_limits(task: Task, policy: Policy) -> Iterator[Finding]:
    """Yield the inputs for which a policy may exceed the task's hard limits.

    A feed-forward with feedback may lie outside the limits: its sum with the feedback is clipped to
    the policy's own limits, so only those need to be inside.
    """
    for j, name in enumerate(task.model.input_names):
        low, high = task.low[j], task.high[j]
        room = 1e-9 * max([1.0, *(abs(v) for v in (low, high) if np.isfinite(v))])
        ends = ((policy.low[j], policy.low[j] < low), (policy.high[j], policy.high[j] > high))
        outside = [end for end, out in ends if out]
        sent = policy.past[j : j + 1]
        if policy.gain is None:
            sent = np.append(sent, policy.feedforward[:, j])
        outside += [v for v in sent if v < low - room or v > high + room]
        if outside:
            yield found(
                "plan.outside",
                name,
                state=name,
                table="limits",
                value=f"{max(outside, key=abs):g}",
                low=f"{low:g}",
                high=f"{high:g}",
            )


def disowned(tried: Tried, aside: Collection[str]) -> Finding:
    """Return that a candidate, never run, is void since a trial that it was made from is gone."""
    name = tried.candidate.id
    gone = what_became(tried.gone, aside)
    return found("plan.void", name, candidate=name, trials=tried.gone, gone=gone)
