"""Workspaces for tests: a cart that needs milliseconds, or one of the examples."""

from __future__ import annotations

from pathlib import Path

from grounded_trials.starting.examples import EXAMPLES, write_example
from grounded_trials.workspace.folder import Folder

MODEL = """import numpy as np

from grounded import Model, Param


def dynamics(s, a, p):
    return {"x": s.v, "v": (a.force - p.drag * s.v) / p.mass}


model = Model(
    states={"x": "m", "v": "m/s"},
    inputs={"force": "N"},
    params={"mass": Param(1.0, "kg", 0.1, 10.0), "drag": Param(0.2, "N s/m", 0.0, 5.0)},
    roles={"position": ("x",), "speed": "v"},
    derivative=dynamics,
)
"""
REAL = """from model import model as crude

model = crude.with_values({"mass": 1.4, "drag": 0.5})
latency = {"force": 0.02}
"""
CONFIG = """[model]
file = "model.py"

[task]
dt = 0.05
horizon = 40
target = "target.csv"

[reward]
state = { x = 10.0 }
input = { force = 0.01 }
input_change = { force = 0.01 }

[limits]
force = [-5.0, 5.0]

[search]
max_trials = 12

[system]
model = "real.py"
"""


def make(folder: Path, example: str = "cart", **files: str) -> Folder:
    """Make a workspace; `files` replaces its config, model, real or target text."""
    if example in EXAMPLES:
        write_example(folder, example)
    else:
        folder.mkdir(parents=True)
        for sub in ("trials", "candidates"):
            (folder / sub).mkdir()
        (folder / "grounded.toml").write_text(CONFIG)
        (folder / "model.py").write_text(MODEL)
        (folder / "real.py").write_text(REAL)
        rows = [f"{0.05 * i:.2f},{_rest_to_rest(i / 40):.6f}" for i in range(41)]
        (folder / "target.csv").write_text("t,x\n" + "\n".join(rows) + "\n")
    names = {
        "config": "grounded.toml",
        "model": "model.py",
        "real": "real.py",
        "target": "target.csv",
    }
    for key, text in files.items():
        (folder / names[key]).write_text(text)
    return Folder(folder)


def _rest_to_rest(t: float) -> float:
    return 10 * t**3 - 15 * t**4 + 6 * t**5
