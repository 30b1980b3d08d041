"""Rollout: a simulated run of the model, with or without a bias. A real run is a `Trial`."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grounded.compile.problem import Problem
from grounded.frozen import Array, readonly, wrapped
from grounded.model import Model
from grounded.policy import Policy

Run = tuple[Array, Array]  # states (H + 1, n) and inputs (H, m)
SETTLED = 1e-9  # relative change of a run below which it agrees with the samples that were seen


@dataclass(frozen=True, eq=False)
class Rollout:
    """A simulated run: augmented states z (H + 1, nz), inputs (H, m) and the utility.

    The utility is minus infinity if the run diverged. `n` is the number of states in z.
    """

    z: Array
    inputs: Array
    utility: float
    n: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "z", readonly(self.z))
        object.__setattr__(self, "inputs", readonly(self.inputs))

    def __repr__(self) -> str:
        return f"Rollout({len(self.inputs)} steps; utility {self.utility:.4g})"

    @property
    def states(self) -> Array:
        """States s_0 .. s_H, (H + 1, n)."""
        return self.z[:, : self.n]


def simulate(problem: Problem, policy: Policy) -> Rollout:
    """Simulate a policy in the problem's model, closed loop, with inputs clipped to the limits.

    If the policy acts on old samples (`Problem.age`), what it sees depends on the run. So the run
    is repeated until it agrees with what was seen: each repeat makes at least one more step right.
    A policy made with a longer latency feeds back older inputs than this problem's z holds: z is
    extended by them.
    """
    if policy.depths != problem.depths:
        problem = replace(problem, fed_back=policy.depths)
    run = _simulated(problem, policy)
    if not problem.age or policy.gain is None or policy.reference is None:
        return run
    n, angles = run.n, tuple(map(bool, problem.angles))
    for _ in range(problem.horizon):
        reference = policy.reference.copy()
        reference[:, :n] -= seen_late(run.states[:-1], problem.age / problem.dt, angles)
        again = _simulated(problem, replace(policy, reference=reference))
        scale = 1.0 + np.abs(again.z).max(axis=0)
        if not (np.abs(again.z - run.z) > SETTLED * scale).any():
            return again  # also if it diverged
        run = again
    return run


def _simulated(problem: Problem, policy: Policy) -> Rollout:
    swarm = problem.system.rollout(problem, policy.feedforward, policy.gain, policy.reference)
    cost = float(swarm.cost[0])
    utility = -cost if np.isfinite(cost) else -np.inf
    return Rollout(swarm.z[0], swarm.u[0], utility, problem.system.n)


def seen_late(states: Array, steps: float, angles: Sequence[bool]) -> Array:
    """Return what a policy sees of states (H, n) less these, if its samples are old by some steps.

    To first order, that is the change since the step before, times the age; 0 at the first step.
    """
    with np.errstate(all="ignore"):
        return -steps * wrapped(np.diff(states, axis=0, prepend=states[:1]), angles)


def for_late_samples(policy: Policy, problem: Problem) -> Policy:
    """Return a policy about true states as one about what the robot sees of them, `Problem.age`."""
    if not problem.age or policy.reference is None:
        return policy
    n, reference = len(policy.state_names), policy.reference.copy()
    reference[:, :n] += seen_late(reference[:, :n], problem.age / problem.dt, policy.angles)
    return replace(policy, reference=reference)


def each_stepped(model: Model, x: Array, u: Array, p: Array, dt: float) -> Array:
    """Return the next states of rows x (N, n), u (N, m), each with its parameters p (N, k)."""
    return stepper(model, p, dt)(x, u)


def stepper(model: Model, p: Array, dt: float) -> Callable[[Array, Array], Array]:
    """Return the function (x, u) -> next states of `each_stepped`, to call it many times."""
    together = getattr(model.step, "rows", None)  # simulators step all rows at once
    if together is not None:
        return lambda x, u: np.asarray(together(x, u, p, dt))
    groups = equal_rows(p)

    def stepped(x: Array, u: Array) -> Array:
        after = np.empty_like(x)
        for own, values in groups:
            after[own] = model.system.step(x[own], u[own], values, dt)
        return after

    return stepped


def equal_rows(table: Array) -> list[tuple[Any, Array]]:
    """Return the different rows (k,) of a table (N, k), each with where it stands."""
    alike: dict[bytes, list[slice]] = {}
    edges = np.flatnonzero((table[1:] != table[:-1]).any(axis=1)) + 1
    for first, end in itertools.pairwise([0, *edges.tolist(), len(table)]):
        alike.setdefault(table[first].tobytes(), []).append(slice(first, end))
    return [
        (parts[0] if len(parts) == 1 else np.r_[tuple(parts)], table[parts[0].start])
        for parts in alike.values()
    ]


def augmented(problem: Problem, states: Array, inputs: Array, past: Array) -> Array:
    """Return z_0 .. z_T (T + 1, nz) of a recorded run: each state with the inputs sent before it.

    From states (T + 1, n), commands (T, m), and the input held before them (m,).
    """
    columns = [states]
    for j, depth in enumerate(problem.depths):
        sent = np.concatenate([np.full(depth, past[j]), inputs[:, j]])
        T = len(inputs)
        columns.append(
            np.stack([sent[depth - 1 - i : depth + T - i] for i in range(depth)], axis=1)
        )
    return np.hstack(columns)


def apart(problem: Problem, a: Run, b: Run) -> float:
    """Return the cost of the difference of two runs, over the states that both have."""
    n = min(a[0].shape[1], b[0].shape[1])
    with np.errstate(all="ignore"):
        x = wrapped(a[0][:, :n] - b[0][:, :n], problem.angles[:n]) ** 2
        u = a[1] - b[1]
        change = np.diff(u, axis=0, prepend=0.0) ** 2
        cost = np.vdot(problem.state_weight[:, :n], x) + np.sum(u**2 @ problem.input_weight)
        cost += np.sum(change @ problem.change_weight)
    return float(cost) if np.isfinite(cost) else np.inf
