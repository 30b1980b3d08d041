"""Which of two models is trusted: `diagnose --compare` on drawn pairs of which one is right.

    python benchmarks/rivals.py [--pairs 10]

The robot is a pendulum with a motor, logged in four runs of 4 s with noise. One model of a pair has
the true values, the other one or two of the four off by 5 to 30 %. A second pair for each robot
differs by 0.002 % in one value, far below what these logs show. Printed: which one was trusted.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial

DT, STEPS, RUNS, FINE = 0.02, 200, 4, 10
NOISE = 1e-3, 1e-2  # rad, rad/s
MODEL = """import numpy as np

from grounded import Model, Param


def dynamics(s, a, p):
    torque = p.K * a.motor - p.b * s.w - p.c * np.tanh(s.w / 0.02) - p.g * np.sin(s.q)
    return {"q": s.w, "w": torque}


model = Model(
    states={"q": "rad", "w": "rad/s"},
    inputs={"motor": "V"},
    params={n: Param(1.0, "1", 0.0, 100.0) for n in ("K", "b", "c", "g")},
    derivative=dynamics,
)
"""
TOML = """[model]
file = "model.py"

[task]
dt = 0.02

[reward]
state = { q = 1.0 }
"""


def run(p: dict[str, float], u: np.ndarray) -> np.ndarray:
    """Return the states (T + 1, 2) of the robot, in ten Euler steps a control step."""
    q, w, path = 0.0, 0.0, []
    for now in (*u, 0.0):
        path.append((q, w))
        for _ in range(FINE):
            torque = p["K"] * now - p["b"] * w - p["c"] * np.tanh(w / 0.02) - p["g"] * np.sin(q)
            q, w = q + w * DT / FINE, w + torque * DT / FINE
    return np.array(path)


def pair(seed: int) -> tuple[str, str]:
    """Return which of two models is trusted, and which of two that no log can tell apart."""
    rng = np.random.default_rng(seed)
    ranges = {"K": (5, 15), "b": (0.2, 1.0), "c": (0.2, 1.0), "g": (10, 30)}
    true = {name: float(rng.uniform(*ends)) for name, ends in ranges.items()}
    names = rng.choice(list(true), rng.integers(1, 3), replace=False)
    wrong = {
        n: v * (1 + rng.choice([-1, 1]) * rng.uniform(0.05, 0.3) * (n in names))
        for n, v in true.items()
    }
    near = {**true, "b": true["b"] * 1.00002}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "model.py").write_text(MODEL)
        (folder / "grounded.toml").write_text(TOML)
        for name, values in {"right": true, "wrong": wrong, "near": near}.items():
            (folder / f"{name}.yaml").write_text("".join(f"{n}: {v}\n" for n, v in values.items()))
        w = Workspace(folder)
        for k in range(RUNS):
            t = DT * np.arange(STEPS)
            u = rng.uniform(0.5, 1.5) * np.sin(rng.uniform(1, 8) * t) + rng.uniform(-1, 1)
            x = run(true, u) + rng.normal(size=(STEPS + 1, 2)) * NOISE
            path = folder / f"{k}.mcap"
            write_trial(path, Trial(x, u[:, None], DT, ("q", "w"), ("motor",)), {"kind": "trial"})
            w.ingest(path, data=True)
        order = ["right", "wrong"] if seed % 2 else ["wrong", "right"]
        found = [
            w.compare(*(folder / f"{n}.yaml" for n in both)) for both in (order, ["right", "near"])
        ]
        for name, one in found[0].numbers.items():
            values = " / ".join(one.values or ())
            print(f"  {name}: {values}, better: {Path(one.better or '-').stem}")
    first, second = (Path(one.better or "undecided").stem for one in found)
    return first, second


def main() -> None:
    """Print which one was trusted in each pair."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=10)
    found = []
    for seed in range(parser.parse_args().pairs):
        found.append(pair(seed))
        print(f"pair {seed}: trusted {found[-1][0]}; of two alike {found[-1][1]}", flush=True)
    trusted, alike = zip(*found, strict=True)
    print(f"right: {trusted.count('right')}, wrong: {trusted.count('wrong')}, of {len(found)}")
    print(f"two alike: {alike.count('undecided')} of {len(found)} undecided")


if __name__ == "__main__":
    main()
