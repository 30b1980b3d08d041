"""What an actuator makes of a command at once: bias, gain, dead zone, stall, saturation, fading.

    u_eff = effect(u, t)

Static maps of one input u; t is the time since the trial began.
"""

from __future__ import annotations

import numpy as np

from grounded.effects import places
from grounded.effects.family import InputFamily, Quantity, Site


def _bias(site: Site) -> tuple[Quantity, ...]:
    return (Quantity("b", site.unit(site.target)),)


def _gain(site: Site) -> tuple[Quantity, ...]:
    return (Quantity("g", "1", low=-1.5, high=5.0),)


def _threshold(site: Site) -> tuple[Quantity, ...]:
    """A threshold below which something differs: scanned, the small ones closely."""
    peak = site.scales.peak(site.target)
    grid = tuple(float(v) for v in np.linspace(0.15, 0.87, 20) ** 2 * peak)
    return (Quantity("c", site.unit(site.target), grid, 0.0, peak, places=8),)


def _limit(site: Site) -> tuple[Quantity, ...]:
    """A limit above which the input is cut: scanned from the peak downwards."""
    peak = site.scales.peak(site.target)
    grid = tuple(float(v) for v in np.linspace(0.95, 0.3, 12) * peak)
    return (Quantity("c", site.unit(site.target), grid, 0.0, 1.5 * peak, start=2 * peak, places=6),)


def _fade(site: Site) -> tuple[Quantity, ...]:
    return (Quantity("k", "1/s", high=1.0 / max(site.scales.duration, 1e-3)),)


input_bias = InputFamily(
    name="input_bias",
    equation="u_eff = u + b",
    sentence="{target} has an offset of {b}",
    targets=places.inputs,
    quantities=_bias,
    lookalikes=("offset", "input_fade", "dead_zone"),
    vague=0.7,  # ln 2: it may have either sign
    effect=lambda u, t, c: u + c["b"],
)

input_gain = InputFamily(
    name="input_gain",
    equation="u_eff = (1 + g) u",
    sentence="{target} acts {g%stronger|weaker} than modelled",
    targets=places.inputs,
    quantities=_gain,
    lookalikes=("viscous_friction", "rate_gain", "parameter", "input_fade"),
    effect=lambda u, t, c: (1 + c["g"]) * u,
)

dead_zone = InputFamily(
    name="dead_zone",
    equation="u_eff = sign(u) max(|u| - c, 0)",
    sentence="{target} has a dead zone of {c}, which every command loses",
    targets=places.inputs,
    quantities=_threshold,
    lookalikes=("stall", "stiction", "coulomb_friction", "backlash", "input_bias"),
    effect=lambda u, t, c: np.maximum(u - c["c"], 0.0) - np.maximum(-u - c["c"], 0.0),
)

stall = InputFamily(
    name="stall",
    equation="u_eff = u where |u| > c, 0 elsewhere",
    sentence="{target} does nothing below {c}",
    targets=places.inputs,
    quantities=_threshold,
    lookalikes=("dead_zone", "stiction"),
    effect=lambda u, t, c: np.where(np.abs(u) > c["c"], u, 0.0),
)

saturation = InputFamily(
    name="saturation",
    equation="u_eff = clip(u, -c, c)",
    sentence="{target} saturates at {c}",
    targets=places.inputs,
    quantities=_limit,
    lookalikes=("rate_limit", "slew_limit", "input_gain", "quadratic_drag"),
    effect=lambda u, t, c: np.minimum(np.maximum(u, -c["c"]), c["c"]),
)

input_fade = InputFamily(
    name="input_fade",
    equation="u_eff = (1 - k t) u",
    sentence="{target} gets {k%weaker every second (a battery that sags)|stronger every second}",
    targets=places.inputs,
    quantities=_fade,
    lookalikes=("input_gain", "trend", "input_bias"),
    effect=lambda u, t, c: (1 - c["k"] * t) * u,
    timed=True,
)

FAMILIES = (input_bias, input_gain, dead_zone, stall, saturation, input_fade)
