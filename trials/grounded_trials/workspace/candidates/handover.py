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
from grounded.trial import mean_trial
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
    standing: Standing  # of the search
    findings: tuple[Finding, ...]  # what is told of it, the heaviest first
    overridden: tuple[Finding, ...]  # reasons to refuse it, overridden by `anyway`


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

    Raises:
        Void: if it must not be handed over, unless `anyway`. Another GroundedError refuses a file
            that is damaged, rewritten, renamed or for another robot, and checks [log].
    """
    data = workspace.candidate_bytes(identity)
    candidate, meta = candidate_of(data, identity)
    refuse_foreign(workspace, candidate, sha256(data))
    if not anyway:
        check_log(workspace)
    check = Check(workspace, candidate, meta, now)
    reasons = tuple(check.reasons(other_task))
    if reasons and not anyway:
        raise Void(identity, reasons)
    told = settle(one for one in check.notes() if one)
    if (lost := unmapped(workspace)) is not None:
        reasons = (lost, *reasons)
    stored = workspace.store.list()
    after = stored[-1].path.stem if stored else ""
    workspace.note(note="hand-out", candidate=identity, sha256=sha256(data), after=after)
    overridden = tuple(one.weighing(Weight.WARN) for one in reasons)
    return Handed(candidate, meta, data, check.standing, told, overridden)


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


def refuse_foreign(workspace: Folder, made: Candidate, digest: str) -> None:
    """Refuse a candidate for another robot, or one not equal to what was handed out or run."""
    model, then, file = workspace.base_model, PROPOSE, f"candidates/{made.id}.mcap"
    for names, own in (
        (made.policy.state_names, model.state_names),
        (made.policy.input_names, model.input_names),
    ):
        if names != own:
            raise refused("given.fit", made.id, then=then, what="signals", theirs=names, own=own)
    if digest not in workspace.noted.handed.get(made.id, {digest}):
        raise refused("file.changed", file, then=then, what="candidate")
    for one in workspace.whole_trials():
        if one.trial.candidate == made.id and one.ran not in ("", digest):
            raise refused("file.changed", file, then=then, what="policy", lost=one.stored.id)


class Check:
    """A candidate checked against the current workspace; damaged trial files are ignored."""

    def __init__(
        self, workspace: Folder, made: Candidate, meta: dict[str, str], now: Standing | None
    ) -> None:
        self.workspace, self.made, self.meta = workspace, made, meta
        self.standing = now or standing_of(workspace, workspace.read(strict=False))
        self.same_task = meta.get("task") == workspace.task.hash
        self.changed = made.model != workspace.planner.fingerprint  # the model was, since
        ran = (one.trial for one in workspace.whole_trials() if one.trial.candidate == made.id)
        self.ran = [*ran]  # also runs that no longer fit the task
        self.runs = [trial for trial in self.ran if workspace.fits(trial)]

    def reasons(self, accepts_other: bool) -> Iterator[Finding]:
        """Yield the reasons why it must not be handed over."""
        made, name, task = self.made, self.made.id, self.workspace.task
        if abs(made.policy.dt - task.dt) > 1e-9:
            own, now = Quantity(made.policy.dt, "s"), Quantity(task.dt, "s")
            yield found("given.fit", name, what="dt", theirs=own, own=now)
        model = self.workspace.base_model
        for kind, own_units in (("states", model.states), ("inputs", model.inputs)):
            for signal, unit in json.loads(self.meta[kind]).items():
                if unit != own_units[signal]:
                    wanted = own_units[signal]
                    yield found("given.fit", signal, what="unit", theirs=unit, own=wanted)
        yield from outside_limits(task, made.policy)

        # A step of the search for another task, or planned with another model, that no trial ran.
        searched = self.meta.get("kind") == "search"
        if not self.same_task and not (accepts_other and self.ran):
            never, what = int(accepts_other), other_task(task, made)
            yield found("plan.other_task", name, what=what, never=never)
        elif searched and self.same_task and self.changed and not self.runs:
            yield found("plan.outdated", name, weight=Weight.REFUSE, candidate=name)
        yield from self._unsafe()

    def notes(self) -> Iterator[Finding | None]:
        """Yield what the user should know although it does not prevent its use."""
        made, name, now = self.made, self.made.id, self.standing
        if now.incumbent is not None and not self.runs:
            yield in_question(made, now.incumbent, self.workspace.config.search.repeats)

        # Its trials, or those that it was made from, were set aside.
        aside = self.workspace.discarded()
        tried = next((t for t in now.history if t.candidate.id == name), None)
        if tried is not None and tried.void:
            yield disowned(tried, aside)
        for one in self.workspace.aside_trials():
            if one.trial.candidate == name:
                told = found("search.aside", one.stored.id, candidate=name, weight=Weight.NOTE)
                yield told.also(why=aside[one.stored.id])
        if not self.same_task:
            yield found("plan.other_task", name, weight=Weight.NOTE)
            return
        if self.changed:
            yield found("plan.outdated", name, candidate=name)

        # Where the robot goes after the run, with the input held then.
        planner, policy = self.workspace.planner, made.policy
        held = np.clip(policy.past, policy.low, policy.high)
        yield coasts_out(planner.task, planner.plan, planner.lift(made.predicted_run), held)

    def _unsafe(self) -> tuple[Finding, ...]:
        """Return objections of [safety]; a step not run yet gets a margin for how runs strayed.

        If the model was changed since it ran, its runs count instead of the prediction.
        """
        made, task, strays = self.made, self.workspace.task, None
        same = made.policy.horizon == task.horizon and abs(made.policy.dt - task.dt) <= 1e-9
        runs = [one.until(task.horizon) for one in self.runs]
        whole = [one for one in runs if one.finite_steps == task.horizon]
        if self.changed and same and whole:
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
