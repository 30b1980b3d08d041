"""Repeatability of the car: scatter of the end-points for the same inputs (section 5.2).

"For the same input sequence, the end-points of the trajectories differed from a few centimeters up
to 50cm (for 2 second runs)". The paper attributes this to slightly different starts, and finds it
largest when the car drives around the stalling speed of its motor. Here the simulated real car runs
each sequence from scattered starts and with disturbances, and the spread of its end-points is
measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np

from grounded.experiments.car_tasks import DT, car_task
from grounded.experiments.jobs import Running, StudyTable, every, run_study
from grounded.experiments.real_car import real_plant
from grounded.frozen import Array
from grounded.models.car import model as car
from grounded.plant import Noise, Plant

SECONDS = 2.0
RUNS = 10
LEVELS = (0.0, 1.0, 3.0)  # multiples of the real car's own scatter


def sequences() -> dict[str, Array]:
    """Return open-loop inputs (H, 2), steering and throttle, each for two seconds."""
    H = round(SECONDS / DT)
    t = np.arange(H) * DT
    one = np.ones(H)
    return {
        "straight": np.column_stack([0 * one, 0.5 * one]),
        "circle": np.column_stack([0.35 * one, 0.6 * one]),
        "slalom": np.column_stack([0.6 * np.sin(2 * np.pi * t), 0.55 * one]),
        "near stall": np.column_stack([0.3 * one, 0.205 + 0.02 * np.sin(2 * np.pi * t)]),
    }


@dataclass(frozen=True)
class EndPointSpread:
    """End-points of repeated runs of one sequence [m]."""

    sequence: str
    level: float
    rms: float  # about their mean
    largest: float  # between any two


@dataclass(frozen=True)
class NondeterminismResult:
    """The spread for each sequence and level of scatter."""

    spreads: tuple[EndPointSpread, ...]
    runs: int

    def to_json(self) -> dict[str, Any]:
        """Return the spreads as plain values."""
        paper = {"largest": [0.03, 0.5], "seconds": SECONDS}
        return {"runs": self.runs, "spreads": [vars(s) for s in self.spreads], "paper": paper}

    def tables(self) -> list[StudyTable]:
        """Return the largest distance between two end-points, by sequence and scatter."""
        names = list(dict.fromkeys(s.sequence for s in self.spreads))
        levels = sorted({s.level for s in self.spreads})
        found = {(s.sequence, s.level): s for s in self.spreads}
        rows = [
            (name, *(f"{100 * found[name, level].largest:.1f}" for level in levels))
            for name in names
        ]
        rows.append(("paper", *("a few to 50" if level == 1 else "" for level in levels)))
        head = ("sequence", *(f"scatter x{level:g}" for level in levels))
        title = f"Largest distance between the end-points of {self.runs} runs of {SECONDS:g} s [cm]"
        return [StudyTable(title, head, tuple(rows))]


def run(
    runs: int = RUNS,
    *,
    seed: int = 0,
    **how: Unpack[Running],
) -> NondeterminismResult:
    """Repeat every sequence `runs` times at each level of scatter."""
    cases = every(sequence=sequences(), level=LEVELS, runs=[runs], seed=[seed])
    spreads = run_study(EndPointSpread, nondeterminism_job, cases, **how)
    return NondeterminismResult(spreads, runs)


def nondeterminism_job(sequence: str, level: float, runs: int, seed: int) -> dict[str, Any]:
    """Run one job: the end-points of one sequence."""
    inputs = sequences()[sequence]
    task = car_task("turn", car)
    policy = task.policy(np.zeros((task.horizon, 2)), None, None)
    policy = replace(policy, feedforward=inputs)
    plant = scaled(real_plant(noisy=True), level)
    ends = []
    for i in range(runs):
        rng = np.random.default_rng([seed, i])
        trial = plant.run(policy, {}, rng)
        ends.append(trial.states[-1, 2:4])
    points = np.array(ends)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    rms = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return {"sequence": sequence, "level": level, "rms": rms, "largest": float(apart.max())}


def scaled(plant: Plant, level: float) -> Plant:
    """Return the plant with all noise standard deviations times `level`."""
    kinds = {
        kind: {name: level * std for name, std in getattr(plant.noise, kind).items()}
        for kind in ("start", "process", "measurement")
    }
    return replace(plant, noise=Noise(**kinds))
