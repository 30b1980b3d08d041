"""Checks before a candidate is handed to a robot.

All numbers must be finite, inputs inside the hard limits, gains of reasonable size, and the
PREDICTED run, widened by the spread of real runs so far, inside [safety]. Each objection is a
sentence with the limit, the state and the time. If the model leaves [safety] after the run, while
the runner holds its last input, that is not an objection but a warning: the operator may stop it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.frozen import Array
from grounded.rollout import augmented
from grounded.search.candidate import Candidate, Tried
from grounded.task import Task
from grounded.trial import Trial

COASTS = 2.0  # [s] time after a run that is checked
MAX_GAIN = 1e6  # input units per state unit; a larger gain is a numerical error
MOST = 0.6  # share of the squared scatter that marks one run; a single outlier of three makes 2 / 3


@dataclass(frozen=True, eq=False)
class Strays:
    """Deviations of real runs from predictions or repeats, and the trial that causes most of it.

    Args:
        size: deviation in units of the states, (H + 1, n).
        trial: id of the trial that causes most of it, (H + 1, n); "" if none does.
        foretold: whether it is a deviation from the trial's prediction, (H + 1, n); else from
            repeated runs.
    """

    size: Array
    trial: Array
    foretold: Array

    def clause(self, t: int, i: int) -> str:
        """Return which run causes the spread of state i at step t and what to do; "" if none."""
        if not (one := self.trial[t, i]):
            return ""
        what = "its prediction" if self.foretold[t, i] else "the other runs of its candidate"
        return (
            f"; +- is the distance of trial {one} from {what}: if that run was disturbed, remove "
            f"it with `discard {one}`"
        )


def spread(task: Task, history: Sequence[Tried], model: str) -> Strays:
    """Return the deviations of real runs so far; zero before the first run.

    This is the larger of two standard deviations between repeated runs of one candidate, and the
    error of the latest prediction of a step by this model, grounded on a trial. Errors of other
    models, or of the model without a bias, do not count: they don't apply to the next step.
    """
    found = np.zeros((task.horizon + 1, task.model.n))
    whose, foretold = np.full(found.shape, "", dtype=object), np.zeros(found.shape, dtype=bool)
    assert task.safety_low is not None and task.safety_high is not None
    if not np.isfinite([task.safety_low, task.safety_high]).any():
        return Strays(found, whose, foretold)  # no [safety] to check
    for tried in history:
        whole = [t for t in tried.trials if t.finite_steps == task.horizon]
        if len(whole) > 1:
            states = np.array([t.states for t in whole])
            off = task.model.difference(states, np.mean(states, axis=0)) ** 2
            scatter = 2 * np.sqrt(off.sum(axis=0) / (len(whole) - 1))
            ids = np.array([t.id for t in whole], dtype=object)[off.argmax(axis=0)]
            ids[off.max(axis=0) <= MOST * off.sum(axis=0)] = ""
            whose = np.where(scatter > found, ids, whose)
            found = np.maximum(found, scatter)
    grounded = [
        (tried.candidate.predicted_states, trial)
        for tried in history
        for trial in tried.trials
        if tried.candidate.grounded and tried.candidate.model == model
        if trial.finite_steps == task.horizon
    ]
    if grounded:
        predicted, last = grounded[-1]
        missed = np.abs(task.model.difference(last.states, predicted))
        foretold = missed > found
        whose, found = np.where(foretold, last.id, whose), np.maximum(found, missed)
    return Strays(found, whose, foretold)


def objections(task: Task, candidate: Candidate, strays: Strays | None = None) -> list[str]:
    """Return the reasons why a candidate must not be run; empty if there are none.

    Args:
        task: has the limits of [safety].
        candidate: the candidate with its predicted run.
        strays: deviations of real runs so far, see `spread`; None for zero.
    """
    policy = candidate.policy
    parts = {"feed-forward": policy.feedforward, "predicted state": candidate.predicted_states}
    if policy.gain is not None and policy.reference is not None:
        parts |= {"gain": policy.gain, "reference": policy.reference}
    for name, values in parts.items():
        bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        if bad.any():
            t = int(np.argmax(bad))
            return [
                f"the {name} of {candidate.id} is not a finite number at t = {t * task.dt:g} s "
                f"(step {t}): the model diverges there; check it with a shorter horizon"
            ]
    found = [_outside(task, candidate, strays, i) for i in range(task.model.n)]
    return [sentence for sentence in (*found, too_strong(task, candidate)) if sentence]


def too_strong(task: Task, candidate: Candidate) -> str:
    """Return which gain of a candidate is beyond reason, and what would make it smaller; or ""."""
    policy, model = candidate.policy, task.model
    if policy.gain is None or not np.abs(policy.gain).max() > MAX_GAIN:
        return ""
    t, j, i = np.unravel_index(int(np.argmax(np.abs(policy.gain))), policy.gain.shape)
    sent, fed = policy.input_names[j], policy.z_names[i]
    units = {**model.inputs, **model.states}
    of = units.get(fed, units[sent])  # else an input of an earlier step
    size = f"{abs(policy.gain[t, j, i]):.3g} {units[sent]} per {of}"
    lower, moves = f"raise [reward] input_change of {sent}", ""
    if fed in model.states:
        k = model.state_names.index(fed)
        weight = float(max(task.reward.state[k], task.reward.terminal[k]))
        moved = float(np.ptp(candidate.predicted_states[:, k]))
        moves = f". The plan moves {fed} by {moved:.3g} {of} in all"
        lower = (
            f"weigh {fed} less in [reward] (now {weight:g}), or {lower}"
            if weight
            else f"{fed} has no weight in [reward], so check its unit and what it drives in the "
            f"model, or {lower}"
        )
    return (
        f"the gain of {sent} on {fed} reaches {size} in {candidate.id}, at t = {t * task.dt:g} s, "
        f"more than {MAX_GAIN:g}{moves}: {lower} (now {task.reward.input_change[j]:g})"
    )


def _outside(task: Task, candidate: Candidate, strays: Strays | None, i: int) -> str:
    """Return the sentence for state i leaving [safety] in the predicted run, or ""."""
    assert task.safety_low is not None and task.safety_high is not None
    value = candidate.predicted_states[:, i]
    stray = np.zeros(len(value)) if strays is None else strays.size[:, i]
    beyond = np.maximum(task.safety_low[i] - value, value - task.safety_high[i])
    excess = beyond + stray
    t = int(np.argmax(excess))
    if excess[t] <= 0:
        return ""
    name = task.model.state_names[i]
    around = f" +- {stray[t]:.3f}" * bool(stray[t])
    why = strays.clause(t, i) if strays is not None and beyond.max() <= 0 else ""
    return (
        f"{candidate.id} (alpha = {candidate.alpha:g}) is predicted to take {name} to "
        f"{value[t]:.3f}{around} {task.model.states[name]} at t = {t * task.dt:.2f} s, outside "
        f"[safety] {name} = [{task.safety_low[i]:g}, {task.safety_high[i]:g}]{why}"
    )


def coasting(task: Task, run: Trial, held: Array) -> Array:
    """Simulate the robot after a run, with the input that its runner sends then.

    Args:
        task: the planning task, whose model includes memory states.
        run: the run, with that task's states (T + 1, n).
        held: the input that is sent after it (m,).

    Returns:
        States (S + 1, n) from the end of the run on, up to the first non-finite one.
    """
    problem = task.problem(exact=True)
    steps = math.ceil(COASTS / task.dt)
    inputs = np.vstack([run.inputs, np.tile(held, (steps, 1))])
    past = problem.past if run.start_inputs is None else run.start_inputs
    z = augmented(problem, np.zeros((len(inputs) + 1, task.model.n)), inputs, past)
    received = problem.queue.effective(z[:-1], inputs)[run.steps :]
    states = [run.states[-1]]
    for u in received:
        after = problem.system.step(states[-1][None], u[None], problem.p, task.dt)[0]
        if not np.isfinite(after).all():
            break
        states.append(after)
    return np.array(states)


def coasts_out(task: Task, plan: Task, run: Trial, held: Array) -> str:
    """Return a warning if the model predicts that the robot leaves [safety] after a run, or "".

    Args:
        task: has the limits of [safety].
        plan: the planning task, see `coasting`.
        run: the predicted run, inside [safety].
        held: the input that is sent after it (m,).
    """
    assert task.safety_low is not None and task.safety_high is not None
    if not np.isfinite([task.safety_low, task.safety_high]).any():
        return ""
    states = coasting(plan, run, held)[:, : task.model.n]
    excess = np.maximum(task.safety_low - states, states - task.safety_high)
    if not (excess > 0).any():
        return ""
    t = int(np.argmax((excess > 0).any(axis=1)))
    i = int(np.argmax(excess[t]))
    most = int(np.argmax(excess[:, i]))
    (name, unit), inputs = list(task.model.states.items())[i], task.model.inputs.items()
    sent = ", ".join(
        f"{one} = {value:.3g} {of}".removesuffix(" 1")
        for (one, of), value in zip(inputs, held, strict=True)
    )
    return (
        f"its runner holds {sent}, and the model predicts that the robot leaves [safety] {name} = "
        f"[{task.safety_low[i]:g}, {task.safety_high[i]:g}] {t * task.dt:.2g} s later and reaches "
        f"{states[most, i]:.3g} {unit}, {most * task.dt:.2g} s later: be ready to stop it, switch "
        "to a holding controller once the runner is done, or let the target come to rest inside"
    )
