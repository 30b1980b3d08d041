"""The last quarter of the time judges a fit: prediction errors of the model before and after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded.estimate import Measurement, Record
from grounded.estimate.record import part
from grounded.fit.prediction import PredictionError, prediction_error
from grounded.fit.search import Found
from grounded.fit.unknowns import Unknowns
from grounded.model import Model


def held_out(
    records: Sequence[Record], share: float, horizon_s: float, measurement: Measurement
) -> tuple[list[Record], list[Record]]:
    """The first and the last part of every record.

    Whole records where they are short, or where the state in their middle is not measured.
    """
    train, test = [], []
    if any(i < 0 for i in measurement.states):
        horizon_s = np.inf
    long = [r for r in records if share * (r.times[-1] - r.times[0]) > 1.5 * horizon_s]
    if share > 0 and len(long) * 2 >= len(records):
        for record in records:
            edge = round((1 - share) * record.steps)
            train.append(part(record, 0, edge) if record in long else record)
            if record in long:
                test.append(part(record, edge, record.steps))
        return train, test
    every = round(1 / share) if share > 0 else 0
    if every and len(records) >= every:
        test = list(records[every - 1 :: every])
        return [r for r in records if r not in test], test
    return list(records), []


def judged(
    model: Model,
    test: Sequence[Record],
    measurement: Measurement,
    unknowns: Unknowns,
    found: Found,
    horizon_s: float,
) -> tuple[PredictionError, PredictionError]:
    """Held-out prediction errors of the model before and after, each with its own noise."""
    pairs = ((unknowns.start, found.start_noise), (found.climb.at.theta, found.noise))
    judged = []
    for theta, noise in pairs:
        p, latency = unknowns.unpack(theta)
        there = model.with_values(dict(zip(model.param_names, p.tolist(), strict=True)))
        judged.append(
            prediction_error(
                there, test, horizon_s, latency=latency, measurement=measurement, noise=noise
            )
        )
    return judged[0], judged[1]
