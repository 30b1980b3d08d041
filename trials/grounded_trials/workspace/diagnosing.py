"""Run a diagnosis in a workspace: choose trials and model, store the result."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.accounts.finding import in_the_log
from grounded.accounts.sound_trials import sound_trials
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.parts import Made, Ranked
from grounded.diagnosis.telling import NEXT
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding
from grounded.findings import found as finding
from grounded.rollout import Rollout, simulate
from grounded.search.candidate import Candidate
from grounded.search.design import probe
from grounded.search.safety import objections, spread
from grounded.share import Share
from grounded_trials.workspace.adopted import installed_effects
from grounded_trials.workspace.adoption import diagnosed_again
from grounded_trials.workspace.candidates.handover import outside_limits
from grounded_trials.workspace.candidates.search_state import overtaken, standing_in
from grounded_trials.workspace.identity import unsure_times
from grounded_trials.workspace.last_diagnosis import (
    chosen,
    diagnosable,
    model_print,
    write_diagnosis,
)
from grounded_trials.workspace.next_step import DIAGNOSE, after_diagnosis
from grounded_trials.workspace.readings import one_message
from grounded_trials.workspace.user_files.config import listed
from grounded_trials.workspace.where_to_mend import where_to_mend

if TYPE_CHECKING:
    from grounded.accounts.finding import Finding as Fault
    from grounded.diagnosis.parts import Diagnosis
    from grounded.effects import Library
    from grounded.engine import Engine
    from grounded.frozen import Array
    from grounded.policy import Policy
    from grounded.task import Task
    from grounded.trial import Trial
    from grounded_trials.workspace.folder import Folder


def diagnose_in(
    workspace: Folder,
    trials: Sequence[str] = (),
    *,
    max_effects: int | None = None,
    without: Sequence[str] = (),
    library: Library | None = None,
    compare: Sequence[str] = (),
    engine: Engine | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Diagnose the gap between the model and the stored trials; write reports/diagnosis.json.

    The model is diagnosed with the effects that were adopted. If two effects are tied, the
    candidate that would separate them is written too (`.probe`). `.next_trial` says what to expect
    of it.

    Args:
        workspace: the workspace.
        trials: short names such as t0007; empty: all usable trials.
        max_effects: largest number of effects in one hypothesis; None: 3, and more if those leave
            a gap.
        without: effect families to exclude.
        library: the effects to consider; None: the installed ones.
        compare: a second group of trials; the result's `changed` lists what differs from the first.
        engine: workers that fit hypotheses; their number does not change the result.
        progress: called with each stage.
    """
    effects = workspace.config.model.effects
    delays = {n: values["d"] for n, values in effects.items() if n.startswith("delay:")}
    library = (library or installed_effects()).without(without)
    planner = workspace.planner
    share = chosen(workspace, trials)
    second = chosen(workspace, compare) if compare else Share([])
    used, others = share.trials, second.trials
    told = filter(None, [overtaken(workspace), share.finding, second.finding])
    memory = planner.plan.model.state_names[planner.task.model.n :]
    rows, early = unsure_times(workspace.whole_trials(), {one.id for one in (*used, *others)})
    options = DiagnosisOptions(
        library=library,
        max_effects=max_effects,
        hidden=tuple(memory),
        but={*effects} - {*delays},  # the d of a delay is not a model parameter
        one_message=one_message(workspace),
        delays=delays,
        interpolated_s=early,
        origin=workspace.origin if effects or workspace.config.model.params else None,
    )
    lifted, apart = ([planner.lift(trial) for trial in some] for some in (used, others))
    made = Made(
        trials=tuple(trial.id for trial in used + others),
        adopted=tuple(listed(effects)),
        params=dict(workspace.config.model.params),
        nominal={name: p.value for name, p in planner.plan.model.params.items()},
        named=tuple(trial.id for trial in used) if trials or compare else (),
        compared=tuple(compare),
        without=tuple(without),
        model=model_print(workspace),
        rows_s=rows,
        interpolated_s=early,
    )
    found = diagnose(planner.plan, lifted, options, compare=apart, engine=engine, progress=progress)
    measured = found.preflight
    seen = where_to_mend(workspace, used + others, measured)
    known = _as_known(found.ranking, made.rows_s)
    more = (*told, *found.findings)
    found = replace(found, made=made, preflight=seen, ranking=known, findings=more)
    write_diagnosis(workspace.reports, found)
    diagnosed_again(workspace)
    try:
        identity, step = _probe(workspace, found, lifted + apart, library)
    except Exception as error:  # a failed probe must not lose the diagnosis
        if not isinstance(error, GroundedError):  # a bug in grounded: log its traceback too
            logging.getLogger(__name__).error("the probe failed, please report it", exc_info=error)
        why = str(error) or type(error).__name__
        identity, step = "", finding("gap.no_probe", why=why)
    if step is not None and step.code.startswith(NEXT):
        found = found.asking(step, identity)
    elif step is not None:  # why there is no probe
        found = replace(found, findings=(*found.findings, step))
    logs = any(one.log for one in in_the_log(measured))  # the fault affects every trial
    wrong = tuple(trial.id for trial in used + others if trial.candidate and logs)
    return _with_next(workspace, found, identity, wrong, whole=share.finding is None)


