"""DDP: the method A of the paper, "find a locally optimal policy of a simulator".

Each iteration sweeps back for gains (`riccati.py`) and rolls the nonlinear model out with them,

    u_t = clip( ubar_t + alpha k_t + K_t (z_t - zbar_t) ),   alpha = 1, 1/2, 1/4, ...

until the cost falls by at least a tenth of the predicted alpha d1 + alpha^2 d2.
A failed sweep or search raises the regularisation mu of Q_uu (in units of the inputs' own weights),
a success lowers it. `solve` runs to convergence. `damped_step` is ONE step with a damping of the
caller's choice; it gives the gains with which the search starts along a trial. What keeps the
search close to the trial is a price on leaving its inputs, part of the problem itself
(`improve.damped`).

Settings as measured on a car (H = 200) and a 6-DOF aircraft (H = 3000): 4 and 5 iterations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from grounded.compile import Backward, Problem
from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.riccati import CEILING, FLOOR, GROWTH, Sweep, input_scale, sweep

Status = Literal["converged", "max iterations", "no improvement", "not finite"]

SEARCH_FLOOR = 1e-3  # regularisation after a failed search
LARGE_MU = 1.0


@dataclass(frozen=True)
class Options:
    """Settings of `solve`."""

    max_iterations: int = 100
    tolerance: float = 1e-8  # stop when the predicted change is below this times the cost
    halvings: int = 11  # alpha = 1 ... 1/2^11
    accept: float = 0.1  # least part of the predicted change


@dataclass(frozen=True)
class Iteration:
    """One line of the trace."""

    cost: float
    predicted: float  # change of cost the quadratic model promised at alpha = 1
    alpha: float  # 0: no alpha was accepted
    mu: float


@dataclass(frozen=True, eq=False)
class Result:
    """Where the search ended and why.

    k and K belong to a sweep about the solution itself: u_t + K_t (z_t - z[t]) is the policy.
    """

    status: Status
    sentence: str
    z: Array  # (H+1, nz)
    u: Array  # (H, m)
    k: Array  # (H, m)
    K: Array  # (H, m, nz)
    cost: float
    trace: tuple[Iteration, ...]

    @property
    def ok(self) -> bool:
        """Whether z, u, K are a usable policy: anything but "not finite"."""
        return self.status != "not finite"


def solve(
    problem: Problem,
    ubar: Array,
    K: Array | None = None,
    zbar: Array | None = None,
    options: Options | None = None,
) -> Result:
    """DDP from the rollout of ubar (H, m), or of the policy ubar + K (z - zbar).

    Args:
        problem: what to solve.
        ubar: first inputs.
        K: (H, m, nz) feedback of the first rollout only.
        zbar: (H, nz) or (H+1, nz), the reference of K.
        options: settings.

    Raises:
        GroundedError: for arrays that do not fit the problem.
    """
    options = options or Options()
    _check(problem, ubar, K, zbar)
    first = problem.system.rollout(problem, ubar, K, zbar)
    state = _State(first.z[0], first.u[0], float(first.cost[0]), 0.0)
    trace: list[Iteration] = []
    if not np.isfinite(state.cost):
        return _not_finite(problem, state, _first_bad(problem, state.z), trace)
    gains: Backward | None = None
    while True:
        found = sweep(problem, state.z, state.u, mu=state.mu, into=gains)
        gains = found.gains
        if not found.ok:
            why = f"the sweep failed at step {found.gains.failed_at}"
            return _not_finite(problem, state, why, trace)
        predicted = found.gains.d1 + found.gains.d2
        if -predicted <= options.tolerance * abs(state.cost) + 1e-14:
            small = found.mu < LARGE_MU  # or else it is mu that makes the change small
            return _result("converged" if small else "no improvement", state, found, trace)
        if len(trace) >= options.max_iterations:
            return _result("max iterations", state, found, trace)
        state, line = _search(problem, state, found, options)
        trace.append(line)
        if line.alpha == 0.0 and state.mu > CEILING:
            return _result("no improvement", state, found, trace)


def damped_step(problem: Problem, z: Array, u: Array, damping: Array) -> Sweep:
    """One step about a given trajectory, a real trial's: k, K with Q_uu + diag(damping).

    Args:
        problem: with the bias that makes the model replay the trial.
        z: (H+1, nz) the trial's states and past inputs.
        u: (H, m) its inputs.
        damping: (m,) non-negative, such as `natural_damping`.

    Raises:
        GroundedError: for arrays that do not fit the problem.
    """
    _check(problem, u, None, z)
    return sweep(problem, z, u, damping)


def natural_damping(problem: Problem, factor: float = 1.0) -> Array:
    """Damping in the problem's own units (m,): factor times the inputs' curvature 2 (R + S)."""
    return factor * input_scale(problem)


@dataclass(frozen=True, eq=False)
class _State:
    z: Array
    u: Array
    cost: float
    mu: float


def _search(
    problem: Problem, state: _State, found: Sweep, options: Options
) -> tuple[_State, Iteration]:
    """The first alpha that keeps its promise, or a higher regularisation."""
    gains, alphas = found.gains, np.float64(0.5) ** np.arange(options.halvings + 1)
    predicted = gains.d1 + gains.d2
    for some in (alphas[:1], alphas[1:5], alphas[5:]):  # the first is nearly always enough
        swarm = problem.system.rollout(problem, state.u, gains.K, state.z, gains.k, some)
        enough = swarm.cost - state.cost <= options.accept * (some * gains.d1 + some**2 * gains.d2)
        if enough.any():
            i = int(np.argmax(enough))
            cost, mu = float(swarm.cost[i]), _lower(found.mu)
            line = Iteration(cost, predicted, float(some[i]), found.mu)
            return _State(swarm.z[i], swarm.u[i], cost, mu), line
    line = Iteration(state.cost, predicted, 0.0, found.mu)
    return replace(state, mu=max(SEARCH_FLOOR, GROWTH * found.mu)), line


def _lower(mu: float) -> float:
    return mu / GROWTH if mu / GROWTH >= FLOOR else 0.0


def _result(status: Status, state: _State, found: Sweep, trace: list[Iteration]) -> Result:
    sentences = {
        "converged": f"converged after {len(trace)} iterations",
        "max iterations": f"stopped after {len(trace)} iterations, still improving",
        "no improvement": "no step along the search direction lowers the cost any more",
    }
    gains = found.gains
    return Result(
        status, sentences[status], state.z, state.u, gains.k, gains.K, state.cost, tuple(trace)
    )


def _first_bad(problem: Problem, z: Array) -> str:
    system, bad = problem.system, ~np.isfinite(z[:, : problem.system.n])
    if not bad.any():
        return "the cost of the first rollout is not finite"
    when = int(np.argmax(bad.any(axis=1)))
    name = system.states[int(np.argmax(bad[when]))]
    return (
        f"the first rollout leaves the finite numbers at step {when}, state '{name}' "
        f"(the model is at {system.source})"
    )


def _not_finite(problem: Problem, state: _State, why: str, trace: list[Iteration]) -> Result:
    k, K = np.zeros(state.u.shape), np.zeros((*state.u.shape, problem.nz))
    return Result("not finite", why, state.z, state.u, k, K, state.cost, tuple(trace))


def _check(problem: Problem, u: Array, K: Array | None, z: Array | None) -> None:
    H, m, nz = problem.horizon, problem.system.m, problem.nz
    if u.shape != (H, m):
        raise GroundedError(f"inputs must have shape {(H, m)}, got {u.shape}")
    if K is not None and K.shape != (H, m, nz):
        raise GroundedError(f"a gain must have shape {(H, m, nz)}, got {K.shape}")
    if K is not None and z is None:
        raise GroundedError("a gain needs the reference zbar it is about")
    if z is not None and z.shape not in ((H, nz), (H + 1, nz)):
        raise GroundedError(f"a reference must have shape {(H + 1, nz)}, got {z.shape}")
