"""Step 4: the ORIGINAL model plus a time-dependent bias, so that it replays a trial exactly.

    f_t^(i+1)(s, a) = f_t(s, a - rho_t) + bias_t
    bias_t          = s_{t+1}^(i) - f_t(s_t^(i), a_t^(i) - rho_t)

The bias is measured on one trial (or on the mean of repeated ones) and added to the model that was
never changed by an earlier trial: errors do not pile up. In the biased model the trial's own policy
gives the trial's own states, so derivatives are taken along the true states (section 4.1). Without
the input shift, rho = 0, this is the paper's step 4.

Why a shift: a crude model has regimes. A motor drives or brakes, a wheel grips, a stick is in its
dead zone. Along a real trial a miscalibrated model is easily in another regime than the robot was:
the car held its speed, the model at the same throttle brakes. Its derivatives are then those of the
wrong branch, and DDP is told that the throttle does nothing. So the part of the disagreement that
inputs can explain is booked on the inputs, and only the rest is added as a bias: w_t is the input
that the MODEL would have needed to move as the real system did,

    rho_t = a_t - w_t,
    w_t = argmin_w  |(f_t(s_t, w) - s_{t+1}) / (dt scale)|^2 + (PULL (w - a_t) / span)^2

with scale the spread of each state's rate along the trial, span that of each input. rho is smoothed
over WINDOW steps, since noise in the states would shake it. Measured on the car
(docs/experiments.md): one trial does what took five.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grounded.checks import refused
from grounded.compile.problem import Problem
from grounded.frozen import Array, median
from grounded.rollout import augmented
from grounded.solve.levenberg_marquardt import LeastSquares, Rows, solve
from grounded.task import Task
from grounded.trial import Trial

PULL = 0.2  # price of leaving the recorded input: a whole span costs as much as 0.2 spreads of rate
WINDOW = 5  # steps of the Hann window
ITERATIONS = 15
ELSEWHERE = (-0.15, 0.15)  # further starts, in spans, where a stalled motor has no slope
DEAD = 0.1  # of an input's usual effect


@dataclass(frozen=True, eq=False)
class Grounding:
    """A trial as the biased model sees it: bias (H, n), z (H + 1, nz), inputs and shift (H, m)."""

    bias: Array
    z: Array
    inputs: Array
    shift: Array | None = None  # rho, see `input_shift`; None for none

    def on(self, problem: Problem) -> Problem:
        """The problem with a model that replays the trial."""
        return replace(problem, bias=self.bias, input_shift=self.shift)


def ground(
    task: Task,
    trial: Trial,
    *,
    exact: bool = False,
    match_inputs: bool = False,
    shift: Array | None = None,
) -> Grounding:
    """The bias that makes the task's model replay a trial (step 4).

    Args:
        task: gives the original model, with its latency.
        trial: a whole trial, finite for H steps; what follows is not used.
        exact: measure the bias of the exact model, not of the smoothed planning model.
        match_inputs: book on the inputs what inputs can explain (`input_shift`).
        shift: rho (H, m), where it is known already.

    Raises:
        GroundedError: if the trial is short or not finite: its bias is not known to the end.
    """
    trial = trial.until(task.horizon)
    if trial.steps < task.horizon or trial.finite_steps < trial.steps:
        facts = {"needs": task.horizon, "has": trial.finite_steps}
        raise refused("given.short", what="bias", **facts)
    problem = task.problem(exact=exact)
    z, received = _along(problem, trial)
    if match_inputs and shift is None:
        shift = input_shift(task.problem(), trial.states, received)
    asked = received if shift is None else received - shift
    predicted = problem.system.step(
        trial.states[:-1], asked, problem.p, problem.dt, problem.smoothing
    )
    # s_{t+1} - f(s_t, a_t); NOT wrapped: replay must land on the recorded number itself.
    return Grounding(trial.states[1:] - predicted, z, trial.inputs, shift)


def _along(problem: Problem, trial: Trial) -> tuple[Array, Array]:
    """A trial's z (T + 1, nz), and what the actuators received (T, m)."""
    past = problem.past if trial.start_inputs is None else trial.start_inputs
    z = augmented(problem, trial.states, trial.inputs, past)
    return z, problem.queue.effective(z[:-1], trial.inputs)


def residuals(task: Task, trial: Trial) -> Array:
    """One-step residuals of the exact model on a trial, (T, n), angles wrapped."""
    problem = task.problem(exact=True)
    _, received = _along(problem, trial)
    predicted = problem.system.step(trial.states[:-1], received, problem.p, problem.dt)
    return task.model.difference(trial.states[1:], predicted)


def input_shift(problem: Problem, x: Array, received: Array) -> Array:
    """The shift rho (T, m) of the inputs along a trial.

    Args:
        problem: the original model, exact or smoothed.
        x: states s_0 .. s_T, (T + 1, n).
        received: what the actuators received, (T, m).
    """
    T, batch = len(received), _moves(problem, x, received)
    rows = np.arange(T)
    best = solve(batch, received, rows, ITERATIONS)
    lost = np.flatnonzero(_without_slope(batch.jacobian(best.w, rows)[:, : x.shape[1]]))
    for part in ELSEWHERE if len(lost) else ():
        start = received[lost] + part * input_span(problem, received)
        best = best.better_of(solve(batch, start, lost, ITERATIONS), lost)
    rho = received - best.w
    if not np.isfinite(rho).all():
        return np.zeros_like(received)
    return np.column_stack([hann_smoothed(column, WINDOW - 1) for column in rho.T])


def hann_smoothed(signal: Array, width: int) -> Array:
    """Weighted mean over `width` + 1 samples; the ends are continued by their last value."""
    window = np.hanning(width + 3)[1:-1]
    padded = np.pad(signal, width // 2, mode="edge")
    return np.convolve(padded, window / window.sum(), mode="valid")


def _without_slope(J: Array) -> NDArray[np.bool_]:
    """Steps at which some input does next to nothing, (T,), for J (T, n, m)."""
    effect = np.linalg.norm(J, axis=1)
    return np.asarray((effect < DEAD * median(effect)).any(axis=1))


def input_span(problem: Problem, inputs: Array) -> Array:
    """The range of each input (m,): of its limits, or that of inputs (T, m) where it has none."""
    limits = problem.high - problem.low
    used = np.ptp(inputs, axis=0) + 1e-9
    return np.where(np.isfinite(limits), limits, used)


def _moves(problem: Problem, x: Array, received: Array) -> LeastSquares:
    """The equations of every step in w, the input that the model is given."""
    settings = (problem.p, problem.dt, problem.smoothing)
    rate = np.diff(x, axis=0) / problem.dt
    scale = np.std(rate, axis=0) + 1e-3 * float(np.abs(rate).max()) + 1e-9
    pull = PULL / input_span(problem, received)

    def residual(w: Array, rows: Rows) -> Array:
        with np.errstate(all="ignore"):
            moved = problem.system.step(x[rows], np.ascontiguousarray(w), *settings)
        return np.hstack([(moved - x[rows + 1]) / problem.dt / scale, (w - received[rows]) * pull])

    def jacobian(w: Array, rows: Rows) -> Array:
        u = np.ascontiguousarray(w)
        _, f_u = problem.system.linearise(x[rows], u, *settings, problem.limits)
        pulls = np.broadcast_to(np.diag(pull), (len(rows), len(pull), len(pull)))
        return np.concatenate([f_u / problem.dt / scale[:, None], pulls], axis=1)

    return LeastSquares(residual, jacobian, problem.low, problem.high, solved=0.0)
