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
from grounded.effects import Effect, Library, Scales, elastic
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
    """Draw a family (from `families`, else any but `elastic`), then one of its targets."""
    by_family: dict[str, list[Effect]] = {}
    for effect in Library().candidates(model, scales):
        if effect.family.name in families or not (families or effect.family in elastic.FAMILIES):
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

    Of effects of 2 to 4 %, four in ten stayed below 3 nats; of larger ones, one in seven. A patch
    is at a state of `visited` (N, n); the loop of a `mechanism` tolerates less delay.
    """
    size = float(np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST))))
    sign = float(rng.choice([-1, 1]))
    family, values = effect.family.name, dict(effect.fixed)
    top = _rate_scale(scales, effect.site.target) * size
    draw = _Draw(effect, size, sign, scales, rng)
    for q in effect.free:
        rule = SIZES.get(f"{family}.{q.name}") or SIZES.get(family) or (lambda d: d.rate)
        values[q.name] = DRIVE[family] * size if mechanism and family in DRIVE else rule(draw)
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


@dataclass(frozen=True)
class _Draw:
    """What the value of an effect depends on."""

    effect: Effect
    size: float  # relative
    sign: float
    scales: Scales
    rng: np.random.Generator

    @property
    def on(self) -> str:
        """What it acts on: an input, a state, `driven<-source`."""
        return self.effect.site.target

    @property
    def driven(self) -> str:
        return self.on.partition("<-")[0]

    @property
    def source(self) -> str:
        return self.on.partition("<-")[2]

    def peak(self, name: str) -> float:
        return float(self.scales.peak(name))

    @property
    def spread(self) -> float:
        return float(self.scales.spread(self.on))

    @property
    def speed(self) -> float:
        return self.peak("v") if self.scales.high else 1.0

    @property
    def rate(self) -> float:
        """A part of a typical rate of what it acts on."""
        return self.sign * self.size * _rate_scale(self.scales, self.on)

    def of(self, low: float, high: float) -> float:
        """Return a random factor between two."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def parameter(self) -> float:
        """Return a change of a parameter, within its lower bound."""
        known = self.effect.site.model.params[self.on]
        low = -np.inf if known.low is None else known.low
        high = np.inf if known.high is None else known.high
        change = self.sign * self.size * (abs(known.value) or min((high - low) / 2, 0.5))
        return float(change if known.value + change >= low else -change)


_Rule = Callable[[_Draw], float]


def _alike(*families: str, rule: _Rule) -> dict[str, _Rule]:
    return dict.fromkeys(families, rule)


SIZES: Mapping[str, _Rule] = {  # by `family` or `family.quantity`; else a rate (`_Draw.rate`)
    **_alike("dead_zone", "stall", rule=lambda d: d.size * d.peak(d.on)),
    "saturation": lambda d: (1 - d.size) * d.peak(d.on),
    "backlash": lambda d: d.size * d.spread,
    **_alike("rate_limit", "slew_limit", rule=lambda d: d.spread * d.of(0.3, 3.0)),
    **_alike("delay", "sensor_delay", rule=lambda d: 0.6 * d.size),
    **_alike("first_order_lag", "sensor_lag", rule=lambda d: d.size),
    **_alike("input_bias", "sensor_bias", rule=lambda d: d.sign * 0.5 * d.size * d.spread),
    "input_fade": lambda d: d.size / d.scales.duration,
    **_alike(
        *("input_gain", "input_curve", "rate_gain", "odometry_scale", "sensor_scale"),
        rule=lambda d: d.sign * d.size,
    ),
    "parameter": _Draw.parameter,
    "viscous_friction": lambda d: 2 * d.size,
    "quadratic_drag": lambda d: 2 * d.size / d.peak(d.on),
    **_alike("coulomb_friction", "stiction", rule=lambda d: 2 * d.size * d.peak(d.on)),
    "understeer": lambda d: d.size / d.speed**2,
    "side_slip": lambda d: 0.3 * d.size / max(d.peak("v"), 0.3),
    "coupling": lambda d: d.sign * d.size * _rate_scale(d.scales, d.driven) / d.peak(d.source),
    "cornering_drag": lambda d: 2 * d.size / d.peak(d.source),
    # Of a joint: as a part of the largest input, reached in 0.2 s.
    **_alike("joint_friction", "load_friction", rule=lambda d: d.size * d.peak(d.driven)),
    "joint_friction.b": lambda d: d.size * d.peak(d.driven) / d.peak(d.source),
    "load_friction.k": lambda d: d.size,
    "added_inertia": lambda d: d.size * d.peak(d.driven) * 0.2 / d.peak(d.source),
    "joint_spring": lambda d: d.size * d.peak(d.driven) / 5.0,
    "joint_spring.k": lambda d: d.size * d.peak(d.driven) / d.peak(d.source),
    "grip_limit": lambda d: (1 - d.size) * max(d.effect.free[0].grid) / 2,
    "lever_arm": lambda d: d.sign * 0.5 * d.size,
    "trend": lambda d: d.rate / d.scales.duration,
    "periodic.omega": lambda d: 2 * np.pi * d.of(0.3, 2.0),
    "patch.c": lambda d: 4 * d.rate,  # it acts only briefly
    "patch": lambda d: 0.12 * max(d.effect.free[-1].grid) / 0.16,  # its radius
}


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
    """Draw a withheld effect for a model, of inputs of size `peak` (m,) and a state of this `rate`.

    A mechanism gets a spring or a hanging mass instead of gusts and hysteresis.
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
