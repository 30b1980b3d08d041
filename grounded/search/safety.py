"""Checks before a candidate is handed to a robot.

All numbers must be finite, inputs inside the hard limits, gains of reasonable size, and the
PREDICTED run, widened by the spread of real runs so far, inside [safety]. Each objection is a
sentence with the limit, the state and the time. If the model leaves [safety] after the run, while
the runner holds its last input, that is not an objection but a warning: the operator may stop it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.result import with_unit
from grounded.rollout import augmented
from grounded.search.candidate import Candidate, Tried
from grounded.task import Task
from grounded.trial import Trial

COASTS = 2.0  # [s] time after a run that is checked
MAX_GAIN = 1e6  # input units per state unit; a larger gain is a numerical error


def spread(task: Task, history: Sequence[Tried], model: str) -> Array:
    """Return the deviations of real runs so far, (H + 1, n); zero before the first run.

    This is the larger of two standard deviations between repeated runs of one candidate, and the
    error of the latest prediction of a step by this model, grounded on a trial. Errors of other
    models, or of the model without a bias, do not count: they don't apply to the next step.
    """
    size = np.zeros((task.horizon + 1, task.model.n))
    assert task.safety_low is not None and task.safety_high is not None
    if not np.isfinite([task.safety_low, task.safety_high]).any():
        return size  # no [safety] to check
    for tried in history:
        whole = [t for t in tried.trials if t.finite_steps == task.horizon]
        if len(whole) > 1:
            states = np.array([t.states for t in whole])
            off = task.model.difference(states, np.mean(states, axis=0))
            size = np.maximum(size, 2 * np.sqrt((off**2).sum(axis=0) / (len(whole) - 1)))
    grounded = [
        (tried.candidate.predicted_states, trial)
        for tried in history
        for trial in tried.trials
        if tried.candidate.grounded and tried.candidate.model == model
        if trial.finite_steps == task.horizon
    ]
    if grounded:
        predicted, last = grounded[-1]
        size = np.maximum(size, np.abs(task.model.difference(last.states, predicted)))
    return size


def objections(
    task: Task, candidate: Candidate, strays: Array | None = None
) -> tuple[Finding, ...]:
    """Return the reasons why a candidate must not be run; `strays` as `spread` gives them."""
    policy, name = candidate.policy, candidate.id
    parts = {"feed-forward": policy.feedforward, "predicted state": candidate.predicted_states}
    if policy.gain is not None and policy.reference is not None:
        parts |= {"gain": policy.gain, "reference": policy.reference}
    for what, values in parts.items():
        bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        if bad.any():
            at = f"{int(np.argmax(bad)) * task.dt:.3g} s"
            return (found("plan.none", name, what=what, at=at),)
    against = [_outside(task, candidate, strays, i) for i in range(task.model.n)]
    return tuple(one for one in (*against, too_strong(task, candidate)) if one)


def too_strong(task: Task, candidate: Candidate) -> Finding | None:
    """Return which gain of a candidate is beyond reason, and what would make it smaller."""
    policy, model = candidate.policy, task.model
    if policy.gain is None or not np.abs(policy.gain).max() > MAX_GAIN:
        return None
    t, j, i = np.unravel_index(int(np.argmax(np.abs(policy.gain))), policy.gain.shape)
    sent, fed = policy.input_names[j], policy.z_names[i]
    units = {**model.inputs, **model.states}
    of = units.get(fed, units[sent])  # else an input of an earlier step
    return found(
        "plan.gain",
        candidate.id,
        candidate=candidate.id,
        input=sent,
        state=fed,
        gain=Quantity(abs(policy.gain[t, j, i]), f"{units[sent]} per {of}"),
        at=Quantity(t * task.dt, "s"),
        most=MAX_GAIN,
        change=float(task.reward.input_change[j]),
    )


def _outside(task: Task, candidate: Candidate, strays: Array | None, i: int) -> Finding | None:
    """Return that state i leaves [safety] in the predicted run; None if it does not."""
    assert task.safety_low is not None and task.safety_high is not None
    low, high = float(task.safety_low[i]), float(task.safety_high[i])
    value = candidate.predicted_states[:, i]
    stray = np.zeros(len(value)) if strays is None else strays[:, i]
    beyond = np.maximum(low - value, value - high)
    excess = beyond + stray
    t = int(np.argmax(excess))
    if excess[t] <= 0:
        return None
    name = task.model.state_names[i]
    return found(
        "plan.outside",
        candidate.id,
        candidate=candidate.id,
        alpha=candidate.alpha,
        state=name,
        table="safety",
        value=Quantity(value[t], task.model.states[name], stray[t]),
        at=Quantity(t * task.dt, "s"),
        low=f"{low:g}",
        high=f"{high:g}",
    )


def coasting(task: Task, run: Trial, held: Array) -> Array:
    """Simulate the planning task's robot after a run, while its runner sends `held` (m,).

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


def coasts_out(task: Task, plan: Task, run: Trial, held: Array) -> Finding | None:
    """Return that by the plan's model the robot leaves the task's [safety] after a run, or None."""
    assert task.safety_low is not None and task.safety_high is not None
    if not np.isfinite([task.safety_low, task.safety_high]).any():
        return None
    states = coasting(plan, run, held)[:, : task.model.n]
    excess = np.abs(states - task.inside_safety(states))
    if not excess.any():
        return None
    t = int(np.argmax(excess.any(axis=1)))
    i = int(np.argmax(excess[t]))
    most = int(np.argmax(excess[:, i]))
    name, unit = list(task.model.states.items())[i]
    return found(
        "plan.coasts_out",
        held=as_sent(task.model, held),
        state=name,
        low=f"{task.safety_low[i]:g}",
        high=f"{task.safety_high[i]:g}",
        at=Quantity(t * task.dt, "s"),
        most=Quantity(states[most, i], unit),
    )


def as_sent(model: Model, inputs: Array) -> tuple[str, ...]:
    """Return inputs (m,) as `force = 0 N`, each."""
    pairs = zip(model.inputs.items(), inputs + 0.0, strict=True)
    return tuple(with_unit(f"{name} = {x:.3g}", unit) for (name, unit), x in pairs)
