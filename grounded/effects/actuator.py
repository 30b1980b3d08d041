"""Effects of actuators: static maps of a command (bias, dead zone, ...) and dynamic ones (delay).

    u_eff     = effect(u, t)             static maps of one input; t is the time in the trial
    u_eff, z+ = advance(u, z, dt)        dynamic maps with a memory z

The command u is held over a step of dt (zero-order hold). The u_eff of a dynamic map is the MEAN of
what the actuator delivers over the step, so fractions of a step matter:

    delay      d = dt (i + f):        u_eff = (1 - f) u[t-i] + f u[t-i-1]
    lag        z' = (u - z) / tau:    z+ = u + (z - u) e,  e = exp(-dt / tau)
                                      u_eff = u + (z - u) (1 - e) tau / dt
    rate limit |z'| <= r:             z+ = z + clip(u - z, -r dt, r dt), ramp then hold
    backlash   width b:               z+ = clip(z, u - b/2, u + b/2)

The mean gives the correct speeds at the end of the step, but what arrives early moves positions
farther, and a servo settles from it longer. A diagnosis makes the step in parts, before and after a
delayed command arrives, or adds the first moment of u_eff within the step (`lead`). Without it,
delays that are no whole steps would be biased.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from grounded import places
from grounded.effects.family import (
    LEAST_LIMIT,
    Effect,
    InputFamily,
    MemoryFamily,
    Quantity,
    Site,
    beyond,
    scanned_time,
    speed_limit,
)
from grounded.frozen import Array
from grounded.model import Model
from grounded.result import per_second

# Usual times of scans, which `scanned_time` continues.
LONGEST_DELAY = 0.5  # longest delay [s]; four steps if these are longer
NEARBY = (0.05, 0.15, 0.4, 0.8, 1.3, 2.0)  # scanned changes of an adopted delay, in steps
LONGEST_LAG = 2.0  # longest time constant [s]; 40 steps if these are longer
NARROWEST = 0.95  # L of `input_curve` is at most this fraction of U
ONE_SIDED = 0.05  # fraction of an input's peak below which the weaker side counts as not used


def _threshold(site: Site) -> tuple[Quantity, ...]:
    """Return a threshold, scanned more finely at small values."""
    peak = max(site.scales.peak(name) for name in site.targets)
    grid = np.linspace(0.15, 0.87, 20) ** 2 * peak
    return (Quantity("c", site.unit(site.target), grid, 0.0, peak, places=8),)


def _limit(site: Site) -> tuple[Quantity, ...]:
    """Return a limit of an input, scanned from the peak downwards."""
    peak = site.scales.peak(site.target)
    grid = np.linspace(0.95, 0.3, 12) * peak
    return (Quantity("c", site.unit(site.target), grid, 0.0, 1.5 * peak, start=2 * peak, places=6),)


def _one_or_all(model: Model) -> list[str]:
    """Return each input, and all together: a delay of radio or camera shifts every command."""
    names = model.input_names
    return [*names, "+".join(names)] if len(names) > 1 else list(names)


def _one_or_alike(model: Model) -> list[str]:
    """Return each input, all of one kind together, and pairs of these (`places.of_a_kind`)."""
    found = list(model.input_names)
    for alike in places.of_a_kind(model):
        groups = [alike, *(itertools.combinations(alike, 2) if 2 < len(alike) <= 4 else ())]
        found += ["+".join(group) for group in groups]
    return found


def _curve(site: Site) -> tuple[Quantity, ...]:
    """Return the quantities of `input_curve`; `a` is held if the log has only one side.

    L is the smallest command of a log that keeps clear of zero, such as a hover's thrust. So the
    model's own gain stays what it is amid the commands that were sent.
    """
    scales, names = site.scales, site.targets
    peak = max(scales.peak(name) for name in names)
    ends = [(scales.low.get(name, -1.0), scales.high.get(name, 1.0)) for name in names]
    whole = Quantity("U", site.unit(site.target), fixed=True, start=peak)
    least = min(max(low, -high, 0.0) for low, high in ends)
    end = Quantity("L", site.unit(site.target), fixed=True, start=min(least, NARROWEST * peak))
    one_sided = all(min(high, -low) < ONE_SIDED * peak for low, high in ends)
    sides = Quantity("a", low=-0.9, high=0.9, fixed=one_sided)
    return (sides, Quantity("b", low=-1.8, high=1.8), whole, end)


def _curved(u: Array, t: Array, c: Mapping[str, Any]) -> Array:
    size, mid = np.abs(u / c["U"]), (1 + c["L"] / c["U"]) / 2
    gain = 1 + c["b"] * (size - mid) / (1 - c["L"] / c["U"])
    return np.asarray(gain * u + c["a"] * c["U"] * size)


def _end_to_end(name: str, value: float) -> float:
    """Return by how much one end's gain exceeds the other's; a and b are relative to the mean."""
    half = value if name == "a" else 0.5 * value
    return (1 + half) / (1 - half) - 1


input_bias = InputFamily(
    name="input_bias",
    equation="u_eff = u + b",
    sentence="{target} {has} an offset of {b}",
    targets=places.inputs,
    quantities=lambda site: (Quantity("b", site.unit(site.target)),),
    lookalikes=("offset", "input_fade", "dead_zone"),
    vague=0.7,  # ln 2: it may have either sign
    effect=lambda u, t, c: u + c["b"],
    linear=True,
)

input_gain = InputFamily(
    name="input_gain",
    equation="u_eff = (1 + g) u",
    sentence="{target} act{s} {g%stronger|weaker} than modelled",
    turned="{target} act{s} the other way round",
    targets=_one_or_alike,
    quantities=lambda site: (Quantity("g", "1", low=-3.0, high=5.0, absurd=4.0),),
    lookalikes=("viscous_friction", "rate_gain", "parameter", "input_fade"),
    effect=lambda u, t, c: (1 + c["g"]) * u,
    linear=True,
)

dead_zone = InputFamily(
    name="dead_zone",
    equation="u_eff = sign(u) max(|u| - c, 0)",
    sentence="every command of {target} loses a dead zone of {c}",
    targets=_one_or_alike,
    quantities=_threshold,
    lookalikes=("stall", "stiction", "coulomb_friction", "backlash", "input_bias"),
    effect=lambda u, t, c: beyond(u, c["c"]),
)

stall = InputFamily(
    name="stall",
    equation="u_eff = u where |u| > c, 0 elsewhere",
    sentence="{target} do{es} nothing below {c}",
    targets=places.inputs,
    quantities=_threshold,
    lookalikes=("dead_zone", "stiction"),
    effect=lambda u, t, c: np.where(np.abs(u) / np.maximum(c["c"], LEAST_LIMIT) > 1.0, u, 0.0),
)

saturation = InputFamily(
    name="saturation",
    equation="u_eff = clip(u, -c, c)",
    sentence="{target} saturate{s} at {c}",
    targets=places.inputs,
    quantities=_limit,
    lookalikes=("rate_limit", "slew_limit", "input_gain", "quadratic_drag"),
    effect=lambda u, t, c: u - beyond(u, c["c"]),
)

input_curve = InputFamily(
    name="input_curve",
    equation="u_eff = (1 + a sign(u) + b (|u| - (L + U) / 2) / (U - L)) u",
    sentence="the gain of {target} is [{a%higher|lower} for positive commands than for negative "
    "ones & {b%higher|lower} at {U}, its largest command in the log, than {least}]",
    ratio=_end_to_end,
    targets=_one_or_alike,
    quantities=_curve,
    lookalikes=("input_gain", "input_bias", "saturation", "dead_zone"),
    vague=0.5,
    effect=_curved,
)


def _fade(site: Site) -> tuple[Quantity, ...]:
    """Return the fade rate, bounded so that a gain neither vanishes nor doubles within a trial."""
    most = 1.0 / max(site.scales.duration, 1e-3)
    return (Quantity("k", "1/s", high=most, absurd=most),)


input_fade = InputFamily(
    name="input_fade",
    equation="u_eff = (1 - k t) u",
    sentence="the gain of {target} gets {k%lower every second (for example a battery that sags)|"
    "higher every second}",
    targets=places.inputs,
    quantities=_fade,
    lookalikes=("input_gain", "trend", "input_bias"),
    effect=lambda u, t, c: (1 - c["k"] * t) * u,
    timed=True,
    linear=True,
)


def _delay(site: Site) -> tuple[Quantity, ...]:
    dt = site.scales.dt
    longest = min(max(LONGEST_DELAY, 4 * dt), site.scales.duration / 4)
    count = int(min(max(round(2 * longest / dt), 6), 14))
    grid = longest * (np.arange(1, count + 1) / count) ** 1.5
    return scanned_time(site, "d", grid, 6)


def delay_again(effect: Effect, known: float, room: float) -> Effect:
    """Return a delay that changes the one `known` to the model, shortened by at most `room` [s]."""
    dt, (d,) = effect.site.scales.dt, effect.quantities
    less = min(known, room)
    near = [part * dt for part in NEARBY if part * dt < d.high]
    grid = (
        *(-by for by in reversed(near) if by <= less),
        *near,
        *(g for g in d.grid if g > near[-1]),
    )
    one = replace(d, grid=grid, low=-less, places=1.0, known=known)
    return replace(effect, quantities=(one,))


def _lag(site: Site) -> tuple[Quantity, ...]:
    dt = site.scales.dt
    last = max(min(max(LONGEST_LAG, 40 * dt), site.scales.duration / 4), dt)
    first = min(max(0.3 * dt, 0.005), 0.5 * last)
    return scanned_time(site, "tau", np.geomspace(first, last, 10), 6, 2.0)


def _backlash(site: Site) -> tuple[Quantity, ...]:
    spread = site.scales.spread(site.target)
    grid = np.linspace(0.02, 0.6, 10) * spread
    return (Quantity("b", site.unit(site.target), grid, 0.0, spread, places=6),)


def _advance_delay(u: Any, z: tuple[Any, ...], c: Any, dt: Any) -> tuple[Any, tuple[Any, ...]]:
    queue = (u, *z)
    steps = np.minimum(c["d"] / dt, len(z))  # what is older than the queue is not known
    received: Any = 0.0
    for i, past in enumerate(queue):
        received = received + np.maximum(1 - np.abs(steps - i), 0.0) * past
    return received, queue[:-1]


def _advance_lag(u: Any, z: tuple[Any, ...], c: Any, dt: Any) -> tuple[Any, tuple[Any, ...]]:
    tau = np.maximum(c["tau"], 1e-6)
    e = np.exp(-dt / tau)
    behind = z[0] - u
    return u + behind * (1 - e) * tau / dt, (u + behind * e,)


def _lead_of_lag(u: Any, z: Any, c: Any, dt: Any) -> Any:
    steps = np.maximum(c["tau"], 1e-6) / dt
    e = np.exp(-1 / steps)
    return (z - u) * steps * (0.5 * (1 + e) - (1 - e) * steps)


def along_lag(u: Any, z: Any, c: Any, dt: float) -> Any:
    """Return the output (S, T) of a first-order lag of signals u (S, T), starting at z (S,).

    With B the shift by one step, 1 / (1 - e B) = (1 + e B) (1 + e^2 B^2) (1 + e^4 B^4) ...
    """
    e, back = float(np.exp(-dt / max(c["tau"], 1e-6))), 1
    path = np.concatenate([z[:, None], (1 - e) * u[:, :-1]], axis=1)
    while back < u.shape[1] and e > 1e-18:
        path[:, back:] += e * path[:, :-back]
        e, back = e * e, 2 * back
    return path


def _advance_rate(u: Any, z: tuple[Any, ...], c: Any, dt: Any) -> tuple[Any, tuple[Any, ...]]:
    most = np.maximum(c["r"] * dt, LEAST_LIMIT)
    part = np.minimum(np.maximum((u - z[0]) / most, -1.0), 1.0)  # fraction of the step on the ramp
    return z[0] + most * part * (1 - 0.5 * np.abs(part)), (z[0] + most * part,)


def _lead_of_rate(u: Any, z: Any, c: Any, dt: Any) -> Any:
    most = np.maximum(c["r"] * dt, LEAST_LIMIT)
    part = np.minimum(np.maximum((u - z) / most, -1.0), 1.0)
    return most * part * np.abs(part) * (np.abs(part) / 6 - 0.25)


def _along_rate(u: Any, z: Any, c: Any, dt: float) -> Any:
    most, path = max(c["r"] * dt, 1e-12), np.empty(u.shape)
    for row, commands, now in zip(path, u.tolist(), z.tolist(), strict=True):
        at = []  # plain Python numbers, faster than NumPy calls for few signals
        for command in commands:
            at.append(now)
            missing = command - now
            now += most if missing > most else -most if missing < -most else missing
        row[:] = at
    return path


def _advance_backlash(u: Any, z: tuple[Any, ...], c: Any, dt: Any) -> tuple[Any, tuple[Any, ...]]:
    held = z[0] - beyond(z[0] - u, 0.5 * c["b"])
    return held, (held,)


def _along_backlash(u: Any, z: Any, c: Any, dt: float) -> Any:
    """Return the output of a backlash by doubling: successive clips combine to one clip."""
    half, back = 0.5 * c["b"], 1
    low, high = (u[:, :-1] + side for side in (-half, half))
    while back < low.shape[1]:
        within = low[:, back:].copy(), high[:, back:].copy()
        low[:, back:], high[:, back:] = (
            np.minimum(np.maximum(end[:, :-back], within[0]), within[1]) for end in (low, high)
        )
        back *= 2
    held = np.minimum(np.maximum(z[:, None], low), high)
    return np.concatenate([z[:, None], held], axis=1)


delay = MemoryFamily(
    name="delay",
    equation="u_eff(t) = u(t - d)",
    sentence="{target} arrive{s} {d} later than modelled",
    targets=_one_or_all,
    quantities=_delay,
    lookalikes=("first_order_lag", "rate_limit", "sensor_delay"),
    advance=_advance_delay,
    depth=lambda values, dt: max(1, int(np.ceil(values["d"] / dt - 1e-9)) + 1),
    transport=True,
)

first_order_lag = MemoryFamily(
    name="first_order_lag",
    equation="tau u_eff' = u - u_eff",
    sentence="{target} lag{s} with a time constant of {tau}",
    targets=_one_or_alike,
    quantities=_lag,
    lookalikes=("delay", "rate_limit", "slew_limit", "parameter"),
    advance=_advance_lag,
    along=along_lag,
    linear=True,
    lead=_lead_of_lag,
)

rate_limit = MemoryFamily(
    name="rate_limit",
    equation="|u_eff'| <= r",
    sentence="{target} can't change faster than {r}",
    targets=_one_or_alike,
    quantities=lambda site: speed_limit(site, per_second(site.unit(site.target))),
    lookalikes=("slew_limit", "first_order_lag", "delay", "saturation"),
    advance=_advance_rate,
    along=_along_rate,
    lead=_lead_of_rate,
)

backlash = MemoryFamily(
    name="backlash",
    equation="u_eff+ = clip(u_eff, u - b/2, u + b/2)",
    sentence="{target} {has} a play of {b}",
    targets=places.inputs,
    quantities=_backlash,
    lookalikes=("dead_zone", "delay", "first_order_lag"),
    advance=_advance_backlash,
    along=_along_backlash,
)

FAMILIES = (
    *(input_bias, input_gain, input_curve, dead_zone, stall, saturation, input_fade),
    *(delay, first_order_lag, rate_limit, backlash),
)
