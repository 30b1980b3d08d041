"""Random effects of blind cases and their sizes, from barely visible to large.

`draw_effect` draws from the library. `draw_withheld` draws an effect that is NOT in the library, so
that the diagnosis has no name for it:

resonance     the actuator rings: u_eff'' = w^2 (u - u_eff) - 2 zeta w u_eff'
dropouts      commands get lost for 0.1 to 0.4 s; the last one is held
fault         from about the middle of the trial on, an actuator is weaker
crosstalk     one input leaks, squared, into another
quantised     commands arrive in coarse steps
gusts         pushes of half a second at random times
hysteresis    drag that depends on whether the speed rises or falls
spring        a cable pulls at the first joint (mechanisms only)
hung          something swings from the tip (mechanisms only)

A mechanism's effects are those of its joints and drives (`JOINT`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from grounded.challenge.truth import Actuator
from grounded.effects import Effect, Library, Scales
from grounded.frozen import Array
from grounded.model import Model

JOINT = (
    "joint_friction", "added_inertia", "parameter", "first_order_lag", "delay", "dead_zone",
)  # fmt: skip
DRIVE = {"delay": 0.12, "first_order_lag": 0.3}  # [s] for a mechanism, times the relative size
SMALLEST, LARGEST = 0.04, 0.35  # size relative to the signals an effect acts on


def draw_effect(
    model: Model, scales: Scales, rng: np.random.Generator, families: Sequence[str] = ()
) -> Effect:
    """Draw a family (from `families`, if any are given), then one of its targets."""
    by_family: dict[str, list[Effect]] = {}
    for effect in Library().candidates(model, scales):
        if not families or effect.family.name in families:
            by_family.setdefault(effect.family.name, []).append(effect)
    options = by_family[rng.choice(sorted(by_family))]
    return options[int(rng.integers(0, len(options)))]


def values_of(
    effect: Effect,
    scales: Scales,
    rng: np.random.Generator,
    visited: Array,
    mechanism: bool = False,
) -> dict[str, float]:
    """Draw the values of an effect, from barely visible to large relative to the signals.

    Of effects of 2 to 4 %, four in ten stayed below 3 nats; of larger ones, one in seven.

    Args:
        effect: the effect.
        scales: sizes of the signals.
        rng: random generator.
        visited: states of the manoeuvres (N, n), so that a patch is at a visited place.
        mechanism: whether the system is a mechanism, whose loop tolerates less delay.
    """
    size = float(np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST))))
    sign = float(rng.choice([-1, 1]))
    family, values = effect.family.name, dict(effect.fixed)
    top = _rate_scale(scales, effect.site.target) * size
    for q in effect.free:
        values[q.name] = _value(effect, q.name, size, sign, scales, rng, mechanism)
    if family == "periodic":
        phase = rng.uniform(0, 2 * np.pi)
        values |= {"A": top * np.cos(phase), "B": top * np.sin(phase)}
    if family in ("drift_world", "drift_body", "slope", "push_world", "current"):
        top = size * scales.peak(effect.site.target) if family == "current" else top
        angle = rng.uniform(0, 2 * np.pi)
        values |= {"a": top * np.cos(angle), "b": top * np.sin(angle)}
    if family == "patch":
        where = visited[int(rng.integers(0, len(visited)))]
        names = effect.site.model.state_names
        values |= {q: where[names.index(q[:-1])] for q in values if q[:-1] in names}
    return {name: float(v) for name, v in values.items()}


def _rate_scale(scales: Scales, name: str) -> float:
    """Return a typical rate of a state, its spread over two seconds."""
    return float(scales.spread(name)) / 2.0


def _value(
    effect: Effect,
    quantity: str,
    size: float,
    sign: float,
    scales: Scales,
    rng: np.random.Generator,
    mechanism: bool,
) -> float:
    family, target = effect.family.name, effect.site.target
    if family in ("dead_zone", "stall"):
        return size * scales.peak(target)
    if family == "saturation":
        return (1 - size) * scales.peak(target)
    if family == "backlash":
        return size * scales.spread(target)
    if family in ("rate_limit", "slew_limit"):
        return float(float(scales.spread(target)) * np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    if mechanism and family in DRIVE:
        return DRIVE[family] * size
    if family in ("delay", "sensor_delay"):
        return 0.6 * size
    if family in ("first_order_lag", "sensor_lag"):
        return float(size)
    if family in ("input_bias", "sensor_bias"):
        return sign * 0.5 * size * scales.spread(target)
    if family == "input_fade":
        return size / scales.duration
    if family in ("input_gain", "input_curve", "rate_gain", "odometry_scale", "sensor_scale"):
        return sign * size
    if family == "parameter":
        known = effect.site.model.params[target]
        low = -np.inf if known.low is None else known.low
        high = np.inf if known.high is None else known.high
        change = sign * size * (abs(known.value) or min((high - low) / 2, 0.5))
        return float(change if known.value + change >= low else -change)
    if family in ("viscous_friction", "quadratic_drag", "coulomb_friction", "stiction"):
        speed = scales.peak(target)
        over = {"viscous_friction": 1.0, "quadratic_drag": speed}.get(family, 1 / speed)
        return size * 2.0 / over
    if family == "understeer":
        speed = scales.peak("v") if scales.high else 1.0
        return float(size / speed**2)
    if family == "side_slip":
        return 0.3 * size / max(scales.peak("v"), 0.3)
    if family == "coupling":
        driven, _, source = target.partition("<-")
        return sign * size * _rate_scale(scales, driven) / scales.peak(source)
    if family == "cornering_drag":
        return 2 * size / scales.peak(target.partition("<-")[2])
    if family in ("joint_friction", "load_friction", "added_inertia"):
        return _joint(quantity, size, scales, *target.split("<-"))
    if family == "joint_spring":
        tau, _, q = target.partition("<-")
        return size * scales.peak(tau) / (scales.peak(q) if quantity == "k" else 5.0)
    if family == "grip_limit":
        return (1 - size) * max(effect.free[0].grid) / 2
    if family == "lever_arm":
        return sign * 0.5 * size
    if family == "trend":
        return sign * size * _rate_scale(scales, target) / scales.duration
    if family == "periodic" and quantity == "omega":
        return 2 * np.pi * float(np.exp(rng.uniform(np.log(0.3), np.log(2.0))))
    if family == "patch" and quantity == "c":
        return 4 * sign * size * _rate_scale(scales, target)  # it acts only briefly
    if family == "patch":
        return 0.12 * max(effect.free[-1].grid) / 0.16  # radius; the place is drawn separately
    return sign * size * _rate_scale(scales, target)


def _joint(quantity: str, size: float, scales: Scales, tau: str, w: str) -> float:
    """Return friction or inertia of a joint as a part of the largest input (0.2 s to speed)."""
    if quantity == "k":
        return size
    over = {"b": scales.peak(w), "J": scales.peak(w) / 0.2}.get(quantity, 1.0)
    return size * scales.peak(tau) / over


Rate = Callable[[Any, Any, float, Mapping[str, Any]], Mapping[str, float]]


@dataclass(frozen=True, eq=False)
class Withheld:
    """A withheld effect."""

    name: str
    target: str
    params: dict[str, float]
    actuators: tuple[Actuator, ...] = ()
    rates: tuple[Rate, ...] = ()
    joint: Mapping[str, float] = field(default_factory=dict)  # of a mechanism


def draw_withheld(
    rng: np.random.Generator,
    model: Model,
    peak: Array,
    driven: str,
    rate: float,
    duration: float,
    mechanism: bool = False,
) -> Withheld:
    """Draw a withheld effect for a model.

    Args:
        rng: random generator.
        model: the system.
        peak: typical size of each input (m,).
        driven: the state that gusts and hysteresis act on.
        rate: typical size of that state's rate.
        duration: of a trial [s].
        mechanism: whether the system is a mechanism, which gets a spring or a hanging mass instead
            of gusts and hysteresis.
    """
    makers = [_resonance, _dropouts, _fault, _quantised, _crosstalk]
    kind = int(rng.integers(0, len(makers) + 2))
    j = int(rng.integers(0, model.m))
    if mechanism and kind >= len(makers):
        return _attached(rng, driven)
    if kind == len(makers) or (model.m == 1 and kind == len(makers) - 1):
        return _gusts(rng, driven, rate, duration)
    if kind == len(makers) + 1:
        return _hysteresis(rng, driven, rate)
    maker = makers[kind]
    params, act = maker(rng, j, model.m, float(peak[j]), duration)
    name = maker.__name__.removeprefix("_")
    return Withheld(name, model.input_names[j], params, actuators=(act,))


def _attached(rng: np.random.Generator, driven: str) -> Withheld:
    name = str(rng.choice(["spring", "hung"]))
    size = float(rng.uniform(0.5, 3.0) if name == "spring" else rng.uniform(0.05, 0.2))
    return Withheld(name, driven, {name: size}, joint={name: size})


_Made = tuple[dict[str, float], Actuator]  # sealed parameters, and the actuator


def _on(j: int, delivered: Callable[[Array, dict[str, Any], float, float], float]) -> Actuator:
    """Return an actuator that changes input j alone."""

    def act(u: Array, own: dict[str, Any], t: float, dt: float) -> Array:
        out = u.copy()
        out[j] = delivered(u, own, t, dt)
        return out

    return act


def _resonance(rng: np.random.Generator, j: int, m: int, peak: float, T: float) -> _Made:
    w, zeta = 2 * np.pi * rng.uniform(0.7, 2.0), rng.uniform(0.05, 0.25)

    def ring(u: Array, own: dict[str, Any], t: float, dt: float) -> float:
        z, rate = own.get("resonance", (u[j], 0.0))
        rate = rate + dt * (w * w * (u[j] - z) - 2 * zeta * w * rate)
        own["resonance"] = (z + dt * rate, rate)
        return float(z + dt * rate)

    return {"omega": w, "zeta": zeta}, _on(j, ring)


def _dropouts(rng: np.random.Generator, j: int, m: int, peak: float, T: float) -> _Made:
    rate = rng.uniform(0.3, 1.0)

    def act(u: Array, own: dict[str, Any], t: float, dt: float) -> Array:
        until, held = own.get("dropouts", (-1.0, u))
        if t >= until:
            held = u.copy()
            if own["rng"].random() < rate * dt:
                until = t + own["rng"].uniform(0.1, 0.4)
        own["dropouts"] = (until, held)
        return np.array(held)

    return {"per_second": rate}, act


def _fault(rng: np.random.Generator, j: int, m: int, peak: float, T: float) -> _Made:
    begin, loss = T * rng.uniform(0.4, 0.6), rng.uniform(0.15, 0.5)
    act = _on(j, lambda u, own, t, dt: u[j] * (1 - loss) if t > begin else u[j])
    return {"begin": begin, "loss": loss}, act


def _quantised(rng: np.random.Generator, j: int, m: int, peak: float, T: float) -> _Made:
    size = peak * rng.uniform(0.15, 0.5)
    return {"step": size}, _on(j, lambda u, own, t, dt: size * np.rint(u[j] / size))


def _crosstalk(rng: np.random.Generator, j: int, m: int, peak: float, T: float) -> _Made:
    leak = float(rng.choice([-1, 1]) * rng.uniform(0.1, 0.4))
    return {"leak": leak}, _on(j, lambda u, own, t, dt: u[j] + leak * u[(j + 1) % m] ** 2)


def _gusts(rng: np.random.Generator, driven: str, rate: float, T: float) -> Withheld:
    begins = np.sort(rng.uniform(0.1 * T, 0.9 * T, 4))
    sizes = rate * rng.choice([-1, 1], 4) * rng.uniform(0.2, 0.8, 4)

    def push(s: Any, a: Any, t: float, own: Mapping[str, Any]) -> Mapping[str, float]:
        inside = (t > begins) & (t < begins + 0.5)
        return {driven: float(sizes[inside].sum())}

    return Withheld("gusts", driven, {"count": 4.0}, rates=(push,))


def _hysteresis(rng: np.random.Generator, driven: str, rate: float) -> Withheld:
    size = rate * rng.uniform(0.1, 0.4)

    def drag(s: Any, a: Any, t: float, own: Mapping[str, Any]) -> Mapping[str, float]:
        return {driven: -size * float(np.tanh(5 * own[driven] / rate) > 0)}

    return Withheld("hysteresis", driven, {"size": size}, rates=(drag,))
