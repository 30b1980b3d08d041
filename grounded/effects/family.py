"""Definition of an effect: a small change of ANY model, with a few quantities to be estimated.

An effect's name is `family:target`. A family defines its targets and one equation in plain NumPy.
The same equation is traced into the adopted model, evaluated on whole trials by the diagnosis, and
listed in docs/effects.md.

    InputFamily     u_eff = effect(u, t, c)                 static map of a command
    MemoryFamily    u_eff, z+ = advance(u, z, c, dt)        dynamic map of a command, with memory z
    LossFamily      u_eff = u - loss(w, u, c)               loss of an input to its motion (joint)
    RateFamily      ds/dt = model + rate(s, a, own, t, c)   added to the rates of states
    MediumFamily    f in axes that move with (c)            the surrounding water or air moves
    SensorFamily    y = measure(s, c),  s = recover(y, c)   logged value of a state
    ParamFamily     p + c                                   shift of the model's own parameter

c are the effect's quantities by name. A quantity without a scan grid vanishes at zero, and the
equation is (to first order) linear in it. One with a grid is scanned first, then refined. A fixed
quantity is a constant chosen by the scale of the data (the width of a smoothed sign). If the effect
is large, it may be fitted, too.

Several effects act in one order, the same for predictions, probes and adopted models:

    command -> input effects as claimed -> transport delays -> losses -> model -> sensor effects

A transport delay commutes with everything time-invariant, so it can act last. There, a fraction of
a step interpolates two samples of what is delivered, not two commands that still pass through a
nonlinear effect. Of two effects, the one wrapped LAST acts FIRST on a command. So wrapping goes
from the model outwards: parameters, losses, limits of rates, rates, a medium, sensors (delayed ones
last, delays before filters), inputs (`wrapping_order`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from grounded import places
from grounded.checks import known, wrong
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
        low: lower bound of an estimate.
        high: upper bound of an estimate.
        fixed: whether it is a constant of the effect, not estimated; its value is `start`.
        start: value at which the effect vanishes (if fixed: the value itself).
        places: number of independent values in the grid, for the price of the search.
        absurd: size above which it is not claimed, as it indicates wrong units or mixed-up logs.
        known: the value that the model already has; the estimate is a change of it. 0: none.
    """

    name: str
    unit: str = "1"
    grid: Sequence[float] | Array = ()
    low: float = -np.inf
    high: float = np.inf
    fixed: bool = False
    start: float = 0.0
    places: float = 1.0
    absurd: float = np.inf
    known: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "grid", tuple(map(float, self.grid)))


@dataclass(frozen=True)
class Scales:
    """Typical sizes of the signals, which set grids and smoothing widths.

    Args:
        low: smallest value of each state and input, by name.
        high: largest value, likewise.
        dt: control step [s].
        duration: longest trial [s].
        slowest: slowest time constant of the model that a trial is long enough to excite [s].
        turns: of each velocity that reversed, how far the motion went in RESOLVED samples after a
            reversal, and how far until the next one (medians).
    """

    low: Mapping[str, float] = field(default_factory=dict)
    high: Mapping[str, float] = field(default_factory=dict)
    dt: float = 0.05
    duration: float = 10.0
    slowest: float = 0.0
    turns: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def peak(self, name: str) -> float:
        """Return the largest absolute value of a signal, 1 if it is unknown or zero."""
        value = max(abs(self.low.get(name, -1.0)), abs(self.high.get(name, 1.0)))
        return value if value > 0 else 1.0

    def moves(self, name: str) -> bool:
        """Check whether the size of a signal is known and not zero."""
        return max(abs(self.low.get(name, 0.0)), abs(self.high.get(name, 0.0))) > 0

    def spread(self, name: str) -> float:
        """Return high minus low, never zero."""
        value = self.high.get(name, 1.0) - self.low.get(name, -1.0)
        return value if value > 1e-12 else 1.0


