"""Draws a picture of each effect family's signature, for docs/effects.md.

Run `python -m grounded_trials.report.studies.effect_pictures docs` to update them.

The model (grey) and the model with one effect (orange) get the same commands. The model is a car,
for effects of a joint a pendulum, for those of a medium a boat. The picture shows the state that
changes most relative to its range: a dynamic one (speed, steering angle, heading rate) if it
changes at all, else a position. The strength is chosen for a change of about a quarter of the
range.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

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
    Scales,
    memory_start,
    scales_of,
    wrap,
)
from grounded.effects.medium import FAMILIES as MEDIUM
from grounded.frozen import Array
from grounded.model import Model
from grounded.models.car import model as car
from grounded.models.pendulum import model as pendulum
from grounded.trial import Trial

DT, STEPS = 0.05, 160
WIDE, HIGH, GAP, TOP = 170, 84, 14, 18  # of a panel [px]
ROW = 4  # panels side by side
SEEN = 0.25  # desired change, as a fraction of a state's range

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
    """Return the state that changes most, at the strength with a change closest to `SEEN`."""
    size, model = np.maximum(np.ptp(plain, axis=0), 1e-9), effect.site.model
    fast = [model.state_names.index(name) for name in places.dynamic(model)]
    found = []
    for values in settings(effect):
        changed = run(wrap(effect, values, DT), model, inputs)
        change = np.abs(changed - plain).max(axis=0) / size
        if change[fast].max() > 0.02:
            change = np.where(np.isin(np.arange(model.n), fast), change, 0.0)
        i = int(np.argmax(change))
        found.append(
            (abs(float(change[i]) - SEEN), model.state_names[i], plain[:, i], changed[:, i])
        )
    return min(found, key=lambda each: each[0])[1:]


def strip(named: Mapping[str, Drawn]) -> str:
    """Return small plots in rows as one SVG."""
    step, body = TOP + HIGH + GAP, []
    for i, (title, (state, *curves)) in enumerate(named.items()):
        x, y = (i % ROW) * (WIDE + GAP), (i // ROW) * step
        low, size = np.min(curves), max(float(np.ptp(curves)), 1e-9)
        body.append(f'<text x="{x}" y="{y + 12}" fill="#777777">{title} ({state})</text>')
        for values, colour in zip(curves, ("#999999", "#d9480f"), strict=True):
            across = x + WIDE * np.arange(len(values)) / (len(values) - 1)
            up = y + TOP + HIGH * (1 - (values - low) / size)
            points = " ".join(f"{a:.0f},{b:.1f}" for a, b in zip(across, up, strict=True))
            look = f'fill="none" stroke="{colour}" stroke-width="1.6"'
            body.append(f'<polyline points="{points}" {look}/>')
    wide, high = min(len(named), ROW) * (WIDE + GAP), -(-len(named) // ROW) * step
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{wide}" height="{high}" '
        f'font-family="sans-serif" font-size="11">{"".join(body)}</svg>\n'
    )


def kind_of(effect: Effect) -> str:
    """Return the section of docs/effects.md that an effect belongs to."""
    kinds = {InputFamily: "input", MemoryFamily: "memory", LossFamily: "joint", RateFamily: "rate"}
    kinds |= {MediumFamily: "rate", ParamFamily: "param"}
    name = next((k for cls, k in kinds.items() if isinstance(effect.family, cls)), "sensor")
    return "sensor" if effect.family.name == "odometry_scale" else name


def drawn_of(model: Model, scales: Scales) -> list[Effect]:
    """Return the effects to draw: all for the car, joint effects for the pendulum, else medium."""
    if model is car:
        return list(Library().candidates(model, scales))
    library = Library()
    joints = [family for family in library.families if isinstance(family, LossFamily)]
    drawn = MEDIUM if model is boat else joints
    names = [f"{family.name}:{target}" for family in drawn for target in family.targets(model)]
    return [library.effect(name, model, scales) for name in names]


def draw_all(folder: Path) -> list[Path]:
    """Write effects-KIND.svg for every kind; return their paths."""
    inputs, swings = commands(), 2.0 * commands()[:, :1]
    strips: dict[str, dict[str, Drawn]] = {}
    for model, u in ((car, inputs), (pendulum, swings), (boat, inputs)):
        plain = run(model, model, u)
        scales = scales_of(model, plain, u, DT, STEPS * DT)
        for effect in drawn_of(model, scales):
            named = strips.setdefault(kind_of(effect), {})
            drawn = signature(effect, u, plain)
            before = named.get(effect.family.name)
            if before is None or _change(drawn) > _change(before):  # the target that shows it best
                named[effect.family.name] = drawn
    paths = []
    for kind, named in strips.items():
        paths.append(folder / f"effects-{kind}.svg")
        paths[-1].write_text(strip(named), encoding="utf-8")
    return paths


def _change(drawn: Drawn) -> float:
    """Return the largest distance of the lines relative to the first one's range, 0 if over 2."""
    _, plain, changed = drawn
    far = float(np.abs(changed - plain).max() / max(float(np.ptp(plain)), 1e-9))
    return far if far < 2 else 0.0


if __name__ == "__main__":
    for path in draw_all(Path(sys.argv[1] if len(sys.argv) > 1 else "docs")):
        print(path)
