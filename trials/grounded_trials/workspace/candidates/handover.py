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
    [safety]      the predicted run, predicted again if the model was changed
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.policy import Policy
from grounded.result import listed
from grounded.rollout import seen_late, simulate
from grounded.search.candidate import Candidate
from grounded.search.certainty import beyond_one_trial
from grounded.search.feedback.oscillation import quiet_gains
from grounded.task import Task
from grounded.trial import Trial, mean_trial
from grounded_trials.store.store import Stored
from grounded_trials.store.trial_file import read_trial
from grounded_trials.wording import ranges, what_became, with_unit
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import StoredTrial, candidate_of, other_task, sha256
from grounded_trials.workspace.where_to_mend import twice_in_time

if TYPE_CHECKING:
    from grounded.search.standing import Standing

INSPECT = NextCommand("inspect", ("LOG",))  # lists what [log] may map
NEAREST = 2  # number of [safety] bounds reported: the nearest, relative to the state's range
NEAR = 0.25  # fraction of a state's range in the run: bounds farther away are not reported
NEARER = 0.01  # fraction of that range by which a run must approach a bound from its start
AGREES = 1e-6  # tolerance, relative to an input's size, for a policy to repeat its prediction


@dataclass(frozen=True, eq=False)
class Handed:
    """A candidate that may be handed over, as the bytes that were checked."""

    candidate: Candidate
    meta: dict[str, str]
    data: bytes
    check: Check
    overridden: tuple[str, ...] = ()  # reasons to refuse it, overridden by `anyway`

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the candidate that do not prevent its use."""
        return tuple(self.check.notes())


class Void(GroundedError):
    """Raised for a candidate that must not be handed over; `reasons` has a sentence for each."""

    def __init__(self, identity: str, reasons: Sequence[str]) -> None:
        super().__init__(
            f"{identity} is not handed over: {'; '.join(reasons)}. Propose another, or use "
            "--anyway to hand it over regardless",
            NextCommand("propose"),
        )
        self.reasons = tuple(reasons)


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
        Void: if it must not be handed over, unless `anyway`.
        GroundedError: if its file is damaged, rewritten, renamed, or for another robot; also if
            [log] lacks an input or counts a delay twice, unless `anyway`.
    """
    data = workspace.candidate_bytes(identity)
    candidate, meta = intact(data, identity)
    check = Check(workspace, candidate, meta, other_task, now)
    check.refuse_foreign(sha256(data))
    if not anyway:
        check_log(workspace)
    reasons = tuple(check.reasons())
    if reasons and not anyway:
        raise Void(identity, reasons)
    reasons = (*([lost] if (lost := unmapped(workspace)) else []), *reasons)
    _note(workspace, identity, data)
    return Handed(candidate, meta, data, check, reasons)


def unmapped(workspace: Folder) -> str:
    """Return which inputs [log] lacks although it maps others; "" for none, or without [log].

    What such an input is on the robot was never compared with a log: a speed in m/s may arrive as
    the duty of a motor. A system that `run` reaches gets the model's inputs, and needs no [log].
    """
    mapping = workspace.log_mapping
    if mapping is None or not (mapping.states or mapping.inputs):
        return ""
    if workspace.config.system.reachable:
        return ""
    lost = [name for name in workspace.base_model.input_names if name not in mapping.inputs]
    return f"[log] maps no {listed([repr(name) for name in lost])}" if lost else ""


def check_log(workspace: Folder) -> None:
    """Refuse to plan for inputs that [log] lacks (see `unmapped`), or for delays that count twice.

    Raises:
        GroundedError: if there is such an input, or if [log] removes a delay that an adopted effect
            has in the model as well.
    """
    if twice := twice_in_time(workspace):
        raise GroundedError(twice)
    if not (lost := unmapped(workspace)):
        return
    file = workspace.config.model.file or workspace.config.model.module
    raise GroundedError(
        f"{lost}, though {file} has that as an input: which command of the robot that is, and in "
        "which unit, was never compared with a log, so the robot may take it for something else. "
        "Every input must be logged: map it in [log]. If the robot is driven by another command (a "
        f"duty instead of a speed), put that one into {file} under its own name and unit, and map "
        "it",
        INSPECT,
    )


def _note(workspace: Folder, identity: str, data: bytes) -> None:
    """Record that a candidate was handed out: its hash, and the last trial stored by then.

    Nothing is recorded in a read-only folder.
    """
    stored = workspace.store.list()
    after = stored[-1].path.stem if stored else ""
    note = {"note": "hand-out", "candidate": identity, "sha256": sha256(data), "after": after}
    try:
        workspace.notes.add(note, again=False)
    except GroundedError:
        if os.access(workspace.folder, os.W_OK):
            raise
    vars(workspace).pop("noted", None)


