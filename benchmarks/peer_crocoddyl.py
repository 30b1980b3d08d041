"""Crocoddyl: DDP in C++, the model in NumPy (its Python interface), derivatives differenced.

Also times its C++ backward pass alone, which does not depend on the model's speed.
"""

from __future__ import annotations

import crocoddyl
import numpy as np
from peer_data import fastest, load, reached, report, rk4

case = load(np)
n, m = case.n, case.m
STEP = 6e-6


def step(x, u):
    """Step a batch; columns are samples."""
    return np.array(rk4(case.rate, list(x), list(u), case.p, case.dt))


class Node(crocoddyl.ActionModelAbstract):
    """A node with z = [x, previous u]."""

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


problem = crocoddyl.ShootingProblem(
    np.concatenate([case.start, case.past]), [Node(t) for t in range(case.H)], Node(case.H)
)


def solve(iterations):
    solver = crocoddyl.SolverDDP(problem)
    solver.th_stop = 1e-16
    solver.solve(list(case.z), list(case.u), iterations, True)
    return solver


iterations = 1
while not reached(case, (solver := solve(iterations)).cost) and iterations < 30:
    iterations += 1
report(
    peer="Crocoddyl, NumPy model",
    version=crocoddyl.__version__,
    case=case.name,
    ms=1e3 * fastest(lambda: solve(iterations), case.repeats),
    iterations=iterations,
    cost=solver.cost,
    backward_ms=1e3 * fastest(solver.backwardPass, 10),
)
