"""The benchmark's two problems, as grounded sees them and as files for its peers.

    car       n = 6 + 2 previous inputs, m = 2, H = 200: 10 s on a circle at 20 Hz
    aircraft  n = 12 + 4, m = 4, H = 3000: the 60 s figure-8 of section 5.1 at 50 Hz

Inputs have no limits (plain DDP peers have none). All solvers start from the same rollout.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from peer_data import MODELS

from grounded.compile import Problem
from grounded.experiments.car_tasks import car_task
from grounded.experiments.figure8 import flight_task
from grounded.search.first_guess import first_guess


@dataclass(frozen=True, eq=False)
class BenchmarkCase:
    """A problem and the trajectory that every solver starts from."""

    name: str
    problem: Problem
    u: np.ndarray
    z: np.ndarray

    def save(self, folder: Path) -> Path:
        """Save the case as arrays, for the peers."""
        p = self.problem
        path = folder / f"{self.name}.npz"
        np.savez(
            path, name=self.name, p=p.p, dt=p.dt, start=p.start, past=p.past, target=p.target,
            weight=p.state_weight, R=p.input_weight, S=p.change_weight, u=self.u, z=self.z,
        )  # fmt: skip
        return path


def cases(names=("car", "aircraft")) -> list[BenchmarkCase]:
    """Return both problems with their starts."""
    found = []
    for name in names:
        if name == "car":
            task = car_task("circle", MODELS[name])
            task = dataclasses.replace(task, latency=np.zeros(2))
        else:
            task = flight_task(MODELS[name])
        free = np.full(task.model.m, np.inf)
        problem = dataclasses.replace(task.problem(), low=-free, high=free)
        target = np.nan_to_num(problem.target)
        problem = dataclasses.replace(problem, target=target, smoothing=0.0)
        if name == "car":  # the inputs of the steady circle, open loop: about 0.5 m off at the end
            run = problem.system.rollout(problem, np.tile([0.32, 0.55], (problem.horizon, 1)))
        else:
            guess = first_guess(task)
            run = problem.system.rollout(problem, guess.inputs, guess.gain, guess.z[:-1])
        found.append(BenchmarkCase(name, problem, run.u[0], run.z[0]))
    return found