@dataclass(frozen=True)
class Site:
    """Where an effect acts: the model, the targets, the sizes of the signals."""

    model: Model
    targets: tuple[str, ...]
    scales: Scales

    @property
    def target(self) -> str:
        """The first target, for effects with a single one."""
        return self.targets[0]

    @property
    def joined(self) -> str:
        """All targets, as an effect's name has them."""
        return "+".join(self.targets)

    def unit(self, name: str) -> str:
        """Return the unit of a state or an input."""
        return self.model.states.get(name) or self.model.inputs.get(name) or "1"


def coupled(site: Site) -> tuple[str, str]:
    """Return the two sides of a target `v<-delta`: the driven signal and its source."""
    target, _, source = site.target.partition("<-")
    return target, source


def from_source(s: Any, a: Any, site: Site) -> Any:
    """Return the value of the source of a target `v<-delta`, a state or an input."""
    _, source = coupled(site)
    return s[source] if source in site.model.states else a[source]


def width(site: Site, speed: str) -> Quantity:
    """Return the speed over which a dry friction builds up: a hundredth of the largest speed.

    A wider one than three tenths of the largest speed would be a viscous friction.
    """
    peak, unit = site.scales.peak(speed), site.unit(speed)
    return Quantity("width", unit, (), 1e-3 * peak, 0.3 * peak, fixed=True, start=0.01 * peak)


def two_axes(unit: str) -> tuple[Quantity, ...]:
    """Return the quantities of an effect with a component along each axis of a plane."""
    return (Quantity("a", unit), Quantity("b", unit))


def speed_limit(site: Site, unit: str) -> tuple[Quantity, ...]:
    """Return a speed limit r, scanned downwards from half the fastest that a step could show."""
    spreads = [site.scales.spread(name) for name in site.targets]
    fastest = max(spreads) / site.scales.dt
    grid = np.geomspace(0.5 * fastest, 0.1 * min(spreads), 12)
    return (Quantity("r", unit, grid, 0.0, np.inf, start=2 * fastest, places=6),)


def scanned_time(
    site: Site, name: str, grid: Array, places: float, reach: float = 1.0
) -> tuple[Quantity, ...]:
    """Return a time that is scanned as far as the model and the log allow.

    What the model itself answers slowly may be late or slow by as much. Of more than a quarter of a
    trial, too little is left in it. `grid` [s] is continued at the ratio of its last two values, of
    which `places` are independent; an estimate may lie beyond it by the factor `reach`.
    """
    far, ratio = min(site.scales.slowest, site.scales.duration / 4), grid[-1] / grid[-2]
    more = max(int(np.log(max(far / grid[-1], 1.0)) / np.log(ratio)), 0)
    whole = np.append(grid, grid[-1] * ratio ** np.arange(1, more + 1))
    places *= len(whole) / len(grid)
    return (Quantity(name, "s", whole, 0.0, reach * float(whole[-1]), places=places),)


