"""Matched inputs: what the MODEL would have needed to move as the real system did.

A crude model has regimes: a motor drives or brakes, a wheel grips, a stick is in its dead zone.
Along a real trial (s_t, a_t) a miscalibrated model is easily in another regime than the robot was:
the car held its speed, the model at the same throttle brakes. Its derivatives are then those of the
wrong branch, and DDP is told that the throttle does nothing. So the part of the disagreement that
inputs can explain is booked on the inputs, and only the rest is added as a bias:

    f_t^(i+1)(s, a) = f_t(s, a - rho_t) + bias_t,       rho_t = a_t - w_t,
    w_t = argmin_w  |(f_t(s_t, w) - s_{t+1}) / (dt scale)|^2 + (PULL (w - a_t) / span)^2

The model still replays the trial exactly, and its derivatives are still taken along the trial's own
STATES (section 4.1 of the paper); rho = 0 is the paper's step 4. scale is the spread of each
state's rate along the trial, span that of each input. rho is smoothed over WINDOW steps, since
noise in the states would shake it. Measured on the car (docs/experiments.md): one trial does what
took five.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grounded.compile import Problem
from grounded.frozen import Array
from grounded.levenberg_marquardt import Batch, Rows, solve

PULL = 0.2  # price of leaving the recorded input: a whole span costs as much as 0.2 spreads of rate
WINDOW = 5  # steps of the Hann window
ITERATIONS = 15
ELSEWHERE = (-0.15, 0.15)  # further starts, in spans, where a stalled motor has no slope
DEAD = 0.1  # of an input's usual effect


def input_shift(problem: Problem, x: Array, received: Array) -> Array:
    """Rho (T, m) along a trial.

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
        start = received[lost] + part * _span(problem, received)
        best = best.better_of(solve(batch, start, lost, ITERATIONS), lost)
    rho = received - best.w
    if not np.isfinite(rho).all():
        return np.zeros_like(received)
    window = np.hanning(WINDOW + 2)[1:-1]
    padded = np.pad(rho, ((WINDOW // 2, WINDOW // 2), (0, 0)), mode="edge")
    smooth = [np.convolve(column, window / window.sum(), mode="valid") for column in padded.T]
    return np.column_stack(smooth)


def _without_slope(J: Array) -> NDArray[np.bool_]:
    """Steps at which some input does next to nothing, (T,), for J (T, n, m)."""
    effect = np.linalg.norm(J, axis=1)
    return np.asarray((effect < DEAD * np.median(effect, axis=0)).any(axis=1))


def _span(problem: Problem, received: Array) -> Array:
    limits = problem.high - problem.low
    used = np.ptp(received, axis=0) + 1e-9
    return np.where(np.isfinite(limits), limits, used)


def _moves(problem: Problem, x: Array, received: Array) -> Batch:
    """The equations of every step in w, the input that the model is given."""
    settings = (problem.p, problem.dt, problem.smoothing)
    rate = np.diff(x, axis=0) / problem.dt
    scale = np.std(rate, axis=0) + 1e-3 * float(np.abs(rate).max()) + 1e-9
    pull = PULL / _span(problem, received)

    def residual(w: Array, rows: Rows) -> Array:
        with np.errstate(all="ignore"):
            moved = problem.system.step(x[rows], np.ascontiguousarray(w), *settings)
        return np.hstack([(moved - x[rows + 1]) / problem.dt / scale, (w - received[rows]) * pull])

    def jacobian(w: Array, rows: Rows) -> Array:
        _, f_u = problem.system.linearise(x[rows], np.ascontiguousarray(w), *settings)
        pulls = np.tile(np.diag(pull), (len(rows), 1, 1))
        return np.concatenate([f_u / problem.dt / scale[:, None], pulls], axis=1)

    return Batch(residual, jacobian, problem.low, problem.high, solved=0.0)
