"""The solver's problems, and their solution by CasADi and Crocoddyl; `run.py` calls it.

    python benchmarks/peers.py casadi|crocoddyl CASE.npz BEST

    car       n = 6 + 2 previous inputs, m = 2, H = 200: 10 s on a circle at 20 Hz, without the
              model's stall and braking, so that every solver sees smooth functions
    aircraft  n = 12 + 4, m = 4, H = 3000: the 60 s figure-8 of section 5.1 at 50 Hz

Inputs have no limits (plain DDP peers have none). All solvers start from the same rollout, and z
includes the previous input. Prints a JSON line.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
from helpers import fastest

from grounded.compile.problem import Problem
from grounded.experiments.car_tasks import car_task
from grounded.experiments.figure8 import flight_task
from grounded.models import aircraft, car
from grounded.search.first_guess import first_guess

CLOSE = 1e-4  # relative distance from the best known cost at which a solver is done
STEP = 6e-6  # of Crocoddyl's differences
xp: ModuleType = np  # whose functions the smooth car calls; see `load`


def smooth_dynamics(s, a, p):
    delta_dot = (p.a1 * a.steering + p.b1 - s.delta) / p.tau_delta
    v_dot = (p.a2 * a.throttle + p.b2 - s.v) / p.tau_v
    cd, sd = xp.cos(s.delta), xp.sin(s.delta)
    return {
        "delta": delta_dot,
        "v": v_dot,
        "x": s.v * cd * xp.cos(s.psi),
        "y": s.v * cd * xp.sin(s.psi),
        "psi": s.v * sd / p.L,
        "psi_rate": (v_dot * sd + s.v * cd * delta_dot) / p.L,
    }


SMOOTH = ("a1", "b1", "a2", "b2", "tau_delta", "tau_v", "L")
MODELS = {
    "car": replace(
        car.model,
        name="smooth car",
        params={name: car.model.params[name] for name in SMOOTH},
        derivative=smooth_dynamics,
    ),
    "aircraft": aircraft.model,
}


@dataclass(frozen=True, eq=False)
class Case:
    """A problem and the trajectory that every solver starts from."""

    name: str
    problem: Problem
    u: np.ndarray
    z: np.ndarray

    def save(self, folder: Path) -> Path:
        """Save the case as arrays."""
        p = self.problem
        path = folder / f"{self.name}.npz"
        np.savez(
            path, name=self.name, p=p.p, dt=p.dt, start=p.start, past=p.past, target=p.target,
            weight=p.state_weight, R=p.input_weight, S=p.change_weight, u=self.u, z=self.z,
        )  # fmt: skip
        return path


def case(name: str) -> Case:
    """Return a problem with its start."""
    if name == "car":
        task = replace(car_task("circle", MODELS[name]), latency=np.zeros(2))
    else:
        task = flight_task(MODELS[name])
    free = np.full(task.model.m, np.inf)
    problem = task.problem()
    target = np.nan_to_num(problem.target)
    problem = replace(problem, low=-free, high=free, target=target, smoothing=0.0)
    if name == "car":  # the inputs of the steady circle, open loop: about 0.5 m off at the end
        run = problem.system.rollout(problem, np.tile([0.32, 0.55], (problem.horizon, 1)))
    else:
        guess = first_guess(task)
        run = problem.system.rollout(problem, guess.inputs, guess.gain, guess.z[:-1])
    return Case(name, problem, run.u[0], run.z[0])


def load(path: str, best: str, module: ModuleType) -> SimpleNamespace:
    """Load a saved case, whose model calls the functions of a module."""
    loaded = SimpleNamespace(**dict(np.load(path)))
    loaded.name, loaded.dt, loaded.best = str(loaded.name), float(loaded.dt), float(best)
    model = MODELS[loaded.name]
    model.derivative.__globals__["xp" if loaded.name == "car" else "np"] = module

    def rate(x, u, p):
        named = (
            SimpleNamespace(**dict(zip(names, values, strict=True)))
            for names, values in ((model.states, x), (model.inputs, u), (model.params, p))
        )
        values = model.derivative(*named)
        return [values[state] for state in model.states]

    def step(x, u):
        def moved(k, h):
            return [a + h * b for a, b in zip(x, k, strict=True)]

        dt, p = loaded.dt, loaded.p.tolist()
        k1 = rate(x, u, p)
        k2 = rate(moved(k1, dt / 2), u, p)
        k3 = rate(moved(k2, dt / 2), u, p)
        k4 = rate(moved(k3, dt), u, p)
        return [
            a + dt / 6 * (b + 2 * c + 2 * d + e)
            for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True)
        ]

    loaded.step = step
    loaded.H, loaded.m = loaded.u.shape
    loaded.n = len(loaded.start)
    loaded.repeats = 1 if loaded.name == "aircraft" else 3  # of a slow peer's timing
    loaded.reached = lambda cost: cost <= loaded.best * (1 + CLOSE)
    return loaded


def casadi(case: SimpleNamespace) -> dict[str, object]:
    """Ipopt, multiple shooting, exact sparse derivatives in CasADi's virtual machine."""
    import casadi as ca

    started = time.process_time()
    n, m, H = case.n, case.m, case.H
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
    F = ca.Function("F", [x, u], [ca.vertcat(*case.step(ca.vertsplit(x), ca.vertsplit(u)))])
    X = [ca.MX.sym(f"x{t}", n + m) for t in range(H + 1)]
    U = [ca.MX.sym(f"u{t}", m) for t in range(H)]
    cost, g, w, guess = 0, [], [], []
    for t in range(H + 1):
        e = X[t][:n] - case.target[t]
        cost += ca.dot(case.weight[t], e * e)
        w.append(X[t])
        guess.append(case.z[t])
        if t == H:
            break
        d = U[t] - X[t][n:]
        cost += ca.dot(case.R, U[t] * U[t]) + ca.dot(case.S, d * d)
        g.append(X[t + 1] - ca.vertcat(F(X[t][:n], U[t]), U[t]))
        if t == 0:
            g.append(X[0] - np.concatenate([case.start, case.past]))
        w.append(U[t])
        guess.append(case.u[t])
    nlp = {"x": ca.vertcat(*w), "f": cost, "g": ca.vertcat(*g)}
    options = {"print_time": False, "expand": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    solver = ca.nlpsol("solver", "ipopt", nlp, options | {"ipopt.tol": 1e-6})
    built, start = time.process_time() - started, np.concatenate(guess)

    def solve():
        return solver(x0=start, lbg=0, ubg=0)

    value = float(solve()["f"])
    return {
        "peer": "CasADi + Ipopt", "version": ca.__version__, "build_s": built, "cost": value,
        "iterations": solver.stats().get("iter_count"), "reached": case.reached(value),
        "ms": 1e3 * fastest(solve, case.repeats),
    }  # fmt: skip


def crocoddyl(case: SimpleNamespace) -> dict[str, object]:
    """DDP in C++, the model in NumPy, derivatives differenced; and its backward pass alone."""
    import crocoddyl

    n, m = case.n, case.m

    def step(x, u):  # a batch; columns are samples
        return np.array(case.step(list(x), list(u)))

    class Node(crocoddyl.ActionModelAbstract):
        def __init__(self, t):
            super().__init__(crocoddyl.StateVector(n + m), m if t < case.H else 0)
            self.t = t

        def calc(self, data, z, u=None):
            e = z[:n] - case.target[self.t]
            data.cost = case.weight[self.t] @ e**2
            if u is None or self.t == case.H:
                data.xnext = z
                return
            data.cost += case.R @ u**2 + case.S @ (u - z[n:]) ** 2
            data.xnext = np.concatenate([step(z[:n], u), u])

        def calcDiff(self, data, z, u=None):
            e = z[:n] - case.target[self.t]
            data.Lx = np.concatenate([2 * case.weight[self.t] * e, np.zeros(m)])
            data.Lxx = np.diag(np.concatenate([2 * case.weight[self.t], np.zeros(m)]))
            if u is None or self.t == case.H:
                return
            d = u - z[n:]
            data.Lx[n:] = -2 * case.S * d
            data.Lxx[n:, n:] = np.diag(2 * case.S)
            data.Lu = 2 * case.R * u + 2 * case.S * d
            data.Luu = np.diag(2 * (case.R + case.S))
            data.Lxu[n:] = -2 * np.diag(case.S)
            h = STEP * np.maximum(1, np.abs(np.concatenate([z[:n], u])))
            point = np.concatenate([z[:n], u])[:, None]
            both = np.hstack([point + np.diag(h), point - np.diag(h)])
            y = step(both[:n], both[n:])
            J = (y[:, : n + m] - y[:, n + m :]) / (2 * h)
            data.Fx[:n, :n], data.Fu[:n], data.Fu[n:] = J[:, :n], J[:, n:], np.eye(m)

    start = np.concatenate([case.start, case.past])
    problem = crocoddyl.ShootingProblem(start, [Node(t) for t in range(case.H)], Node(case.H))
    solver = None

    def solve(iterations):
        nonlocal solver
        solver = crocoddyl.SolverDDP(problem)
        solver.th_stop = 1e-16
        solver.solve(list(case.z), list(case.u), iterations, True)
        return solver.cost

    iterations = next((k for k in range(1, 30) if case.reached(solve(k))), 30)
    return {
        "peer": "Crocoddyl, NumPy", "version": crocoddyl.__version__, "iterations": iterations,
        "cost": solve(iterations), "ms": 1e3 * fastest(lambda: solve(iterations), case.repeats),
        "backward_ms": 1e3 * fastest(solver.backwardPass, 10),
    }  # fmt: skip


def main() -> None:
    """Solve a case with a peer."""
    peer, path, best = sys.argv[1:]
    if peer == "casadi":
        import casadi as module

        module.abs = module.fabs  # NumPy's name
        found = casadi(load(path, best, module))
    else:
        found = crocoddyl(load(path, best, np))
    print(json.dumps({"case": Path(path).stem, **found}))


if __name__ == "__main__":
    main()
