"""What a blind case's effect is and how large: drawn by family, from barely visible to large."""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.effects import Effect, Library, Scales
from grounded.frozen import Array
from grounded.model import Model

SMALLEST, LARGEST = 0.04, 0.35  # of the signals an effect acts on


def draw(model: Model, scales: Any, rng: np.random.Generator) -> Effect:
    """A family at random, then one of its targets."""
    by_family: dict[str, list[Effect]] = {}
    for effect in Library().candidates(model, scales):
        by_family.setdefault(effect.family.name, []).append(effect)
    family = rng.choice(sorted(by_family))
    options = by_family[family]
    return options[int(rng.integers(0, len(options)))]


def values_of(
    effect: Effect, scales: Any, rng: np.random.Generator, visited: Array
) -> dict[str, float]:
    """A size from barely visible to large, as a part of the signals it acts on.

    Of sizes from 2 to 4 % four in ten stayed below 3 nats, of larger ones one in seven.

    Args:
        effect: which.
        scales: sizes of the signals.
        rng: draws.
        visited: (N, n) states of the manoeuvres: a place that differs is one that is visited.
    """
    size = float(np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST))))
    sign = float(rng.choice([-1, 1]))
    target, values = effect.site.target, dict(effect.fixed)
    model = effect.site.model
    duration = scales.duration
    for q in effect.free:
        values[q.name] = _value(effect, q.name, size, sign, scales, rng, model, target, duration)
    if effect.family.name == "periodic":
        phase, amplitude = rng.uniform(0, 2 * np.pi), _rate_scale(scales, target) * size
        values |= {"A": amplitude * np.cos(phase), "B": amplitude * np.sin(phase)}
    if effect.family.name in ("drift_world", "drift_body", "slope"):
        angle = rng.uniform(0, 2 * np.pi)
        top = _rate_scale(scales, target) * size
        values |= {"a": top * np.cos(angle), "b": top * np.sin(angle)}
    if effect.family.name == "patch":
        where = visited[int(rng.integers(0, len(visited)))]
        names = model.state_names
        values |= {q: where[names.index(q[:-1])] for q in values if q[:-1] in names}
    return {name: float(v) for name, v in values.items()}


def _rate_scale(scales: Any, name: str) -> float:
    """A typical rate of a state: its spread over two seconds."""
    return float(scales.spread(name)) / 2.0


def _value(
    effect: Effect,
    quantity: str,
    size: float,
    sign: float,
    scales: Scales,
    rng: np.random.Generator,
    model: Model,
    target: str,
    duration: float,
) -> float:
    family = effect.family.name
    if family in ("dead_zone", "stall"):
        return size * scales.peak(target)
    if family == "saturation":
        return (1 - size) * scales.peak(target)
    if family == "backlash":
        return size * scales.spread(target)
    if family in ("rate_limit", "slew_limit"):
        return float(float(scales.spread(target)) * np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    if family in ("delay", "sensor_delay"):
        return 0.6 * size
    if family == "first_order_lag":
        return float(size)
    if family in ("input_bias", "sensor_bias"):
        return sign * 0.5 * size * scales.spread(target)
    if family == "input_fade":
        return size / duration
    if family in ("input_gain", "rate_gain", "odometry_scale", "sensor_scale"):
        return sign * size
    if family == "parameter":
        value = model.params[target].value
        return sign * size * (abs(value) if value else 0.2)
    if family in ("viscous_friction", "quadratic_drag", "coulomb_friction", "stiction"):
        speed = scales.peak(target)
        over = {"viscous_friction": 1.0, "quadratic_drag": speed}.get(family, 1 / speed)
        return size * 2.0 / over
    if family == "understeer":
        speed = max(scales.peak(n) for n in ("v",) if n in scales.high) if scales.high else 1.0
        return float(size / speed**2)
    if family == "side_slip":
        return 0.3 * size / max(scales.peak("v"), 0.3)
    if family == "coupling":
        driven, _, source = target.partition("<-")
        return sign * size * _rate_scale(scales, driven) / scales.peak(source)
    if family == "trend":
        return sign * size * _rate_scale(scales, target) / duration
    if family == "periodic" and quantity == "omega":
        return 2 * np.pi * float(np.exp(rng.uniform(np.log(0.3), np.log(2.0))))
    if family == "patch" and quantity == "c":
        return 4 * sign * size * _rate_scale(scales, target)  # it acts for a moment only
    if family == "patch":
        return 0.12 * max(effect.free[-1].grid) / 0.16  # of the radius; the place is drawn apart
    return sign * size * _rate_scale(scales, target)
