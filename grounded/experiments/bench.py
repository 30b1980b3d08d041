"""A bench: one manoeuvre, one crude model, one simulated real car, and the optimum between them.

    parametric   the real car is the model with every parameter times an independent U[0.8, 1.2]
    structural   the real car has effects that the model has no terms for (`real_car`), its latency,
                 and calibration errors of the size declared there, with random signs
    noise        structural, and every run scatters as the real car does

The optimum is what the search reaches when it plans with the TRUE model and latency: no method sees
it. It is a local optimum, like the paper's; `share` of the gap may therefore exceed one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grounded.experiments.car_tasks import LATENCY as MODELLED
from grounded.experiments.car_tasks import car_task
from grounded.experiments.real_car import CALIBRATION, SCATTER, real_car
from grounded.experiments.real_car import LATENCY as TRUE
from grounded.experiments.scatter import start_of
from grounded.frozen import Array
from grounded.improve import learn
from grounded.models.car import model as car
from grounded.plant import Noise, Plant
from grounded.policy import Policy
from grounded.search import Candidate, Options
from grounded.task import Task
from grounded.trial import Trial

KINDS = ("parametric", "structural", "noise")
SPREAD = 0.2


@dataclass(frozen=True, eq=False)
class Bench:
    """`task` has the crude model, `truth` the same task with the true model and latency."""

    task: Task
    truth: Task
    plant: Plant
    seed: int

    def real(self, policy: Policy, run: int) -> Trial:
        """The `run`-th real run of the study."""
        rng = np.random.default_rng([self.seed, 11, run])
        return self.plant.run(policy, start_of(self.task), rng)

    def share(self, utility: float | Array, base: float, optimum: float) -> Array:
        """How much of the gap between the model's own policy and the optimum is closed."""
        return (np.asarray(utility, dtype=float) - base) / (optimum - base)


def bench(manoeuvre: str, kind: str, seed: int) -> Bench:
    """One case: a manoeuvre ("turn", "circle", "figure8"), a kind of error, a seed."""
    rng = np.random.default_rng([seed, 3])
    if kind == "parametric":
        wrong = car.values * rng.uniform(1 - SPREAD, 1 + SPREAD, len(car.values))
        model = car.with_values(dict(zip(car.param_names, wrong, strict=True)))
        latency = dict.fromkeys(car.input_names, MODELLED)
    else:
        signs = rng.choice([-1.0, 1.0], len(CALIBRATION))
        factors = {
            name: 1 + sign * (value - 1)
            for sign, (name, value) in zip(signs, CALIBRATION.items(), strict=True)
        }
        model, latency = real_car(factors), TRUE
    noise = SCATTER if kind == "noise" else Noise()
    task = car_task(manoeuvre, car)
    known = np.array([latency[name] for name in car.input_names])
    truth = replace(task.with_model(model), latency=known)
    return Bench(task, truth, Plant(model=model, latency=latency, noise=noise), seed)


def optimum(case: Bench) -> tuple[Policy, float]:
    """The best policy found with the true model, and its utility in the quiet plant."""
    quiet = replace(case, plant=replace(case.plant, noise=Noise()))

    def run(candidate: Candidate) -> Trial:
        return quiet.real(candidate.policy, 0)

    options = Options(step="full", max_trials=30, max_halvings=6)
    standing, _, _ = learn(case.truth, run, options)
    assert standing.incumbent is not None
    return standing.incumbent.candidate.policy, standing.incumbent.utility
