"""Corrected: a System whose derivatives along a trial are corrected (see `mispredictions`).

    x_{t+1} = f(x_t, u_t) + bias_t + y_t,      y_t = C_t [dx_t, du_t, du_{t-1}, y_{t-1}]

where dx, du are the differences from the incumbent's trial. Along that trial y is zero, so it is
still replayed exactly. y and the previous input are not measured; the state is [x, y, u before].
Gains on them are dropped from a policy, their part of the feed-forward stays. f is the compiled
model; the backward sweep and the rollouts run in NumPy (`interpreted`).

Each step of such a system takes as long for twenty runs as for one. A check of gains needs hundreds
of runs, which took a minute of CPU one after the other; `runs` makes them together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from grounded.compile.problem import Controls, Problem, Samples, deepest
from grounded.compile.run.interpreted import System
from grounded.frozen import Array, wrapped
from grounded.policy import Policy
from grounded.rollout import SETTLED, Rollout, seen_late
from grounded.search.planner import predicted

Flags = NDArray[np.bool_]


class Corrected(System):
    """A system of n states and m inputs, with 2 n + m states.

    Rows of `step`, `linearise` and `sensitivities` are the steps of the horizon, in order.

    Args:
        base: the system f.
        law: C (H, n, 2 n + 2 m); or (H, P, n, 2 n + 2 m) to step P runs, each with its own.
        x: states of the incumbent's trial (H, n).
        u: what its actuators received (H, m).
        before: the same, one step earlier (H, m).
    """

    how, note, kind = "corrected", "", "step"

    def __init__(self, base: System, law: Array, x: Array, u: Array, before: Array) -> None:
        self.base, self.law, self.x, self.u, self.before = base, law, x, u, before
        n, m = base.n, base.m
        self.n, self.m, self.k, self.source = 2 * n + m, m, base.k, base.source
        self.inputs = base.inputs
        missed = (f"{name} mispredicted" for name in base.states)
        self.states = (*base.states, *missed, *(f"input {i} before" for i in range(m)))

    def on(self, problem: Problem) -> Problem:
        """Return the base's grounded problem in this system."""

        def padded(a: Array) -> Array:
            return np.concatenate([a, np.zeros((*a.shape[:-1], self.n - self.base.n))], axis=-1)

        return replace(
            problem,
            system=self,
            start=np.concatenate([problem.start, np.zeros(self.base.n), self.before[0]]),
            bias=padded(problem.bias),
            target=padded(problem.target),
            state_weight=padded(problem.state_weight),
            angles=np.append(problem.angles, np.zeros(self.n - self.base.n, bool)),
        )

    def along(self, z: Array) -> Array:
        """Convert the incumbent's trial, z (H + 1, nz) of the base, to this system's z."""
        n = self.base.n
        before = np.vstack([self.before, self.u[-1:]])
        return np.hstack([z[:, :n], np.zeros((len(z), n)), before, z[:, n:]])

    def evaluate(self, x: Array, u: Array, p: Array, dt: float, smoothing: float) -> Array:
        """See `System.evaluate`; u is what the actuators received, without an input shift."""
        moved = self.base.step(self._own(x), u, p, dt, smoothing)
        return self._next(moved, x, u, slice(None), np.zeros(self.base.n, bool))

    def check(self, x: Array, u: Array, p: Array, dt: float) -> None:
        """See `System.check`."""
        self.base.check(self._own(x), u, p, dt)

    def fault(self, x: Array, u: Array, p: Array, dt: float) -> str:
        """See `System.fault`."""
        return self.base.fault(x[: self.base.n], u, p, dt)

    def jacobian(self, at: Samples, width: int) -> Array:
        """See `System.jacobian`."""
        n, m, here = self.base.n, self.m, at._replace(x=self._own(at.x))
        f_x, f_u = self.base.linearise(*here)
        J = np.zeros((len(at.x), self.n, width))
        by_x, by_u, by_before, by_y = np.split(self.law, np.cumsum([n, m, m]), axis=2)
        J[:, n : 2 * n, : 2 * n + 2 * m] = np.concatenate([by_x, by_y, by_before, by_u], axis=2)
        J[:, :n] = J[:, n : 2 * n]
        J[:, :n, :n] += f_x
        J[:, :n, self.n : self.n + m] += f_u
        J[:, 2 * n :, self.n : self.n + m] = np.eye(m)
        if width > self.n + m:
            J[:, :n, self.n + m :] = self.base.sensitivities(*here[:5])[2]
        return J

    def stepped(self, problem: Problem, x: Array, sent: Array, t: int) -> Array:
        """See `System.stepped`; `sent` (N, m) is less the input shift."""
        state, settings = self._own(x), (problem.dt, problem.smoothing)
        moved = self.base.step(state, np.ascontiguousarray(sent), problem.p, *settings)
        shift = 0.0 if problem.input_shift is None else problem.input_shift[t]
        return self._next(moved, x, sent + shift, t, problem.angles[: self.base.n])

    def _own(self, x: Array) -> Array:
        """Return the base's states (N, n) of x (N, 2 n + m)."""
        return np.ascontiguousarray(x[:, : self.base.n])

    def _next(self, moved: Array, x: Array, u: Array, t: int | slice, angles: Flags) -> Array:
        """Return the next [x, y, u before] (N, 2 n + m), the base's next states being `moved`."""
        n, m = self.base.n, self.m
        away = wrapped(x[:, :n] - self.x[t], angles)
        before = x[:, 2 * n : 2 * n + m] - self.before[t]
        d = np.concatenate([away, u - self.u[t], before, x[:, n : 2 * n]], axis=1)
        y = np.einsum("...nq,...q->...n", self.law[t], d)
        return np.concatenate([moved + y, y, u], axis=1)