def intact(data: bytes, identity: str) -> tuple[Candidate, dict[str, str]]:
    """Read a candidate and check that its policy sends the inputs that it predicts.

    That check finds rewritten files that have no checksum, or a recomputed one.

    Args:
        data: the contents of the file.
        identity: the name of the file, such as c0003.

    Returns:
        The candidate and the metadata of its file.

    Raises:
        GroundedError: if it is damaged, rewritten or renamed.
    """
    candidate, meta = candidate_of(data, identity)
    predicted, policy = candidate.predicted_inputs, candidate.policy
    true, steps = candidate.predicted_states[:-1], candidate.sample_age / policy.dt
    with np.errstate(all="ignore"):
        seen = true + seen_late(true, steps, policy.angles)
        sent = policy.commands(seen[None], policy.past, predicted[None])
        off = np.abs(sent[0] - predicted)
        wrong = off > AGREES * (1 + np.abs(predicted).max(axis=0))
    if wrong.any():
        t, j = (int(i) for i in np.argwhere(wrong)[0])
        raise GroundedError(
            f"candidates/{identity}.mcap is not the candidate that was proposed: at t = "
            f"{t * policy.dt:g} s its policy sends {policy.input_names[j]} = {sent[0, t, j]:g}, "
            f"but its own prediction has {predicted[t, j]:g}. It was rewritten: delete the file "
            "and propose again",
            NextCommand("propose"),
        )
    return candidate, meta


