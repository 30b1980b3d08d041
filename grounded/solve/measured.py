"""Gains on what the robot measures, of gains on all that a model remembers.

DDP feeds back the whole state z of the model that plans. A part of it no sensor of the robot knows:
the output of an adopted lag, the play of a backlash. To drop the
gains on that part leaves a loop that was designed for nobody: where gains are high, an unstable
one. A predicted run doesn't show it, for it follows its own reference.

So gains are sought on the known part y of z = [y, h] alone (Levine & Athans, "On the determination
of the optimal constant output feedback gains", IEEE Trans. Autom. Control 15, 1970; here over a
finite horizon). About the run, with dz_t the deviation and Q the quadratic model of the value,

    du_t = K*_t dz_t,        K*_t = -Q_uu^-1 Q_uz              what DDP would feed back
    du_t = F_t dy_t,         F_t  = K*_t E[dz_t | dy_t]        the best that y allows
    E[dz | dy] = S_zy S_yy^-1 dy,                              S_t = E[dz_t dz_t'] of the loop

S is propagated forward under the gains so far, and the value back under F: each needs the other, so
a few passes alternate, and the gains with the least cost are kept. What disturbs the loop is as
large, state by state, as what the run itself does in a step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grounded.compile.problem import Problem
from grounded.compile.run.interpreted import Quadratic, diagonals, linearised
from grounded.frozen import Array, wrapped

PASSES = 4
SAME = 1e-9  # of what inputs do together: less, in difference, is rounding
UNMOVED = 1e-3  # of what a state or input does along the run
RIDGE = 1e-6  # of a known quantity's own variance


def measured_gains(problem: Problem, z: Array, u: Array, K: Array, measured: int) -> Array:
    """Return gains (H, m, nz) that are zero on states that the robot does not measure.

    Args:
        problem: whose optimum the run is.
        z: the run (H + 1, nz).
        u: its inputs (H, m).
        K: gains on all of z (H, m, nz); an input without any at some step keeps none there.
        measured: how many of the first states the robot measures; it knows the inputs it sent.
    """
    known = np.ones(problem.nz, bool)
    known[measured : problem.system.n] = False
    dropped: Array = np.where(known, K, 0.0)
    if not K[:, :, ~known].any() or not np.isfinite(z).all():
        return dropped
    with np.errstate(all="ignore"):
        q = linearised(problem.system, problem, z, u)
        noise = np.mean(wrapped(np.diff(z, axis=0), problem.angles) ** 2, axis=0)
        noise[problem.system.n :] = 0.0  # inputs sent are not disturbed
        tried, gains, still = [dropped], K, UNMOVED * np.ptp(z, axis=0)
        for _ in range(PASSES):
            gains = _swept(q, K, _estimates(q, gains, noise, known, still), known)
            tried.append(gains)
        return tried[int(np.argmin(_costs(q, np.array(tried), noise)))]


def _estimates(
    q: Quadratic, K: Array, noise: Array, known: NDArray[np.bool_], still: Array
) -> Array:
    """E[dz | dy] as matrices (H, nz, nz) that are zero on columns that are not known.

    What deviates by no more than `still` (nz,) tells nothing: of an input that was at its limit the
    commands before have none but rounding, and a gain on that may have any size.
    """
    found = np.zeros_like(q.A)
    found[:] = np.diag(known.astype(float))
    loops, more = q.A + q.B @ K, np.diag(noise)
    S = np.empty_like(q.A)
    S[0] = more
    for t, loop in enumerate(loops[:-1]):
        S[t + 1] = loop @ S[t] @ loop.T + more
    sizes = np.sqrt(np.diagonal(S, axis1=1, axis2=2))
    telling = known & (sizes > still)
    for tells in np.unique(telling, axis=0):
        at = np.flatnonzero((telling == tells).all(axis=1))
        size = sizes[np.ix_(at, tells)][:, None]
        scaled = S[np.ix_(at, tells, tells)] / (size.transpose(0, 2, 1) * size)
        finite = np.isfinite(scaled).all(axis=(1, 2))
        at, size, scaled = at[finite], size[finite], scaled[finite]
        one = np.eye(size.shape[2])
        solved = np.linalg.solve(scaled + RIDGE * one, one / size)
        found[np.ix_(at, ~known, tells)] = (S[np.ix_(at, ~known, tells)] / size) @ solved
    return found


def _swept(q: Quadratic, K: Array, estimates: Array, known: NDArray[np.bool_]) -> Array:
    """F, back in time, with the value of the loop that it makes."""
    gains = np.zeros_like(K)
    weights, R = diagonals(q.l_zz), np.diag(q.l_uu)
    frees: NDArray[np.bool_] = np.any(K, axis=2)
    V = weights[-1]
    for t in range(len(K) - 1, -1, -1):
        free, A, B = frees[t], q.A[t], q.B[t]
        VB = V @ B
        Q_uu, Q_uz = R + B.T @ VB, q.l_uz + VB.T @ A
        if free.any() and np.isfinite(Q_uu).all() and np.isfinite(Q_uz).all():
            if not free.all():
                Q_uu, Q_uz = Q_uu[np.ix_(free, free)], Q_uz[free]
            gains[t, free] = np.where(known, -_least_squares(Q_uu, Q_uz) @ estimates[t], 0.0)
        V = _before(A + B @ gains[t], _by_inputs(q, gains[t]) + weights[t], V)
    return gains


def _least_squares(Q_uu: Array, Q_uz: Array) -> Array:
    """Q_uu^-1 Q_uz, in each input's own unit; inputs that do the same share it, idle ones get 0."""
    size = np.sqrt(np.where(np.diag(Q_uu) > 0, np.diag(Q_uu), 1.0))
    shared = np.linalg.lstsq(Q_uu / np.outer(size, size), Q_uz / size[:, None], rcond=SAME)[0]
    return np.asarray(shared / size[:, None], np.float64)


def _costs(q: Quadratic, K: Array, noise: Array) -> Array:
    """What the disturbances cost in the loops of gains K (P, H, m, nz), (P,)."""
    loops, own, weights = q.A + q.B @ K, _by_inputs(q, K), diagonals(q.l_zz)
    V = np.broadcast_to(weights[-1], loops[:, 0].shape)
    total = V.diagonal(axis1=1, axis2=2) @ noise
    for t in range(K.shape[1] - 1, -1, -1):
        V = _before(loops[:, t], own[:, t] + weights[t], V)
        total = total + V.diagonal(axis1=1, axis2=2) @ noise
    return np.where(np.isfinite(total), total, np.inf)


def _by_inputs(q: Quadratic, K: Array) -> Array:
    """The cost (..., nz, nz) of steps that inputs by gains K (..., m, nz) cause."""
    cross = K.swapaxes(-1, -2) @ q.l_uz
    return np.asarray(K.swapaxes(-1, -2) @ (q.l_uu[:, None] * K) + cross + cross.swapaxes(-1, -2))


def _before(loop: Array, own: Array, V: Array) -> Array:
    """The value (..., nz, nz) of steps of a loop A + B K and their own cost, with V after them.

    A sum of squares (Joseph's form) and symmetric to the last bit: in the shorter Q_zz + K'Q_uz +
    ..., what rounding leaves of asymmetry grows by K'B' each step, up to a negative cost.
    """
    value = loop.swapaxes(-1, -2) @ V @ loop + own
    return np.asarray(0.5 * (value + value.swapaxes(-1, -2)))