def runs(problems: Sequence[Problem], policies: Sequence[Policy]) -> list[Rollout]:
    """Return the predicted runs of policies, each in its problem, as `predicted` does one by one.

    The problems are alike except for their biases and the laws of their `Corrected` systems.
    """
    systems = [one.system for one in problems if isinstance(one.system, Corrected)]
    open_loop = any(policy.gain is None for policy in policies)
    if len(systems) < len(problems) or open_loop or not systems:
        return [predicted(*each) for each in zip(problems, policies, strict=True)]
    problem, system = problems[0], _with_each_law(systems)
    for policy in policies:  # z holds all past inputs that any of them feeds back
        problem = replace(problem, fed_back=deepest(problem.depths, policy.depths))
    angles, n = tuple(map(bool, problem.angles)), system.n
    laid = [p.laid_out(system.states, angles, problem.depths) for p in policies]
    each = replace(problem, system=system, bias=np.array([p.bias for p in problems]))
    sent, K, aim = (
        np.array([getattr(p, name) for p in laid]) for name in ("feedforward", "gain", "reference")
    )
    ones = np.ones(len(laid))
    found = system.runs(each, Controls(sent, K, aim), ones)
    left = np.arange(len(laid) if problem.age else 0)
    for _ in range(problem.horizon):  # as in `simulate`, each until it agrees with what was seen
        if not len(left):
            break
        late = [seen_late(run[:-1, :n], problem.age / problem.dt, angles) for run in found.z[left]]
        seen = aim.copy()
        seen[left, :, :n] -= late
        again = system.runs(each, Controls(sent, K, seen), ones)
        scale = 1.0 + np.abs(again.z[left]).max(axis=1, keepdims=True)
        moved = (np.abs(again.z[left] - found.z[left]) > SETTLED * scale).any(axis=(1, 2))
        for name in ("z", "u", "cost"):
            getattr(found, name)[left] = getattr(again, name)[left]
        left = left[moved]
    utilities = np.where(np.isfinite(found.cost), -found.cost, -np.inf).tolist()
    return [Rollout(*run, n) for run in zip(found.z, found.u, utilities, strict=True)]


def _with_each_law(systems: Sequence[Corrected]) -> Corrected:
    """Return a system that steps each of several runs with its own law."""
    first = systems[0]
    if all(one is first for one in systems):
        return first
    law = np.stack([one.law for one in systems], axis=1)
    return Corrected(first.base, law, first.x, first.u, first.before)