def _with_next(
    workspace: Folder, found: Diagnosis, identity: str, wrong: tuple[str, ...], *, whole: bool
) -> Diagnosis:
    """Return a diagnosis with what it asks for and the next command, and write it."""
    if wrong:
        found = found.asking(finding("gap.next.fix", *wrong), identity)
    left = len(diagnosable(workspace)) - len(found.made.trials)
    if unasked := found.no_cause and left > 0 and whole:
        found = found.asking(finding("gap.next.record", stored=left))
    write_diagnosis(workspace.reports, found)  # again, now with the next step
    then = DIAGNOSE if unasked else after_diagnosis(workspace, found)
    return replace(found, then=NextCommand("discard", wrong) if wrong else then)


def _as_known(ranking: Sequence[Ranked], row: float) -> tuple[Ranked, ...]:
    """Widen delays in the ranking by the interval of table rows [s], see `Gridded`."""

    def wider(one: Ranked) -> Ranked:
        late = one.params.get("d")
        if late is None or late.interval is None or not one.effect.startswith("delay:"):
            return one
        low, high = late.interval
        std, interval = math.hypot(late.std, row / 2), (low - row, high + row)
        return replace(one, params={**one.params, "d": replace(late, std=std, interval=interval)})

    return tuple(wider(one) if row else one for one in ranking)


def instruments_in(workspace: Folder, trials: Sequence[str] = ()) -> tuple[Fault, ...]:
    """Check the instruments (sensors, clocks, units) in the stored trials, without the physics."""
    planner = workspace.planner
    memory = planner.plan.model.state_names[planner.task.model.n :]
    used = chosen(workspace, trials).trials
    lifted, together = [planner.lift(trial) for trial in used], one_message(workspace)
    found = sound_trials(planner.plan, lifted, memory, one_message=together)
    return where_to_mend(workspace, used, found.findings)


def _probe(
    workspace: Folder, found: Diagnosis, trials: Sequence[Trial], library: Library
) -> tuple[str, Finding | None]:
    """Write the candidate that would separate two tied effects; return its id and the next step.

    The candidate is one that `run` and `export` accept: inside the current [limits], and inside
    [safety] with a margin as large as runs have strayed. The id is "" if none is written, the step
    None if that of the diagnosis holds.
    """
    ties = {*found.indistinguishable} - {*found.equivalent}
    if found.no_cause or found.changed or not ties:  # of two robots, one is to be diagnosed alone
        return "", None
    now = standing_in(workspace)
    best = now.incumbent
    if best is None:
        return "", None
    planner = workspace.planner
    task, strays = planner.task, spread(planner.task, now.history, best.candidate.model)
    own = best.candidate.policy
    low, high = np.maximum(own.low, task.low), np.minimum(own.high, task.high)
    base = planner.widened(replace(own, low=low, high=high))
    plan = near(planner.plan, task.model.n, trials)
    for room in (0 * strays, strays):
        inside = _narrower(plan, room.max(axis=0))
        made = None if inside is None else probe(inside, base, found, trials, library)
        if made is None:
            break
        if made.little:
            return "", None if found.doubt else made.step
        policy = planner.narrowed(made.policy)
        run = simulate(planner.plan.problem(exact=True), planner.widened(policy))
        candidate = probe_candidate(workspace, policy, run, best.candidate.id, run.utility)
        reasons = (*outside_limits(task, candidate.policy), *objections(task, candidate, strays))
        if not reasons:
            saved = workspace.save_probe(candidate)
            facts = {**made.step.facts, "candidate": saved.id}
            return saved.id, replace(made.step, facts=facts)
    return "", finding("gap.no_probe")


def probe_candidate(
    workspace: Folder, policy: Policy, run: Rollout | Trial, base: str = "", worth: float = math.nan
) -> Candidate:
    """Return a policy that is no step of the search as a candidate; it is not stored yet."""
    planner, model = workspace.planner, workspace.base_model
    return Candidate(
        id=workspace.next_id(),
        policy=policy,
        iteration=0,
        alpha=1.0,
        base=base,
        model=planner.fingerprint,
        predicted_states=run.states[:, : model.n],
        predicted_inputs=run.inputs,
        predicted_utility=worth,
        units={**model.states, **model.inputs},
    )


def near(task: Task, n: int, trials: Sequence[Trial]) -> Task:
    """Bound the states without [safety] to the range of the trials, extended by half on each side.

    States that nothing measures, angles, and memory states of effects, from the nth on, stay
    unbounded.
    """
    been = np.vstack([trial.states for trial in trials])
    known = np.isfinite(been)
    low = np.where(known, been, np.inf).min(axis=0)
    high = np.where(known, been, -np.inf).max(axis=0)
    unknown = ~known.any(axis=0) | (np.arange(task.model.n) >= n)
    low, high = np.where(unknown, 0.0, low), np.where(unknown, 0.0, high)
    free = task.model.angle_mask | unknown
    room = np.where(free, np.inf, 0.5 * (high - low))
    own_low, own_high = task.safety_low, task.safety_high
    assert own_low is not None and own_high is not None
    unset = ~(np.isfinite(own_low) | np.isfinite(own_high))
    return replace(
        task,
        safety_low=np.where(unset, low - room, own_low),
        safety_high=np.where(unset, high + room, own_high),
    )


def _narrower(task: Task, strays: Array) -> Task | None:
    """Narrow [safety] by how far runs have strayed; return None if nothing is left."""
    room = np.append(strays, np.zeros(task.model.n - len(strays)))
    assert task.safety_low is not None and task.safety_high is not None
    low, high = task.safety_low + room, task.safety_high - room
    return replace(task, safety_low=low, safety_high=high) if (low < high).all() else None
