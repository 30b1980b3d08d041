"""Measure CPU time and memory of `fit` and `diagnose` on long logs; run by hand.

    python benchmarks/long_logs.py              all parts, each in a process of its own
    python benchmarks/long_logs.py cars flights

    drive     fit of 10 parameters to 36,000 steps of driving, half an hour at 20 Hz
    cars      diagnose, 8 trials of 200 steps         flights   4 flights of 3,000 steps
    hundred   diagnose, 100 car trials of 1,000 steps

The systems are those of the blind challenge, with its noise: both inputs of the car lag by 0.15 s,
the aircraft's elevator is a fifth weaker, parameters are off by 5 %. Ratios are to the budget.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time

import numpy as np

BUDGET = {
    "drive": (20, 1500),
    "cars": (6, 500),
    "flights": (20, 500),
    "hundred": (60, 1500),
}  # s, MB


def driving(steps, seed=1):
    """Make one log of a car with every parameter off by up to 20 %."""
    from grounded.experiments.driving import hands
    from grounded.experiments.fit_car import true_car
    from grounded.models.car import model
    from grounded.trial import Trial

    rng = np.random.default_rng(seed)
    truth, u = true_car(rng)[0], hands(steps, rng)
    process = np.array([0.002, 0.01, 0.002, 0.002, 0.002, 0.02])
    measured = np.array([0.005, 0.02, 0.01, 0.01, 0.01, 0.03])
    x = np.zeros((steps + 1, 6))
    for t in range(steps):
        after = truth.system.step(x[t : t + 1], u[t : t + 1], truth.values, 0.05)[0]
        x[t + 1] = after + process * rng.standard_normal(6)
    y = x + measured * rng.standard_normal(x.shape)
    names = {"state_names": tuple(model.states), "input_names": tuple(model.inputs)}
    return model, [Trial(dt=0.05, states=y, inputs=u, **names)], truth


def runs(name, trials, steps, seed=1):
    """Make a challenge case with much data: a lagging car, or a weaker elevator."""
    from grounded.challenge import cases, systems
    from grounded.trial import Trial

    rng, system = np.random.default_rng(seed), systems.SYSTEMS[name]()
    truth, dt = system.model, 1 / float(system.rates[0])
    crude = cases._with_errors(truth, 0.05, rng)
    setting = cases._Setting(dt, steps, trials, 1.0, 1.0, False, "white")
    plans = cases._plans(system, crude, setting, rng)[:trials]
    u, x, target, gains = (np.stack([plan[i] for plan in plans]) for i in range(4))
    noise = [
        [each.get(n, 0.0) for n in truth.state_names]
        for each in (system.process, system.measurement)
    ]
    process, measured = np.array(noise[0]) * np.sqrt(dt), np.array(noise[1])
    lag = [round(late / dt) for late in system.latency] or [0] * truth.m
    oldest, held = (
        max(lag) + 1,
        u[:, 0] if name == "aircraft" else np.tile(system.held, (trials, 1)),
    )
    logged, sent, felt = [x + measured * rng.standard_normal(x.shape)], [held] * oldest, held.copy()
    for t in range(steps):
        error = np.clip(truth.difference(logged[-1], target[:, t]), -2.0, 2.0)
        command = u[:, t] + (gains[:, t] @ error[..., None])[..., 0]
        sent.append(np.clip(command, system.low, system.high))
        arrived = np.stack([sent[-1 - late][:, j] for j, late in enumerate(lag)], axis=1)
        felt += (1.0 if name == "aircraft" else dt / (dt + 0.15)) * (arrived - felt)
        acts = felt * np.where(np.arange(truth.m) == 2, 0.8, 1.0) if name == "aircraft" else felt
        x = truth.system.step(x, acts, truth.values, dt)
        x = x + process * rng.standard_normal(x.shape)
        logged.append(x + measured * rng.standard_normal(x.shape))
    y, inputs = np.stack(logged, axis=1), np.stack(sent[oldest:], axis=1)
    names = {"state_names": tuple(truth.states), "input_names": tuple(truth.inputs)}
    found = [
        Trial(dt=dt, states=a, inputs=b, start_inputs=h, id=f"t{i:04d}", **names)
        for i, (a, b, h) in enumerate(zip(y, inputs, held, strict=True))
    ]
    latency = np.array(system.latency or (0.0,) * truth.m)
    limits = {"low": system.low, "high": system.high, "latency": latency}
    about = {"name": name, "system": name, "dt": dt, "target": target[0], "start": x[0]}
    return cases.Case(model=crude, trials=tuple(found), fresh=(), **about, **limits)


def drive():
    """Return the error of the worst fitted value in its own standard deviations."""
    from grounded.fit import fit

    model, trials, truth = driving(36_000)
    begin = time.process_time()
    found = fit(model, trials)
    off = {n: (e.value - truth.params[n].value) / e.std for n, e in found.params.items()}
    worst = max(off, key=lambda n: abs(off[n]))
    return begin, f"{found.sentence}; farthest off: {worst} by {off[worst]:.1f} of its std"


def diagnosed(name, trials, steps):
    """Return what is claimed, and the verdict."""
    from grounded.challenge.score import task_of
    from grounded.diagnosis.diagnose import diagnose

    case = runs(name, trials, steps)
    begin = time.process_time()
    return begin, diagnose(task_of(case), case.trials).verdict


PARTS = {
    "drive": drive,
    "cars": lambda: diagnosed("car", 8, 200),
    "flights": lambda: diagnosed("aircraft", 4, 3000),
    "hundred": lambda: diagnosed("car", 100, 1000),
}


def one(part):
    """Run a part in this process and print its row."""
    begin, said = PARTS[part]()
    seconds = time.process_time() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    most, memory = BUDGET[part]
    print(
        f"{part:8} {seconds:7.1f} s CPU, {seconds / most:5.2f} of {most} s;"
        f" {peak:6.0f} MB, {peak / memory:5.2f} of {memory} MB\n         {said}",
        flush=True,
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--here"]:
        one(sys.argv[2])
    else:
        for each in sys.argv[1:] or PARTS:
            subprocess.run([sys.executable, __file__, "--here", each], check=True)