@dataclass(frozen=True)
class Check:
    """A candidate checked against the current workspace; damaged trial files are ignored."""

    workspace: Folder
    candidate: Candidate
    meta: dict[str, str]
    other_task: bool
    now: Standing | None

    @cached_property
    def trials(self) -> tuple[StoredTrial, ...]:
        """The trials whose files are intact."""
        return self.workspace.whole_trials()

    @cached_property
    def standing(self) -> Standing:
        """The standing of the search."""
        from grounded.search.standing import standing

        if self.now is not None:
            return self.now
        here = self.workspace
        try:
            candidates = here.read().candidates
        except GroundedError:
            candidates = here.read(strict=False).candidates
        trials = [t.trial for t in self.trials if here.fits(t.trial)]
        options, planner = here.config.search, here.planner
        return standing(here.task, candidates, trials, options, planner.fingerprint, planner)

    @property
    def same_task(self) -> bool:
        """Whether the candidate was made for the current task."""
        return self.meta.get("task") == self.workspace.task.hash

    def refuse_foreign(self, found: str) -> None:
        """Refuse a candidate for another robot, or one not equal to what was handed out or run.

        Args:
            found: SHA-256 of its file.

        Raises:
            GroundedError: if it is such a candidate.
        """
        made, model = self.candidate, self.workspace.base_model
        for what, names, own in (
            ("states", made.policy.state_names, model.state_names),
            ("inputs", made.policy.input_names, model.input_names),
        ):
            if names != own:
                raise GroundedError(
                    f"{made.id} is for the {what} {', '.join(names)}, but this workspace's model "
                    f"has {', '.join(own)}: it is a candidate of another robot",
                    NextCommand("propose"),
                )
        if found not in self.workspace.noted.handed.get(made.id, {found}):
            raise GroundedError(
                f"candidates/{made.id}.mcap is not what was handed out under that name: it was "
                "rewritten, or comes from another workspace; delete the file",
                NextCommand("propose"),
            )
        for one in self.trials:
            if one.trial.candidate == made.id and one.ran not in ("", found):
                raise GroundedError(
                    f"candidates/{made.id}.mcap is not the policy that {one.stored.id} ran: it was "
                    "rewritten, or comes from another workspace; delete the file, the trial "
                    "carries the one that was run"
                )

    def reasons(self) -> Iterator[str]:
        """Yield the reasons why it must not be handed over, a sentence each."""
        made, config = self.candidate, self.workspace.config
        if abs(made.policy.dt - config.task.dt) > 1e-9:
            yield f"it runs every {made.policy.dt:g} s, but [task] dt is {config.task.dt:g} s"
        model = self.workspace.base_model
        for kind, own in (("states", model.states), ("inputs", model.inputs)):
            for name, unit in json.loads(self.meta[kind]).items():
                if unit != own[name]:
                    yield f"it has {name} in {unit}, but the current model has it in {own[name]}"
        yield from outside_limits(self.workspace.task, made.policy)
        if not self.same_task and not (self.other_task and self._ever_ran):
            yield (
                f"it was made for another task ({other_task(self.workspace.task, made)})"
                f"{', and was not run there' * self.other_task}"
            )
        elif self.void:
            yield "it was not run and is void: the model was changed since it was made"
        yield from self._unsafe()

    def notes(self) -> Iterator[str]:
        """Yield remarks that the user should know although they do not prevent its use."""
        made, name = self.candidate, self.candidate.id
        best, untried = self.standing.incumbent, not self._trials(name)
        if made.doubtful and untried:
            yield made.doubt(best)
        if best is not None and untried:
            small = beyond_one_trial(made, best, self.workspace.config.search.repeats)
            yield from [small] if small else []
        if quiet := quiet_gains(self.workspace.task, self.standing.history):
            yield from [risk] if (risk := quiet.risk(made)) else []
        yield from self._became()
        if "sha256" not in self.meta:
            yield f"{name} was written by an older version: its file has no checksum of its own"
        if not self.same_task:
            yield f"{name} was made for a different task from that in grounded.toml"
        elif self._changed:
            again = "its prediction is outdated"
            if self._predictable:
                again += ", and its run was predicted again only to check it against the limits"
            yield f"the model was changed since {name} was made; {again}"
        if self.same_task and not self.standing.trials:
            yield from self._untried()
            yield from self._not_logged()
            yield from self._too_long()
        if self.same_task and (coasts := self._coasting()):
            yield coasts

    def _became(self) -> Iterator[str]:
        """Yield that it lost, that its trials were set aside, or those that it was made from."""
        name, best = self.candidate.id, self.standing.incumbent
        tried = next((t for t in self.standing.history if t.candidate.id == name), None)
        if tried is not None and tried.void:
            yield (
                f"{name} was made from {ranges(tried.gone)}, which "
                f"{'is' if len(tried.gone) == 1 else 'are'} "
                f"{what_became(tried.gone, self.workspace.discarded())}: `propose` says what to "
                "run instead"
            )
        if tried is not None and tried.accepted is False and best is not None:
            lost = "crashed" if tried.utility == -np.inf else f"lost with {tried.utility:.4g}"
            yield f"{name} {lost}; the best so far is {best.candidate.id}, {best.utility:.4g}"
        aside = self.workspace.discarded()
        for stored in self.workspace.store.list() if aside else ():
            if stored.id in aside and self._ran(stored) == name:
                why = aside[stored.id]
                yield f"{stored.id}, a run of {name}, is set aside{why and ': ' + why}"

    def _ran(self, stored: Stored) -> str:
        with suppress(GroundedError):
            return read_trial(self.workspace.store.read(stored))[0].candidate
        return ""

    def _untried(self) -> Iterator[str]:
        """Yield a warning if the first run is predicted to come near bounds of [safety].

        Bounds that the run does not approach from where it starts are left out.
        """
        task, made = self.workspace.task, self.candidate
        assert task.safety_low is not None and task.safety_high is not None
        near = []
        for i, (name, unit) in enumerate(task.model.states.items()):
            low, high, values = task.safety_low[i], task.safety_high[i], made.predicted_states[:, i]
            far = max(np.ptp(values), 1e-12)
            for side, room in (("lower", values - low), ("upper", high - values)):
                t = int(np.argmin(room))
                if (
                    np.isfinite(room[t])
                    and room[0] - room[t] > NEARER * far
                    and room[t] < NEAR * far
                ):
                    left = with_unit(f"{room[t]:.3g}", unit)
                    told = f"within {left} of the {side} bound of {name} (at {t * task.dt:.4g} s)"
                    near.append((room[t] / far, told))
        if near:
            told = " and ".join(text for _, text in sorted(near)[:NEAREST])
            yield (
                f"[safety] was only checked on the prediction, which no run has tested: {made.id} "
                f"is predicted to come {told}. The robot may go further: be ready to stop it"
            )

    def _not_logged(self) -> Iterator[str]:
        """Yield which states are fed back although [log] has no column of them, only estimates."""
        gain, config = self.candidate.policy.gain, self.workspace.config
        mapped = self.workspace.log_mapping if config.estimate.names() else None
        if gain is None or mapped is None:
            return
        names = self.workspace.base_model.state_names
        used = np.abs(gain[:, :, : len(names)]).max(axis=(0, 1)) > 0
        told = [n for n, u in zip(names, used, strict=True) if u and n not in mapped.states]
        if told:
            many = len(told) > 1
            it = "them" if many else "it"
            yield (
                f"{self.candidate.id} feeds back {listed(told)}, of which the log has no column: "
                f"your program has to compute {it} while it runs (differences, a filter). Let it "
                f"log {it}, by hand too, map {it} in [log], and add {it} to [estimate] measured, "
                "with the scatter at standstill: a run is recognised by the commands that follow "
                f"from these values, and `diagnose` finds how late {'they are' * many or 'it is'}, "
                "which plans then allow for"
            )

    def _too_long(self) -> Iterator[str]:
        """Yield that the integrator's steps are too long for the model, if they are."""
        from grounded.accounts.time_step import too_long

        made, model = self.candidate, self.workspace.base_model
        states, inputs = made.predicted_states[:-1], made.predicted_inputs
        if found := too_long(model, states, inputs, made.policy.dt):
            file = self.workspace.config.model.file or self.workspace.config.model.module
            yield (
                f"in each step of the predicted run {found.state} {found.told}: {found.advice} in "
                f"{file}, and propose again"
            )

    def _coasting(self) -> str:
        """Return where the robot goes after the run, with the input held then; or ""."""
        from grounded.search.safety import coasts_out
        from grounded_trials.workspace.intake.remarks.after_run import kicked

        made, planner = self.candidate, self.workspace.planner
        run = planner.lift(made.predicted_run)
        held = np.clip(made.policy.past, made.policy.low, made.policy.high)
        out = coasts_out(self.workspace.task, planner.plan, run, held)
        if out:
            return f"after {made.id} ends {out}"
        kick = kicked(planner, run, held)
        return f"{made.id}: {kick}" * bool(kick)

    @property
    def void(self) -> bool:
        """Whether it is a step of the search, planned with another model, that no trial ran."""
        searched = self.meta.get("kind") == "search" and self.same_task
        return searched and not self._trials(self.candidate.id) and self._changed

    @property
    def _changed(self) -> bool:
        return self.candidate.model != self.workspace.planner.fingerprint

    @property
    def _predictable(self) -> bool:
        """Whether the run can be predicted in the current task: it has the same time grid."""
        policy, task = self.candidate.policy, self.workspace.task
        return policy.horizon == task.horizon and abs(policy.dt - task.dt) <= 1e-9

    @property
    def _ever_ran(self) -> bool:
        return any(one.trial.candidate == self.candidate.id for one in self.trials)

    def _trials(self, identity: str) -> list[Trial]:
        found = [t.trial for t in self.trials if t.trial.candidate == identity]
        return [t for t in found if self.workspace.fits(t)]

    def _unsafe(self) -> list[str]:
        """Return objections of [safety]; a step not run yet gets a margin for how runs strayed."""
        from grounded.search.safety import objections, spread

        workspace, made = self.workspace, self.candidate
        if self._changed and self._predictable:
            made = self._predicted()
        strays = None
        if self._predictable and not self._trials(made.id):
            strays = spread(workspace.task, self.standing.history, made.model)
        return objections(workspace.task, made, strays)

    def _predicted(self) -> Candidate:
        """Predict the candidate with the current model, grounded on its trials or its base's."""
        from grounded.solve.bias import ground

        planner, made = self.workspace.planner, self.candidate
        plan, horizon = planner.engaged, planner.task.horizon
        problem = replace(planner.plan.problem(exact=True), age=made.sample_age)
        for identity in (made.id, made.base):
            ran = [t.until(horizon) for t in self._trials(identity)] if identity else []
            whole = [t for t in ran if t.finite_steps == horizon]
            if whole:
                own = planner.lift(mean_trial(whole, planner.task.model.angle_mask))
                matched = self.workspace.config.search.match_inputs
                shift = ground(plan, own, match_inputs=matched).shift
                engaged = replace(plan.problem(exact=True), age=made.sample_age)
                problem = ground(plan, own, exact=True, shift=shift).on(engaged)
                break
        run = simulate(problem, planner.widened(made.policy))
        states = run.states[:, : planner.task.model.n]
        return replace(made, predicted_states=states, predicted_inputs=run.inputs)


def outside_limits(task: Task, policy: Policy) -> Iterator[str]:
    """Yield a sentence for each input for which a policy may exceed the task's hard limits.

    A feed-forward with feedback may lie outside the limits: its sum with the feedback is clipped to
    the policy's own limits, so only those need to be inside.
    """
    for j, (name, unit) in enumerate(task.model.inputs.items()):
        low, high = task.low[j], task.high[j]
        today = with_unit(f"[limits] {name} = [{low:g}, {high:g}]", unit)
        if policy.low[j] < low or policy.high[j] > high:
            own = f"[{policy.low[j]:g}, {policy.high[j]:g}]"
            yield f"its own limits of {name} are {own}, wider than {today}"
        room = 1e-9 * max([1.0, *(abs(v) for v in (low, high) if np.isfinite(v))])
        parts = {f"holds {name} at": policy.past[j : j + 1]}
        if policy.gain is None:
            parts[f"sends {name} ="] = policy.feedforward[:, j]
        for what, values in parts.items():
            excess = np.maximum(low - values, values - high)
            if excess.max() > room:
                yield f"it {what} {values[np.argmax(excess)]:g}, outside {today}"
