"""Draw each effect family's signature for docs/effects.md: `python docs/effect_pictures.py docs`.

The model (grey) and the model with one effect (orange) get the same commands. The model is a car,
for effects of a joint a pendulum, for those of a medium a boat. The picture shows the state that
changes most relative to its range: a dynamic one (speed, steering angle, heading rate) if it
changes at all, else a position. The strength is chosen for a change of about a quarter of the
range. Needs the extra `png`.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from grounded import places
from grounded.effects import (
    Effect,
    InputFamily,
    Library,
    LossFamily,
    MediumFamily,
    MemoryFamily,
    ParamFamily,
    RateFamily,
    memory_start,
    scales_of,
    wrap,
)
from grounded.effects.medium import FAMILIES as MEDIUM
from grounded.figures import Figure, curve, panel
from grounded.frozen import Array
from grounded.model import Model
from grounded.models.car import model as car
from grounded.models.pendulum import model as pendulum
from grounded.trial import Trial
from grounded_trials.report.figures.png import png

DT, STEPS = 0.05, 160
CHANGE = 0.25  # as a fraction of a state's range
KINDS = (
    ("input", InputFamily),
    ("memory", MemoryFamily),
    ("joint", LossFamily),
    ("rate", RateFamily | MediumFamily),
    ("param", ParamFamily),
)

Drawn = tuple[str, Array, Array]  # a state's name, its values without and with effect (T + 1,)


def _sailing(s: Any, a: Any, p: Any) -> dict[str, Any]:
    cos, sin = np.cos(s.psi), np.sin(s.psi)
    return {
        "u": 0.7 * (a.thrust - s.u) + s.v * s.r,
        "v": -2.0 * s.v - s.u * s.r,
        "r": a.rudder - 1.5 * s.r,
        "x": s.u * cos - s.v * sin,
        "y": s.u * sin + s.v * cos,
        "psi": s.r,
    }


boat = Model(
    name="boat",
    states={"u": "m/s", "v": "m/s", "r": "rad/s", "x": "m", "y": "m", "psi": "rad"},
    inputs={"rudder": "1", "thrust": "1"},
    angles=("psi",),
    derivative=_sailing,
)


def commands() -> Array:
    """Return steering and throttle (STEPS, 2), of both signs and with steps."""
    t = np.arange(STEPS) * DT
    steering = 0.5 * np.sin(2.0 * t) * np.where(t > 4, 1.0, np.sign(np.sin(2.0 * t)))
    throttle = 0.45 + 0.3 * np.sign(np.sin(1.3 * t))
    return np.stack([steering, throttle], axis=1)


def run(model: Model, base: Model, inputs: Array) -> Array:
    """Simulate a model under the commands; return the states of the base model, (T + 1, n)."""
    start = np.full(base.n, 0.1)
    still = Trial(np.tile(start, (2, 1)), inputs[:1], DT, base.state_names, base.input_names)
    x = start if model.n == base.n else np.hstack([start, memory_start(model, base, still)])
    found = [x]
    for row in inputs:
        found.append(model.system.step(found[-1][None], row[None], model.values, DT)[0])
    return np.array(found)[:, : base.n]


def settings(effect: Effect) -> list[dict[str, float]]:
    """Return parameter values to try: doubling strengths at mid-grid, or the grid itself."""
    linear = [q for q in effect.free if not q.grid]
    scanned = {q.name: np.sort(q.grid) for q in effect.free if q.grid}
    if not linear:
        most = max(map(len, scanned.values()))
        return [{n: float(g[min(k, len(g) - 1)]) for n, g in scanned.items()} for k in range(most)]
    middle = {name: float(grid[len(grid) // 2]) for name, grid in scanned.items()}
    strengths = (0.01 * 2**k for k in range(12))
    return [middle | {q.name: float(np.clip(s, q.low, q.high)) for q in linear} for s in strengths]


def signature(effect: Effect, inputs: Array, plain: Array) -> Drawn:
    """Return the state that changes most, at the strength with a change closest to `CHANGE`."""
    size, model = np.maximum(np.ptp(plain, axis=0), 1e-9), effect.site.model
    fast = [model.state_names.index(name) for name in places.dynamic(model)]
    found = []
    for values in settings(effect):
        changed = run(wrap(effect, values, DT), model, inputs)
        change = np.abs(changed - plain).max(axis=0) / size
        if change[fast].max() > 0.02:
            change = np.where(np.isin(np.arange(model.n), fast), change, 0.0)
        i = int(np.argmax(change))
        drawn = (model.state_names[i], plain[:, i], changed[:, i])
        found.append((abs(float(change[i]) - CHANGE), drawn))
    return min(found, key=lambda each: each[0])[1]


def kind_of(effect: Effect) -> str:
    """Return the section of docs/effects.md that an effect belongs to."""
    kinds = (name for name, kind in KINDS if isinstance(effect.family, kind))
    return "sensor" if effect.family.name == "odometry_scale" else next(kinds, "sensor")


def drawn_of(model: Model, plain: Array, inputs: Array) -> list[Effect]:
    """Return the effects to draw: all for the car, joint effects for the pendulum, else medium."""
    library, scales = Library(), scales_of(model, plain, inputs, DT, STEPS * DT)
    if model is car:
        return list(library.candidates(model, scales))
    joints = [family for family in library.families if isinstance(family, LossFamily)]
    families = MEDIUM if model is boat else joints
    names = [f"{family.name}:{target}" for family in families for target in family.targets(model)]
    return [library.effect(name, model, scales) for name in names]


def change_of(drawn: Drawn) -> float:
    """Return the largest distance of the lines relative to the first one's range, 0 if over 2."""
    _, plain, changed = drawn
    far = float(np.abs(changed - plain).max() / max(float(np.ptp(plain)), 1e-9))
    return far if far < 2 else 0.0


def picture(kind: str, named: Mapping[str, Drawn]) -> Image.Image:
    """Return a small picture in few colours, with a panel for each family."""
    times = np.arange(STEPS + 1) * DT
    panels = []
    for name, (state, plain, changed) in named.items():
        curves = (curve(times, plain, "other"), curve(times, changed, "model"))
        panels.append(panel(f"{name} ({state})", "", "", curves, kind="time"))
    figure = Figure(f"effects-{kind}", "", "", panels)
    whole = Image.open(io.BytesIO(png(figure, columns=4, size=(2.6, 1.5)))).convert("RGB")
    return whole.resize((whole.width // 2, whole.height // 2), Image.Resampling.LANCZOS).quantize(
        24
    )


def main(folder: Path) -> None:
    """Write effects-KIND.png for every kind."""
    strips: dict[str, dict[str, Drawn]] = {}
    for model, inputs in (
        (car, commands()),
        (pendulum, 2.0 * commands()[:, :1]),
        (boat, commands()),
    ):
        plain = run(model, model, inputs)
        for effect in drawn_of(model, plain, inputs):
            named, drawn = strips.setdefault(kind_of(effect), {}), signature(effect, inputs, plain)
            before = named.get(effect.family.name)
            if before is None or change_of(drawn) > change_of(
                before
            ):  # the target that shows it best
                named[effect.family.name] = drawn
    for kind, named in strips.items():
        picture(kind, named).save(folder / f"effects-{kind}.png", optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs"))
