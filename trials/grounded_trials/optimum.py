"""The optimum of a SIMULATED real system, for studies and demos: the search never sees it.

The same search, given the true model and the true latency as its crude model, on the quiet system.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grounded.improve import learn
from grounded.plant import Noise
from grounded.search import Candidate, Options
from grounded.trial import Trial
from grounded_trials.running import simulated_plant
from grounded_trials.workspace import Workspace

TRIALS = 30


def optimum(workspace: Workspace) -> float | None:
    """The best utility found with the true model; None where the system is not simulated.

    Also None where the true model has other states than the crude one: then no task fits it.
    """
    if not workspace.config.system.model:
        return None
    task, plant = workspace.task, replace(simulated_plant(workspace), noise=Noise())
    model = plant.model
    if (model.state_names, model.input_names) != (task.model.state_names, task.model.input_names):
        return None
    delays = np.array([plant.latency.get(name, 0.0) for name in model.input_names])
    truth = replace(task.with_model(model), latency=delays)
    start = dict(zip(model.state_names, map(float, task.start), strict=True))

    def run(candidate: Candidate) -> Trial:
        return plant.run(candidate.policy, start, np.random.default_rng(0))

    standing, _, _ = learn(truth, run, Options(max_trials=TRIALS, tolerance=1e-4))
    return standing.incumbent.utility if standing.incumbent else None
