"""Split a car demo's gap by its declared differences: an ablation to compare with the diagnosis.

    python benchmarks/demo_truth.py FOLDER ...

Each FOLDER was made by `grounded demo car-turn` (car-circle, car-figure8). Its trials are predicted
open loop, as by the diagnosis' ruler, with the true car and with true cars that lack one of the
declared differences from the crude model (`grounded.experiments.real_car`). Credit is what the
predictions lose without a difference, as a share of what they gain from all, as in a diagnosis;
the rest is not fitted again.
"""

from __future__ import annotations

import sys

import numpy as np

from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.experiments.real_car import CALIBRATION, LATENCY, UNMODELLED, real_car
from grounded_trials import Workspace
from grounded_trials.workspace.last_diagnosis import diagnosable, read_diagnosis

AHEAD, STARTS = (0.1, 0.5, 1.0), 400
THREAD = ("drift", "thread_yaw", "thread_speed", "thread_stall")
CAUSES = {  # what is taken out of the true car
    "parameters (with the steering's offset)": (*CALIBRATION, "steering_offset"),
    "latency": ("latency",),
    "soft servo": ("cubic",),
    "understeer": ("understeer",),
    "carpet's thread": THREAD,
}


def true_car(without=()):
    """Return the declared car without some of its differences, and its latency [s]."""
    car = real_car({k: v for k, v in CALIBRATION.items() if k not in without})
    gone = {name: 0.0 for name in UNMODELLED if name in without}
    latency = dict.fromkeys(LATENCY, 0.1) if "latency" in without else LATENCY
    return car.with_values(gone) if gone else car, np.array(list(latency.values()))


def missed(model, latency, task, trials):
    """Return rms errors (horizons, n) of open-loop predictions, and the spread (n,)."""
    data = prepare(model, trials, latency, task.past)
    predictor = Predictor(data)
    u, longest = predictor.received(Hypothesis()), round(AHEAD[-1] / data.dt)
    first = np.cumsum([0, *(data.lengths + 1)])[:-1]
    at = [(s, t) for s, T in enumerate(data.lengths) for t in range(T - longest)]
    s, t = np.array(at[:: max(1, len(at) // STARTS)]).T
    x, rows = data.filled[first[s] + t], []
    for k in range(1, longest + 1):
        x = predictor.moved(Hypothesis(), x, u[s, t + k - 1])
        if k in [round(ahead / data.dt) for ahead in AHEAD]:
            error = model.difference(data.filled[first[s] + t + k], x)
            rows.append(np.sqrt((error**2).mean(axis=0)))
    return np.array(rows), data.filled.std(axis=0)


def ablation(workspace):
    """Return the credit of each declared difference, largest first."""
    task, trials = workspace.task, diagnosable(workspace)
    crude, spread = missed(task.model, task.latency, task, trials)
    fine = np.maximum(2e-3 * spread, 1e-2 * np.minimum(crude.max(axis=0), spread))

    def gain(before, after):
        return 0.5 * float(np.log((before**2 + fine**2) / (after**2 + fine**2)).mean())

    true = missed(*true_car(), task, trials)[0]
    whole = gain(crude, true)
    lost = {
        cause: gain(missed(*true_car(names), task, trials)[0], true)
        for cause, names in CAUSES.items()
    }
    total = max(whole, sum(lost.values()))
    shares = {cause: loss / total for cause, loss in lost.items()}
    return dict(sorted(shares.items(), key=lambda pair: -pair[1]))


def main():
    for folder in sys.argv[1:]:
        workspace = Workspace(folder)
        shown = ", ".join(f"{n} {100 * share:.1f} %" for n, share in ablation(workspace).items())
        print(f"{folder}\n  declared truth: {shown}")
        if found := read_diagnosis(workspace.reports):
            named = ", ".join(f"{c.of} {100 * c.share:.1f} %" for c in found.credit)
            print(f"  diagnosis: {named}")


if __name__ == "__main__":
    main()
