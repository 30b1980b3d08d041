"""What an actuator makes of past commands: delay, lag, rate limit, backlash.

    u_eff, z+ = advance(u, z, dt)

The command u is held over a step of dt (a zero-order hold), so u_eff is the MEAN of what the
actuator delivers over the step, and fractions of a step matter:

    delay      d = dt (i + f):        u_eff = (1 - f) u[t-i] + f u[t-i-1]
    lag        z' = (u - z) / tau:    z+ = u + (z - u) e,  e = exp(-dt / tau)
                                      u_eff = u + (z - u) (1 - e) tau / dt
    rate limit |z'| <= r:             z+ = z + clip(u - z, -r dt, r dt), ramp then hold
    backlash   width b:               z+ = clip(z, u - b/2, u + b/2)

The memory states of a wrapped model along a recorded trial, where no sensor measured them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from grounded.effects import places
from grounded.effects.family import MemoryFamily, Quantity, Site
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial

LONGEST_DELAY = 0.5  # [s] that a scan considers, where steps are not longer than usual
LONGEST_LAG = 2.0  # [s] the same


def _delay(site: Site) -> tuple[Quantity, ...]:
    dt = site.scales.dt
    longest = min(max(LONGEST_DELAY, 4 * dt), site.scales.duration / 4)
    count = int(min(max(round(2 * longest / dt), 6), 14))
    grid = tuple(float(v) for v in longest * (np.arange(1, count + 1) / count) ** 1.5)
    return (Quantity("d", "s", grid, 0.0, longest, places=6),)


def _lag(site: Site) -> tuple[Quantity, ...]:
    dt = site.scales.dt
    top = min(max(LONGEST_LAG, 40 * dt), site.scales.duration / 4)
    last = max(top, dt)
    first = min(max(0.3 * dt, 0.005), 0.5 * last)
    grid = tuple(float(v) for v in np.geomspace(first, last, 10))
    return (Quantity("tau", "s", grid, 0.0, max(2 * top, last), places=6),)


def _rate(site: Site) -> tuple[Quantity, ...]:
    spread = site.scales.spread(site.target)
    fastest = spread / site.scales.dt
    grid = tuple(float(v) for v in np.geomspace(0.5 * fastest, 0.1 * spread, 12))
    unit = site.unit(site.target)
    unit = "1/s" if unit == "1" else f"{unit}/s"
    return (Quantity("r", unit, grid, 0.0, np.inf, start=2 * fastest, places=6),)


def _backlash(site: Site) -> tuple[Quantity, ...]:
    spread = site.scales.spread(site.target)
    grid = tuple(float(v) for v in np.linspace(0.02, 0.6, 10) * spread)
    return (Quantity("b", site.unit(site.target), grid, 0.0, spread, places=6),)


def _advance_delay(u: Any, z: tuple[Any, ...], c: Any, dt: Any) -> tuple[Any, tuple[Any, ...]]:
    steps = c["d"] / dt
    queue = (u, *z)
    received: Any = 0.0
    for i, past in enumerate(queue):
        received = received + np.maximum(1 - np.abs(steps - i), 0.0) * past
    return received, queue[:-1]


def _advance_lag(u: Any, z: tuple[Any, ...], c: Any, dt: Any) -> tuple[Any, tuple[Any, ...]]:
    tau = np.maximum(c["tau"], 1e-6)
    e = np.exp(-dt / tau)
    behind = z[0] - u
    return u + behind * (1 - e) * tau / dt, (u + behind * e,)


def _advance_rate(u: Any, z: tuple[Any, ...], c: Any, dt: Any) -> tuple[Any, tuple[Any, ...]]:
    most = np.maximum(c["r"] * dt, 1e-12)
    gap = u - z[0]
    far = np.abs(gap)
    moved = np.minimum(np.maximum(gap, -most), most)
    reached = np.minimum(far / most, 1.0)  # the part of the step spent on the ramp
    return z[0] + moved * (1 - 0.5 * reached), (z[0] + moved,)


def _advance_backlash(u: Any, z: tuple[Any, ...], c: Any, dt: Any) -> tuple[Any, tuple[Any, ...]]:
    half = 0.5 * c["b"]
    held = np.minimum(np.maximum(z[0], u - half), u + half)
    return held, (held,)


def _queue_length(values: Mapping[str, float], dt: float) -> int:
    return max(1, int(np.ceil(values["d"] / dt - 1e-9)) + 1)


delay = MemoryFamily(
    name="delay",
    equation="u_eff(t) = u(t - d)",
    sentence="{target} arrive{s} {d} later than modelled",
    targets=lambda model: [*model.input_names, *_together(model.input_names)],
    quantities=_delay,
    lookalikes=("first_order_lag", "rate_limit", "sensor_delay"),
    advance=_advance_delay,
    depth=_queue_length,
    transport=True,
)

first_order_lag = MemoryFamily(
    name="first_order_lag",
    equation="tau u_eff' = u - u_eff",
    sentence="{target} lags with a time constant of {tau}",
    targets=places.inputs,
    quantities=_lag,
    lookalikes=("delay", "rate_limit", "slew_limit", "parameter"),
    advance=_advance_lag,
)

rate_limit = MemoryFamily(
    name="rate_limit",
    equation="|u_eff'| <= r",
    sentence="{target} can't move faster than {r}",
    targets=places.inputs,
    quantities=_rate,
    lookalikes=("slew_limit", "first_order_lag", "delay", "saturation"),
    advance=_advance_rate,
)

backlash = MemoryFamily(
    name="backlash",
    equation="u_eff+ = clip(u_eff, u - b/2, u + b/2)",
    sentence="{target} has a play of {b}",
    targets=places.inputs,
    quantities=_backlash,
    lookalikes=("dead_zone", "delay", "first_order_lag"),
    advance=_advance_backlash,
)


def _together(names: tuple[str, ...]) -> list[str]:
    """All inputs at once: a delay in the radio or the camera shifts every command."""
    return ["+".join(names)] if len(names) > 1 else []


FAMILIES = (delay, first_order_lag, rate_limit, backlash)


def memory_of(wrapped: Model, base: Model, trial: Trial) -> Array:
    """The memory states along a recorded trial, (T + 1, wrapped.n - base.n).

    They start at what held before t = 0 (the held input, the first logged value, a clock at zero)
    and follow the commands and the logged states.
    """
    extra = wrapped.state_names[base.n :]
    now = memory_start(wrapped, base, trial)
    found = [now]
    for t in range(trial.steps):
        x = np.concatenate([trial.states[t], now])[None]
        after = wrapped.system.step(x, trial.inputs[t][None], wrapped.values, trial.dt)
        now = after[0, base.n :]
        found.append(now)
    return np.array(found).reshape(trial.steps + 1, len(extra))


def memory_start(wrapped: Model, base: Model, trial: Trial) -> Array:
    """The memory states at t = 0, (wrapped.n - base.n,)."""
    held = np.zeros(base.m) if trial.start_inputs is None else trial.start_inputs
    start = []
    for name in wrapped.state_names[base.n :]:
        inputs = [i for i, n in enumerate(base.input_names) if name.startswith(f"{n}_")]
        states = [i for i, n in enumerate(base.state_names) if name.startswith(f"{n}_true")]
        if name.endswith("_clock"):
            start.append(0.0)
        elif states:
            start.append(float(trial.states[0, states[-1]]))
        else:
            start.append(float(held[inputs[-1]]) if inputs else 0.0)
    return np.array(start)
