"""Workspaces for tests: a cart that needs milliseconds, or one of the examples."""

from __future__ import annotations

import re
from pathlib import Path

from grounded_trials import Workspace
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


def blank(folder: Path, model: str, dt: float | None = None, **keys: str) -> Workspace:
    """Make a workspace from the text of a model alone; `keys` as in `edit`."""
    source = folder.parent / "given.py"
    source.write_text(model)
    edit(Workspace.create(folder, model=source, dt=dt).folder, **keys)
    return Workspace(folder)


def edit(folder: Path, **keys: str) -> None:
    """Write values into grounded.toml: of keys that it has, of `effects`, or of whole tables."""
    file = folder / "grounded.toml"
    text = file.read_text()
    for key, value in keys.items():
        if key == "effects":
            text = re.sub(r"(?m)^effects = .*\n", "", text)
            text = text.replace("[task]", f"effects = [{value}]\n[task]", 1)
        elif key in ("limits", "safety", "system"):
            text = re.sub(rf"(?ms)^\[{key}\].*?(?=^\[|\Z)", "", text)
            text += f"\n[{key}]\n{value}\n" * bool(value)
        else:
            assert re.search(rf"(?m)^{key} = ", text)
            text = re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", text)
    file.write_text(text)


def _rest_to_rest(t: float) -> float:
    return 10 * t**3 - 15 * t**4 + 6 * t**5