@dataclass(frozen=True)
class Family:
    """A family of effects: its name, where it applies, what it estimates.

    Args:
        name: such as `dead_zone`.
        equation: one line of maths for docs and messages.
        sentence: its meaning in plain words. {target} and quantities are filled in. {s}, {es}
            and {has} agree with its number, {g%} is a percentage, {g%stronger|weaker} one with its
            direction. {k>by|less, by} chooses words by the sign of a quantity, whose absolute value
            is then shown. Text in [] is left out if a quantity {b} in it is a constant or zero; of
            parts separated by &, at least one is shown.
        targets: all targets of a model to which it can apply; several signals are joined by "+".
        quantities: the numbers to estimate at a site.
        lookalikes: families that may explain the same data.
        vague: price in nats of naming no mechanism, so that a family that does wins a tie.
        turned: the sentence of a gain for 1 + g below zero.
        loose: whether it names no mechanism and fits anything that repeats with a motion.
        ratio: converts a quantity (name, value) to the ratio shown as {g%}.
        shows: whether data of these sizes can show it at a site; else it is not offered.
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
    shows: Callable[[Site], bool] = lambda site: True

    def at(self, site: Site) -> Effect:
        """Return the effect of this family at a site, with its quantities there."""
        return Effect(self, site, self.quantities(site))


@dataclass(frozen=True)
class InputFamily(Family):
    """effect(u, t, c) -> the input that the actuator receives for a command u at time t.

    `linear`: the effect commutes with a delay by a fraction of a step (a mean of two commands).
    """

    effect: Callable[[Any, Any, Any], Any] = lambda u, t, c: u
    timed: bool = False
    linear: bool = False


@dataclass(frozen=True)
class MemoryFamily(Family):
    """advance(u, z, c, dt) -> (mean input over the step, next memory); z has `depth` entries.

    `depth(values, dt)`: number of memory states, all starting at the input held before t = 0.
    `transport`: a pure delay, which acts after all others. `along(u, z, c, dt)`: for a depth of
    one, z before each step of the commands u (S, T), starting at z (S,). `linear`: as in
    `InputFamily`. `lead(u, z, c, dt)`: by how much of a step's mean more arrives early in it,
    the mean of (1/2 - t/dt) u_eff(t) over the step; None: u_eff is constant within a step.
    """

    advance: Callable[[Any, tuple[Any, ...], Any, Any], tuple[Any, tuple[Any, ...]]] = (
        lambda u, z, c, dt: (u, z)
    )
    depth: Callable[[Mapping[str, float], float], int] = lambda values, dt: 1
    transport: bool = False
    linear: bool = False
    along: Callable[[Any, Any, Mapping[str, float], float], Any] = lambda u, z, c, dt: z[:, None]
    lead: Callable[[Any, Any, Any, Any], Any] | None = None


@dataclass(frozen=True)
class LossFamily(Family):
    """Loss of the input u to the motion w that it drives, at a target `u<-w` (`joint`).

    loss(w, free, gain, u, c, dt): mean over a step that begins at the speed w and would end at
    `free` without the loss; a unit of u adds `gain` to that. torque(w, rate, gain, u, c): the
    instantaneous loss, where the speed's own rate is `rate` and a unit of u adds `gain` to it.
    early: as `loss`, for the first half of a step, with fewer parts; None: `loss` itself.

    A loss may have a memory of the motion (a bent bristle, a wound spring), states that no sensor
    shows. They are among the values c as they are when a step begins, and follow from the motion:

    memory(site): their names with units. later(w, end, gain, u, c, dt): their values after a step
    from the speed w to `end`, gain as in `loss`. rest(u, c): at rest under an input held for long.
    """

    loss: Callable[[Any, Any, Any, Any, Any, Any], Any] = lambda w, free, gain, u, c, dt: 0.0
    torque: Callable[[Any, Any, Any, Any, Any], Any] = lambda w, rate, gain, u, c: 0.0
    early: Callable[[Any, Any, Any, Any, Any, Any], Any] | None = None
    memory: Callable[[Site], Mapping[str, str]] = lambda site: {}
    later: Callable[[Any, Any, Any, Any, Any, Any], Values] = lambda w, end, gain, u, c, dt: {}
    rest: Callable[[Any, Any], Values] = lambda u, c: {}


@dataclass(frozen=True)
class RateFamily(Family):
    """rate(s, a, own, t, c, site) -> {state: added rate}; `own` are the model's own rates.

    It acts half before and half after the model's step, the second half where that half itself
    leads: with both at the states where they begin, a drag's error is of first order in dt.
    `dry`: it does not grow with its target, which the second half may bring to rest: then that acts
    where it begins.
    `parts`: if not 0, it acts on the mean rate of each of so many parts of the step, instead of
    half before and half after the step,

        x+ = x + h (own + rate(x)),   own = (f(x, h) - x) / h,   h = dt / parts

    which is correct for a limit of a rate whose time constant may be shorter than the step.
    `brakes`: it opposes the motion of its target; half a step of it never reverses the motion.
    """

    rate: Callable[[Any, Any, Any, Any, Any, Site], Values] = lambda s, a, own, t, c, site: {}
    timed: bool = False
    needs_own: bool = False
    parts: int = 0
    brakes: bool = False
    dry: bool = False


@dataclass(frozen=True)
class MediumFamily(Family):
    """A moving medium, relative to which the model and rates found beside it act (`medium`).

    shift(s, c, site) -> {velocity state: the medium's velocity in the axes of that state}
    drift(c, site) -> {position state: the medium's velocity over ground}
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
    """The logged values of all target states are `d` seconds old."""


@dataclass(frozen=True)
class SensorLagFamily(Family):
    """The logged value of the target state follows it with the time constant `tau` (a filter)."""


@dataclass(frozen=True)
class ParamFamily(Family):
    """The model's own parameter differs from its nominal value."""


@dataclass(frozen=True)
class Effect:
    """A family at a target, named `family:target`. Built by `Library.effect`."""

    family: Family
    site: Site
    quantities: tuple[Quantity, ...]

    @cached_property
    def name(self) -> str:
        """`family:target`."""
        return f"{self.family.name}:{self.site.joined}"

    @cached_property
    def free(self) -> tuple[Quantity, ...]:
        """The quantities that are estimated."""
        return tuple(q for q in self.quantities if not q.fixed)

    @property
    def fixed(self) -> dict[str, float]:
        """The constants."""
        return {q.name: q.start for q in self.quantities if q.fixed}

    def with_constants(self, values: Mapping[str, float]) -> Effect:
        """Return the same effect with other values of constants."""
        if all(values[name] == value for name, value in self.fixed.items()):
            return self
        new = (replace(q, start=values[q.name]) if q.fixed else q for q in self.quantities)
        return replace(self, quantities=tuple(new))

    @property
    def known(self) -> bool:
        """Whether the model has the effect already, so that its values are changes."""
        return any(q.known for q in self.quantities)

    @property
    def places(self) -> float:
        """Number of independent grid points of the scan, whose logarithm is part of the price."""
        return float(np.prod([max(q.places, 1.0) for q in self.free]))

    def complete(self, values: Mapping[str, float]) -> Mapping[str, float]:
        """Return the values of all quantities, given ones and constants."""
        names = [q.name for q in self.quantities]
        for name in values:
            known("quantity", [name], names, f"effect '{self.name}'")
        whole = {**self.fixed, **{name: float(value) for name, value in values.items()}}
        missing = [name for name in names if name not in whole]
        if missing:
            raise wrong(f"'{missing[0]}' of effect '{self.name}'", must="given")
        return MappingProxyType({name: whole[name] for name in names})


INSIDE_OUT = (
    *(ParamFamily, LossFamily, RateFamily, MediumFamily, SensorFamily),
    *(SensorDelayFamily, SensorLagFamily),  # their memories start at the log
)


def acting_order(families: Sequence[Family]) -> list[int]:
    """Return the indices of the effects on inputs in the order in which they act on a command."""
    own = [i for i, f in enumerate(families) if isinstance(f, InputFamily | MemoryFamily)]
    return sorted(own, key=lambda i: getattr(families[i], "transport", False))


def joining_order(old: Sequence[Family], new: Sequence[Family]) -> list[tuple[bool, int]]:
    """Return the order of old and new effects, as pairs (whether new, index).

    New effects were fitted on the model with the old ones. On commands they act before the old
    ones, otherwise after them.
    """
    first = sorted(acting_order(new))
    last = [i for i in range(len(new)) if i not in first]
    whole = [(first, True), (range(len(old)), False), (last, True)]
    return [(late, i) for some, late in whole for i in some]


def wrapping_order(families: Sequence[Family]) -> list[int]:
    """Return the indices of all effects in wrapping order, the innermost first."""
    inputs = acting_order(families)
    rest = [i for i in range(len(families)) if i not in inputs]

    def depth(i: int) -> tuple[int, bool]:  # limits of rates before rates
        own = (k for k, kind in enumerate(INSIDE_OUT) if isinstance(families[i], kind))
        return next(own, len(INSIDE_OUT)), not getattr(families[i], "parts", 0)

    return [*sorted(rest, key=depth), *reversed(inputs)]


def parallel(slope: Array, own: Array) -> bool:
    """Check whether one array is a multiple of the other, neither of them zero."""
    a, b = slope.reshape(-1), own.reshape(-1)
    lengths = float(a @ a) * float(b @ b)
    return bool(lengths > 0 and np.isfinite(lengths) and (a @ b) ** 2 > (1 - SAME) * lengths)


def beyond(value: Any, most: Any) -> Any:
    """Return by how much a value exceeds the range -most to most, exactly 0 within it.

    The comparison is relative to the limit, because planning rounds corners over a fixed width
    (`Task.smoothing`). In the limit's unit, that width could be larger than the limit itself.
    """
    most = np.maximum(most, LEAST_LIMIT)
    part = value / most
    return most * (np.maximum(part - 1.0, 0.0) - np.maximum(-part - 1.0, 0.0))


LEAST_LIMIT = 1e-12
SAME = 1e-7  # relative difference of squared lengths of equivalent rates


def braked(effect: Effect, s: Any, added: Values, half: Any) -> Values:
    """Return the added rates, those of a brake bounded so that `half` a step reverses no motion."""
    if not getattr(effect.family, "brakes", False):
        return added
    most = {n: np.abs(s[n]) / half for n in added}
    return {n: np.minimum(np.maximum(rate, -most[n]), most[n]) for n, rate in added.items()}


def scales_of(model: Model, states: Array, inputs: Array, dt: float, duration: float) -> Scales:
    """Return the sizes of the signals in recorded data: states (N, n), inputs (N, m)."""
    low, high = {}, {}
    for names, values in ((model.state_names, states), (model.input_names, inputs)):
        for i, name in enumerate(names):
            column = values[np.isfinite(values[:, i]), i]
            if not len(column):
                continue
            low[name], high[name] = (float(q) for q in np.quantile(column, [0.002, 0.998]))
    slowest = _slowest(model, np.nan_to_num(states), np.nan_to_num(inputs), dt, duration)
    moving = {name: states[:, model.state_names.index(name)] for name in places.velocities(model)}
    each = {name: _turns(speeds[np.isfinite(speeds)], dt) for name, speeds in moving.items()}
    turns = {name: turn for name, turn in each.items() if turn is not None}
    return Scales(low, high, dt, duration, slowest, turns)


def _turns(speeds: Array, dt: float) -> tuple[float, float] | None:
    """Return `Scales.turns` of one velocity (N,), None if it hardly ever reversed."""
    clear = np.flatnonzero(np.abs(speeds) > SIGN_IS_NOISE * np.abs(speeds).max(initial=0.0))
    ways = np.sign(speeds[clear])
    begun = clear[1:][ways[1:] != ways[:-1]]
    if len(begun) < REVERSALS:
        return None
    way = np.concatenate([[0.0], np.cumsum(np.abs(speeds)) * dt])
    first = way[np.minimum(begun + RESOLVED, len(speeds))] - way[begun]
    return float(np.median(first)), float(np.median(np.diff(way[begun])))


def _slowest(model: Model, states: Array, inputs: Array, dt: float, duration: float) -> float:
    """Return the slowest time constant dt / |ln eigenvalue| within a duration, along a log."""
    x, u = (a[np.linspace(0, len(a) - 1, SAMPLES).astype(int)] for a in (states, inputs))
    with np.errstate(all="ignore"):
        F = model.system.linearise(x, u, model.values, dt)[0]
        if not np.isfinite(F).all():
            return 0.0
        times = dt / np.abs(np.log(np.linalg.eigvals(F).astype(complex)))
    return float(np.median(np.where(times < duration, times, 0.0).max(axis=1)))


SAMPLES = 8
RESOLVED = 2  # samples after a reversal within which a friction that builds up must show
REVERSALS = 6  # fewest reversals that tell how it builds up
SIGN_IS_NOISE = 0.05  # fraction of the largest speed below which a sign may be noise
