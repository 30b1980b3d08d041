"""Low-pass filters in sensors, in a fit: the filtered and the true value are separate states.

    tau y' = s - y        y: measured,  s: true value; tau is known from `instruments`, not fitted

If a fit took filtered speeds for the true ones, it would attribute the filter to friction or to a
lag of the drive. `behind_filters` returns a model whose first states are the logged values, like an
adopted sensor lag (`grounded.effects.sensed`), and records with approximate true values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from grounded.effects import Scales, Site, param_name, wrap
from grounded.effects.sensor import sensor_lag
from grounded.errors import GroundedError
from grounded.estimate import Measurement, Record, of_states
from grounded.estimate.record import START_STD
from grounded.frozen import Array
from grounded.model import Model


def behind_filters(
    model: Model,
    records: Sequence[Record],
    measurement: Measurement,
    filters: Mapping[str, float],
) -> tuple[Model, list[Record], Measurement]:
    """Return model, records and measurement with added states for the true values.

    Args:
        model: n states.
        records: records of that model.
        measurement: what they measure; each channel is a state.
        filters: time constants by state [s]; states that no channel measures, or that already have
            a sensor lag in the model, are ignored.

    Raises:
        GroundedError: if a channel measures something other than a state.
    """
    if any(i < 0 for i in measurement.states):
        raise GroundedError(
            "filters apply only to sensors that measure states: expected of_states(model)"
        )
    channels = [model.state_names[i] for i in measurement.states]
    known = {
        name: tau
        for name, tau in filters.items()
        if name in channels and param_name(f"sensor_lag:{name}", "tau") not in model.params
    }
    inner, dt = model, float(np.median(np.diff(records[0].times)))
    for name, tau in known.items():
        effect = sensor_lag.at(Site(inner, (name,), Scales(dt=dt)))
        fixed = tuple(replace(q, fixed=True, start=tau) for q in effect.quantities)
        inner = wrap(replace(effect, quantities=fixed), {"tau": tau}, dt)
    columns = [channels.index(name) for name in known]
    angles = [measurement.angles[c] for c in columns]
    grown = [_with_true(one, model.n, columns, [*known.values()], angles) for one in records]
    return inner, grown, of_states(inner, channels)


def _with_true(
    record: Record, n: int, columns: Sequence[int], taus: Sequence[float], angles: Sequence[bool]
) -> Record:
    """Return the record with start values of the true states near y + tau y'."""
    start = np.zeros((record.steps + 1, n))
    if record.start is not None:
        whole = record.start.ndim == 2
        start[: None if whole else 1] = record.start
    std = np.full(n, START_STD) if record.start_std is None else np.atleast_2d(record.start_std)[0]
    for column, tau, angle in zip(columns, taus, angles, strict=True):
        ahead, off = _ahead(record.times, record.measured[:, column], tau, angle)
        start, std = np.column_stack([start, ahead]), np.append(std, off)
    return replace(record, start=start, start_std=std)


def _ahead(times: Array, shown: Array, tau: float, angle: bool) -> tuple[Array, float]:
    """Return y + tau y' along a record, and the rms of tau y' as its uncertainty."""
    seen = np.isfinite(shown)
    if seen.sum() < 2:
        return np.zeros(len(times)), START_STD
    known = np.unwrap(shown[seen]) if angle else shown[seen]
    y = np.interp(times, times[seen], known)
    more = tau * np.gradient(y, times)
    return y + more, float(np.sqrt(np.mean(more**2))) + 1e-9
