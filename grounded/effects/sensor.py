"""Effects of sensors: scale of the odometry; bias, scale, delay and lag of a sensor.

    y = measure(s),   so that a model of logged states is   y+ = measure( f( recover(y), u ) )

A bias of a coordinate that nothing depends on (x of a car on a flat floor) is not identifiable and
has no consequences.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded import places
from grounded.effects.family import (
    Quantity,
    RateFamily,
    SensorDelayFamily,
    SensorFamily,
    SensorLagFamily,
    Site,
    scanned_time,
)


def _delay(site: Site) -> tuple[Quantity, ...]:
    dt = site.scales.dt
    longest = min(max(0.3, 3 * dt), site.scales.duration / 4)
    return scanned_time(site, "d", longest * (np.arange(1, 7) / 6) ** 1.5, 4)


def _lag(site: Site) -> tuple[Quantity, ...]:
    dt = site.scales.dt
    longest = min(max(0.3, 3 * dt), site.scales.duration / 4)
    grid = np.geomspace(min(0.3 * dt, 0.5 * longest), longest, 6)
    return scanned_time(site, "tau", grid, 4, 2.0)


def lagging(behind: Any, moved: Any, tau: Any, dt: Any) -> Any:
    """Return y - s of a filtered sensor after a step of dt in which its state s moved evenly."""
    tau = np.maximum(tau, 1e-6)
    follows = moved * tau / dt
    return (behind + follows) * np.exp(-dt / tau) - follows


odometry_scale = RateFamily(
    name="odometry_scale",
    equation="x' = (1 + k) model, y' = (1 + k) model",
    sentence="distances are {k%longer|shorter} than modelled",
    targets=lambda model: ["+".join(p)] if (p := places.position(model)) else [],
    quantities=lambda site: (Quantity("k", "1", low=-0.8, high=4.0, absurd=1.0),),
    lookalikes=("sensor_scale", "rate_gain", "drift_body"),
    rate=lambda s, a, own, t, c, site: {name: c["k"] * own[name] for name in site.targets},
    needs_own=True,
)

sensor_bias = SensorFamily(
    name="sensor_bias",
    equation="y = s + b",
    sentence="the log of {target} reads {b} {b>too high|too low}",
    targets=places.but_position,
    quantities=lambda site: (Quantity("b", site.unit(site.target)),),
    lookalikes=("offset", "input_bias", "drift_body"),
    measure=lambda value, c: value + c["b"],
    recover=lambda value, c: value - c["b"],
)

sensor_scale = SensorFamily(
    name="sensor_scale",
    equation="y = (1 + k) s",
    sentence="the log of {target} is {k%too large|too small}",
    targets=lambda model: [n for n in places.but_position(model) if n not in model.angles],
    quantities=lambda site: (Quantity("k", "1", low=-0.8, high=4.0, absurd=1.0),),
    lookalikes=("sensor_scale", "odometry_scale", "rate_gain", "input_gain", "parameter"),
    measure=lambda value, c: (1 + c["k"]) * value,
    recover=lambda value, c: value / (1 + c["k"]),
)

sensor_delay = SensorDelayFamily(
    name="sensor_delay",
    equation="y(t) = s(t - d)",
    sentence="the log of {target} is {d} old",
    targets=lambda model: [*places.states(model), *places.late_together(model)],
    quantities=_delay,
    lookalikes=("delay", "first_order_lag", "side_slip"),
)

sensor_lag = SensorLagFamily(
    name="sensor_lag",
    equation="tau y' = s - y",
    sentence="the log of {target} is filtered, with a time constant of {tau}",
    targets=places.velocities,
    quantities=_lag,
    lookalikes=("sensor_delay", "first_order_lag", "sensor_scale"),
)

FAMILIES = (odometry_scale, sensor_bias, sensor_scale, sensor_delay, sensor_lag)
