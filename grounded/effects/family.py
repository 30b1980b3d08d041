"""What an effect is: a small change of ANY model, with a few quantities to be estimated.

An effect's name is `family:target`. A family says where it acts and writes one equation in plain
NumPy; the same equation is traced into the adopted model, evaluated on whole trials by the
diagnosis, and listed in docs/effects.md.

    InputFamily     u_eff = effect(u, t, c)                 what the actuator makes of a command
    MemoryFamily    u_eff, z+ = advance(u, z, c, dt)        the same, with a memory z
    LossFamily      u_eff = u - loss(w, u, c)               what a driven motion takes off an input
    RateFamily      ds/dt = model + rate(s, a, own, t, c)   added to the rates of states
    MediumFamily    f seen from axes that move with (c)     what it floats or flies in moves itself
    SensorFamily    y = measure(s, c),  s = recover(y, c)   what is logged of a state
    ParamFamily     p + c                                   the model's own parameter is wrong

c are the effect's quantities by name. A quantity without a scan grid is absent at zero and the
equation is (to first order) linear in it; one with a grid is scanned first, then refined. A fixed
quantity is a constant that the data's scale chose (the width of a smoothed sign); where the effect
is large, the data may set it themselves.

Several effects act in one order, for prediction, probes and adopted models alike:

    command -> input effects as claimed -> transport delays -> losses -> model -> sensor effects

A transport delay commutes with all that does not depend on time, so it may as well act last; there
a fraction of a step blends two samples of what is delivered, not two commands that a nonlinear
effect has yet to see. Of two effects the one that is wrapped LAST acts FIRST on a command, so
wrapping goes from the model outwards: parameters, losses, limits of rates, rates, a medium, sensors
(late ones last, delays before filters), inputs (`order`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from grounded.errors import GroundedError, nearest
from grounded.frozen import Array
from grounded.model import Model

Values = Mapping[str, Any]  # by name: numbers, arrays of samples, or traced expressions


@dataclass(frozen=True)
class Quantity:
    """One number of an effect.

    Args:
        name: short name, `c`.
        unit: SI unit.
        grid: values to scan; empty for a linear coefficient.
        low: lower bound that an estimate keeps.
        high: upper bound, likewise.
        fixed: a constant of the effect, not estimated; its value is `start`.
        start: value at which the effect is absent (or, fixed, the value itself).
        places: how many independent values the grid looks at, for the price of looking.
        tunable: a constant that data may set (above zero) where they show the effect well.
        tuned: it was.
        absurd: a size beyond which it is no finding but a sign of other units, or of other logs.
        known: what the model has of it already; the value is what it has to have more, or less.
    """

    name: str
    unit: str = "1"
    grid: tuple[float, ...] = ()
    low: float = -np.inf
    high: float = np.inf
    fixed: bool = False
    start: float = 0.0
    places: float = 1.0
    tunable: bool = False
    tuned: bool = False
    absurd: float = np.inf
    known: float = 0.0


@dataclass(frozen=True)
class Scales:
    """Typical sizes of the signals: what a grid or a smoothing width is measured in.

    Args:
        low: smallest value of each state and input, by name.
        high: largest value, likewise.
        quantiles: (21,) quantiles of the absolute values of each signal, by name.
        dt: control step [s].
        duration: longest trial [s].
    """

    low: Mapping[str, float] = field(default_factory=dict)
    high: Mapping[str, float] = field(default_factory=dict)
    quantiles: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    dt: float = 0.05
    duration: float = 10.0

    def peak(self, name: str) -> float:
        """Largest absolute value, 1 where nothing is known."""
        value = max(abs(self.low.get(name, -1.0)), abs(self.high.get(name, 1.0)))
        return value if value > 0 else 1.0

    def moves(self, name: str) -> bool:
        """Whether its size is known, and not zero."""
        return max(abs(self.low.get(name, 0.0)), abs(self.high.get(name, 0.0))) > 0

    def spread(self, name: str) -> float:
        """High minus low, never zero."""
        value = self.high.get(name, 1.0) - self.low.get(name, -1.0)
        return value if value > 1e-12 else 1.0


@dataclass(frozen=True)
class Site:
    """Where an effect is built: the model, the targets, the sizes of its signals."""

    model: Model
    targets: tuple[str, ...]
    scales: Scales

    @property
    def target(self) -> str:
        """The first target, for effects that have one."""
        return self.targets[0]

    def unit(self, name: str) -> str:
        """Unit of a state or an input."""
        return self.model.states.get(name) or self.model.inputs.get(name) or "1"


def per(unit: str, by: str = "s") -> str:
    """A unit divided by another, readable: m/s by s is m/s^2."""
    if unit == "1":
        return f"1/{by}"
    return f"{unit}^2" if unit.endswith(f"/{by}") else f"{unit}/{by}"


def coupled(site: Site) -> tuple[str, str]:
    """The two sides of `v<-delta`: what is driven, and what drives it."""
    target, _, source = site.target.partition("<-")
    return target, source


def width(site: Site, speed: str) -> Quantity:
    """Over which speed a dry friction builds up: a constant, a hundredth of the largest.

    Data may make it up to three tenths: wider, it would be a viscous one under another name.
    """
    peak, unit = site.scales.peak(speed), site.unit(speed)
    return Quantity(
        "width", unit, (), 1e-3 * peak, 0.3 * peak, fixed=True, start=0.01 * peak, tunable=True
    )


def two_axes(unit: str) -> tuple[Quantity, ...]:
    """What acts along both axes of a plane."""
    return (Quantity("a", unit), Quantity("b", unit))


def speed_limit(site: Site, unit: str) -> tuple[Quantity, ...]:
    """A speed r that is not exceeded: scanned from half the fastest that a step could show."""
    spread = site.scales.spread(site.target)
    fastest = spread / site.scales.dt
    grid = tuple(float(v) for v in np.geomspace(0.5 * fastest, 0.1 * spread, 12))
    return (Quantity("r", unit, grid, 0.0, np.inf, start=2 * fastest, places=6),)


@dataclass(frozen=True)
class Family:
    """A family of effects: what it is called, where it applies, what it estimates.

    Args:
        name: `dead_zone`.
        equation: one line of maths for docs and messages.
        sentence: what it means in the workshop. {target} and quantities are filled in; {s} is a
            verb's ending, {g%} a percentage, {g%stronger|weaker} one with its direction,
            {k>by|less, by} words by the sign of a quantity that then stands without it; what
            stands in [] is left out where a quantity {b} in it is a constant, or zero; of parts
            with & between them, one at least is told.
        targets: all targets of a model to which it can apply, joined by "+".
        quantities: the numbers to estimate at a site.
        lookalikes: families that the same data may explain.
        vague: nats that a family pays for naming no mechanism, so that a tie goes to one that does.
        turned: of a gain, the sentence where 1 + g is below zero.
        loose: it names no mechanism, but fits what repeats with a motion, whatever the cause.
        ratio: what a percentage {g%} tells of the quantity g of some value.
    """

    name: str
    equation: str
    sentence: str
    targets: Callable[[Model], Sequence[str]]
    quantities: Callable[[Site], tuple[Quantity, ...]]
    lookalikes: tuple[str, ...] = ()
    vague: float = 0.0
    turned: str = ""
    loose: bool = False
    ratio: Callable[[str, float], float] = lambda name, value: value

    def at(self, site: Site) -> Effect:
        """The effect of this family there, with the quantities that it estimates there."""
        return Effect(self, site, self.quantities(site))


@dataclass(frozen=True)
class InputFamily(Family):
    """effect(u, t, c) -> what the actuator receives of a command u at time t.

    `linear`: a command that is delayed by a part of a step, its mean over each, may come first.
    """

    effect: Callable[[Any, Any, Any], Any] = lambda u, t, c: u
    timed: bool = False
    linear: bool = False


@dataclass(frozen=True)
class MemoryFamily(Family):
    """advance(u, z, c, dt) -> (mean input over the step, next memory); z has `depth` entries.

    `depth(values, dt)`: how many memory states the effect needs, all starting at the input that
    was held before t = 0. `transport`: a pure delay, which acts after all others. `along(u, z, c,
    dt)`: where `depth` is one, z before each step of the commands u (S, T) that begin at z (S,).
    `linear`: as of an `InputFamily`.
    """

    advance: Callable[[Any, tuple[Any, ...], Any, Any], tuple[Any, tuple[Any, ...]]] = (
        lambda u, z, c, dt: (u, z)
    )
    depth: Callable[[Mapping[str, float], float], int] = lambda values, dt: 1
    transport: bool = False
    linear: bool = False
    along: Callable[[Any, Any, Mapping[str, float], float], Any] = lambda u, z, c, dt: z[:, None]


@dataclass(frozen=True)
class LossFamily(Family):
    """What the motion w takes off the input u that drives it, at a target `u<-w` (`joint`).

    loss(w, free, gain, u, c, dt): its mean over a step that begins at the speed w and would end at
    `free`; a unit of u adds `gain` to that. torque(w, rate, gain, u, c): the same at one moment,
    where the speed's own rate is `rate` and a unit of u adds `gain` to it. early: as `loss`, over
    the first half of a step, which need not be as fine; None: `loss` itself.
    """

    loss: Callable[[Any, Any, Any, Any, Any, Any], Any] = lambda w, free, gain, u, c, dt: 0.0
    torque: Callable[[Any, Any, Any, Any, Any], Any] = lambda w, rate, gain, u, c: 0.0
    early: Callable[[Any, Any, Any, Any, Any, Any], Any] | None = None


@dataclass(frozen=True)
class RateFamily(Family):
    """rate(s, a, own, t, c, site) -> {state: added rate}; `own` are the model's own rates.

    `parts`: it acts on the mean rate of so many parts of the step, not half before and half after:

        x+ = x + h (own + rate(x)),   own = (f(x, h) - x) / h,   h = dt / parts

    right where it limits a rate whose own time constant may be shorter than the step.
    `brakes`: it opposes the motion of its target, which half a step of it never turns round.
    """

    rate: Callable[[Any, Any, Any, Any, Any, Site], Values] = lambda s, a, own, t, c, site: {}
    timed: bool = False
    needs_own: bool = False
    parts: int = 0
    brakes: bool = False


@dataclass(frozen=True)
class MediumFamily(Family):
    """The model, and the rates found beside it, act relative to a medium that moves (`medium`).

    shift(s, c, site) -> {velocity: the medium's own, in the axes of that state}
    drift(c, site) -> {position: the medium's velocity over ground}
    """

    shift: Callable[[Any, Any, Site], Values] = lambda s, c, site: {}
    drift: Callable[[Any, Site], Values] = lambda c, site: {}


@dataclass(frozen=True)
class SensorFamily(Family):
    """measure(value, c) -> logged value of the target state; recover is its inverse."""

    measure: Callable[[Any, Any], Any] = lambda value, c: value
    recover: Callable[[Any, Any], Any] = lambda value, c: value


@dataclass(frozen=True)
class SensorDelayFamily(Family):
    """The logged values of the target states are `d` seconds old, all by the same."""


@dataclass(frozen=True)
class SensorLagFamily(Family):
    """The logged value of the target state follows it with the time constant `tau` (a filter)."""


@dataclass(frozen=True)
class ParamFamily(Family):
    """The model's own parameter differs from its nominal value."""


@dataclass(frozen=True)
class Effect:
    """A family at a target: what `family:target` names. Built by `grounded.effects.effect`."""

    family: Family
    site: Site
    quantities: tuple[Quantity, ...]

    @property
    def name(self) -> str:
        """`family:target`."""
        return f"{self.family.name}:{'+'.join(self.site.targets)}"

    @property
    def free(self) -> tuple[Quantity, ...]:
        """The quantities that are estimated."""
        return tuple(q for q in self.quantities if not q.fixed)

    @property
    def fixed(self) -> dict[str, float]:
        """The constants."""
        return {q.name: q.start for q in self.quantities if q.fixed}

    def tuned(self, name: str, value: float) -> Effect:
        """The same effect with another constant."""
        new = (
            replace(q, start=value, tuned=True) if q.name == name else q for q in self.quantities
        )
        return replace(self, quantities=tuple(new))

    @property
    def known(self) -> bool:
        """Whether the model has it already, and its values are changes."""
        return any(q.known for q in self.quantities)

    @property
    def places(self) -> float:
        """How many places the scan looks at (the price of looking is its logarithm)."""
        return float(np.prod([max(q.places, 1.0) for q in self.free]))

    def complete(self, values: Mapping[str, float]) -> Mapping[str, float]:
        """All quantities with a value: the given ones, the constants.

        Raises:
            GroundedError: for a name that is not a quantity, or one that is missing.
        """
        names = [q.name for q in self.quantities]
        for name in values:
            if name not in names:
                raise GroundedError(
                    f"effect '{self.name}' has no quantity '{name}': {nearest(name, names)}"
                )
        whole = {**self.fixed, **{name: float(value) for name, value in values.items()}}
        missing = [name for name in names if name not in whole]
        if missing:
            raise GroundedError(f"effect '{self.name}' needs a value for '{missing[0]}'")
        return MappingProxyType({name: whole[name] for name in names})


def beyond(value: Any, most: Any) -> Any:
    """How far a value lies outside of -most to most, exactly 0 within: what a limit takes off it.

    It is compared as a part of the limit, since planning rounds corners off (`Task.smoothing`): in
    the limit's own unit that width may be more than the whole of it, and a plan through such a
    corner has nothing to do with the limit.
    """
    most = np.maximum(most, LEAST_LIMIT)
    part = value / most
    return most * (np.maximum(part - 1.0, 0.0) - np.maximum(-part - 1.0, 0.0))


LEAST_LIMIT = 1e-12


def braked(effect: Effect, s: Any, added: Values, half: Any) -> Values:
    """The rates that an effect adds, for a kick of `half` a step that turns no motion round."""
    if not getattr(effect.family, "brakes", False):
        return added
    most = {n: np.abs(s[n]) / half for n in added}
    return {n: np.minimum(np.maximum(rate, -most[n]), most[n]) for n, rate in added.items()}


def scales_of(model: Model, states: Array, inputs: Array, dt: float, duration: float) -> Scales:
    """Sizes of the signals in recorded data: states (N, n), inputs (N, m)."""
    low, high, quantiles = {}, {}, {}
    for names, values in ((model.state_names, states), (model.input_names, inputs)):
        for i, name in enumerate(names):
            column = values[np.isfinite(values[:, i]), i]
            if not len(column):
                continue
            low[name], high[name] = (float(q) for q in np.quantile(column, [0.002, 0.998]))
            marks = np.quantile(np.abs(column), np.linspace(0, 1, 21))
            quantiles[name] = tuple(float(q) for q in marks)
    return Scales(low, high, quantiles, dt, duration)
