"""DDP: the method A of the paper, "find a locally optimal policy of a simulator".

About a trajectory (zbar, ubar) the problem is replaced by its quadratic model (Gauss-Newton: the
curvature of the dynamics is left out), and the value of being at z_t is swept back in time,

    V_t(dz) = min over du of  1/2 [dz du]' Q_t [dz du] + [Q_z Q_u] [dz du],

whose minimiser is du = k_t + K_t dz. The nonlinear model is then rolled out with these gains,

    u_t = clip( ubar_t + alpha k_t + K_t (z_t - zbar_t) ),   alpha = 1, 1/2, 1/4, ...

until the cost falls by at least a tenth of the predicted alpha d1 + alpha^2 d2. A failed sweep or
search raises the regularisation mu of Q_uu (in units of the inputs' own weights), a success lowers
it. A search that ends under regularisation sweeps once more, with the least that factorises: its
gains are handed out, and damped ones hardly feed back. Three things are this project's own:

- the state is z = [x, inputs already sent], so input changes and transport delays are exact;
- limits of the inputs are part of each step's quadratic programme (Tassa, Mansard, Todorov,
  "Control-limited differential dynamic programming", ICRA 2014): clamped inputs get no feedback;
- the damping of Q_uu is added when the step is chosen, and left out of V (Tassa, Erez, Todorov,
  IROS 2012, eq. 11), so that d1 and d2 predict the true quadratic change.

`solve` runs to convergence: 4 iterations on a car (H = 200), 5 on a 6-DOF aircraft (H = 3000). What
keeps the search close to a trial is a price on leaving its inputs, part of the problem itself
(`directions.damped`). The sweep itself belongs to a system (`interpreted.py`, or a compiled
kernel); `sweep` here makes it succeed, by raising mu until every Q_uu is positive definite.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from grounded.checks import of_shape, wrong
from grounded.compile.problem import (
    CEILING,
    FLOOR,
    GROWTH,
    LARGE_MU,
    NO_CHANGE,
    SEARCH_FLOOR,
    Backward,
    Controls,
    Descent,
    DescentOptions,
    Problem,
    Status,
)
from grounded.frozen import Array


@dataclass(frozen=True)
class Iteration:
    """One line of the trace."""

    cost: float
    predicted: float  # change of cost the quadratic model promised at alpha = 1
    alpha: float  # 0: no alpha was accepted
    mu: float


@dataclass(frozen=True, eq=False)
class Solution:
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
    options: DescentOptions | None = None,
    each: Callable[[int, float], None] | None = None,
) -> Solution:
    """DDP from the rollout of ubar (H, m), or of the policy ubar + K (z - zbar).

    Args:
        problem: what to solve.
        ubar: first inputs.
        K: (H, m, nz) feedback of the first rollout only.
        zbar: (H, nz) or (H+1, nz), the reference of K.
        options: settings.
        each: called with the number of iterations so far and the cost; not by compiled systems.

    Raises:
        GroundedError: for arrays that do not fit the problem.
    """
    options = options or DescentOptions()
    _check(problem, ubar, K, zbar)
    first = Controls(ubar, K, zbar)
    found = problem.system.descend(problem, first, options)
    return _solution(problem, found or descended(problem, first, options, each))


@dataclass(frozen=True, eq=False)
class _State:
    z: Array
    u: Array
    cost: float
    mu: float


def descended(
    problem: Problem,
    first: Controls,
    options: DescentOptions,
    each: Callable[[int, float], None] | None = None,
) -> Descent:
    """The loop of `solve`; a compiled system has the same in one kernel (`System.descend`)."""
    run = problem.system.rollout(problem, *first)
    state = _State(run.z[0], run.u[0], float(run.cost[0]), 0.0)
    lines: list[tuple[float, float, float, float]] = []
    gains: Backward | None = None
    gained = np.inf  # by the last accepted step

    def ended(status: Status, failed_at: int = -1) -> Descent:
        k, K = (np.zeros(0), np.zeros(0)) if gains is None else (gains.k, gains.K)
        trace = np.array(lines).reshape(-1, 4)
        return Descent(status, state.z, state.u, k, K, state.cost, failed_at, trace)

    if not np.isfinite(state.cost):
        return ended("not finite")
    while True:
        found = sweep(problem, state.z, state.u, mu=state.mu)
        gains = found.gains
        if not found.ok:
            return ended("not finite", gains.failed_at)
        promised = -(gains.d1 + gains.d2)
        if promised <= options.tolerance * abs(state.cost) + NO_CHANGE or gained < options.enough:
            small = found.mu < LARGE_MU  # or else it is mu that makes the change small
            return ended("converged" if small else "no improvement")
        if len(lines) >= options.max_iterations:
            return ended("max iterations")
        before = state.cost
        state, alpha = _search(problem, state, found, options)
        gained = before - state.cost if alpha else gained
        lines.append((state.cost, gains.d1 + gains.d2, alpha, found.mu))
        if each is not None:
            each(len(lines), state.cost)
        if alpha == 0.0 and state.mu > CEILING:
            return ended("no improvement")


def _search(
    problem: Problem, state: _State, found: Sweep, options: DescentOptions
) -> tuple[_State, float]:
    """The first alpha that keeps its promise; 0 and a higher regularisation if none does."""
    gains, alphas = found.gains, np.float64(0.5) ** np.arange(options.halvings + 1)
    if found.mu:
        alphas = alphas[: options.damped + 1]
    parts = (alphas[:1], alphas[1:5], alphas[5:])  # the first is nearly always enough
    for some in filter(len, parts):
        swarm = problem.system.rollout(problem, state.u, gains.K, state.z, gains.k, some)
        enough = swarm.cost - state.cost <= options.accept * (some * gains.d1 + some**2 * gains.d2)
        if enough.any():
            i = int(np.argmax(enough))
            mu = found.mu / GROWTH if found.mu / GROWTH >= FLOOR else 0.0
            return _State(swarm.z[i], swarm.u[i], float(swarm.cost[i]), mu), float(some[i])
    return replace(state, mu=max(SEARCH_FLOOR, GROWTH * found.mu)), 0.0


def _solution(problem: Problem, found: Descent) -> Solution:
    trace = tuple(Iteration(*line) for line in found.lines.tolist())
    sentence = ending(found.status, len(trace))
    k, K = found.k, found.K
    if found.status != "not finite" and trace and trace[-1].mu > 0:
        gains = sweep(problem, found.z, found.u).gains
        k, K = gains.k, gains.K
    if found.status == "not finite":
        k, K = np.zeros(found.u.shape), np.zeros((*found.u.shape, problem.nz))
        first = _first_bad if found.failed_at < 0 else _first_slope
        sentence = first(problem, found)
    return Solution(found.status, sentence, found.z, found.u, k, K, found.cost, trace)


def ending(status: Status, iterations: int) -> str:
    """Why a search ended, as a sentence; "" for one that left the finite numbers."""
    return {
        "converged": f"converged after {iterations} iterations",
        "max iterations": f"stopped after {iterations} iterations, still improving",
        "no improvement": "no step along the search direction lowers the cost any more",
    }.get(status, "")


def _first_bad(problem: Problem, found: Descent) -> str:
    """Where the first rollout leaves the finite numbers, as a sentence."""
    system, z = problem.system, found.z
    bad = ~np.isfinite(z[:, : system.n])
    if not bad.any():
        return "the cost of the first rollout is not finite"
    when = int(np.argmax(bad.any(axis=1)))
    name = system.states[int(np.argmax(bad[when]))]
    time = f"{when * problem.dt:g} s (step {when})"
    text = f"the model leaves the finite numbers at {time}, in state '{name}'"
    before = max(when - 1, 0)
    given = problem.received(z[before], found.u[min(before, len(found.u) - 1)], before)
    fault = system.fault(z[before, : system.n], given, problem.p, problem.dt)
    return f"{text} ({fault or system.source})"


def _first_slope(problem: Problem, found: Descent) -> str:
    """Which derivative the first sweep failed on, as a sentence."""
    system, x = problem.system, found.z[:-1, : problem.system.n]
    given = problem.received(found.z[:-1], found.u)
    slopes = system.linearise(x, given, problem.p, problem.dt, problem.smoothing)
    for what, J in zip((system.states, system.inputs), slopes, strict=True):
        for t, i, j in np.argwhere(~np.isfinite(J))[:1]:
            return (
                f"the derivative of state '{system.states[i]}' by '{what[j]}' is not finite at "
                f"{t * problem.dt:g} s ({system.source})"
            )
    return f"the sweep failed at {found.failed_at * problem.dt:g} s (step {found.failed_at})"


def _check(problem: Problem, u: Array, K: Array | None, z: Array | None) -> None:
    H, m, nz = problem.horizon, problem.system.m, problem.nz
    of_shape("inputs", u, (H, m))
    if K is not None:
        of_shape("gain", K, (H, m, nz))
    if K is not None and z is None:
        raise wrong("reference", got="None", shape=str((H + 1, nz)))
    if z is not None and z.shape not in ((H, nz), (H + 1, nz)):
        raise wrong("reference", z.shape, shape=str((H + 1, nz)))


@dataclass(frozen=True, eq=False)
class Sweep:
    """Gains of one sweep, and the regularisation `mu` at which it went through."""

    gains: Backward
    mu: float

    @property
    def ok(self) -> bool:
        """Whether the sweep went through at all."""
        return self.gains.failed_at < 0


def sweep(problem: Problem, z: Array, u: Array, mu: float = 0.0) -> Sweep:
    """Sweeps back along z (H+1, nz), u (H, m) with damping mu * problem.input_scale.

    mu grows tenfold after each failure; when it passes 1e10 the failed sweep is returned, with
    `ok` False: the trajectory or the model holds no finite numbers.
    """
    while True:
        gains = problem.system.backward(problem, z, u, mu * problem.input_scale)
        if gains.failed_at < 0 or mu >= CEILING:
            return Sweep(gains, mu)
        mu = max(FLOOR, GROWTH * mu)
