"""Compare a run's motion with its commands, by the planner's model.

The
model, with the effects that were adopted and calibrated on the run, predicts from many samples a
quarter of a second to a second ahead: over longer times it tells more, but of a robot that is
unstable, or of a short run, only the shorter ones are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from grounded.accounts.motion import Ahead, Fit
from grounded.search.planner import Planner
from grounded.trial import Trial

STARTS = 80  # samples to predict from
AHEAD = 0.25, 0.5, 1.0  # [s] of the predictions; over a single one, a swing may fit a period late
PLAIN = 1.0  # [nats] that a model may lack without calibration and still be used as it is


def fits(planner: Planner, trial: Trial, *, as_it_is: bool = False) -> list[Fit]:
    """Return the fits of predictions of several lengths, shorter ones first; [] if none is known.

    Args:
        planner: plans with the model, and the effects adopted; its inputs arrive late by its own
            latency.
        trial: a run; only its part without gaps is used.
        as_it_is: do not calibrate the model on the run. Calibration absorbs a part of what a wrong
            command does; a crude model explains nothing without.
    """
    from grounded.effects.memory import late_inputs

    assert planner.plan.latency is not None
    lifted = planner.lift(trial.until(max(trial.finite_steps, 0)))
    if not len(lifted.inputs):
        return []
    sent, latency = lifted.inputs[None], planner.plan.latency
    acts = replace(lifted, inputs=late_inputs(sent, sent[:, 0], latency, trial.dt)[0])
    model, own = planner.plan.model, range(planner.task.model.n)
    each = [Ahead(model, acts, own, STARTS, (0.0,), horizon=one) for one in AHEAD]
    gains = np.ones(model.m)
    with np.errstate(all="ignore"):
        if as_it_is:
            return [one.plain(gains) for one in each if one.enough]
        return [one.best([gains]) for one in each if one.enough]


def explains(planner: Planner, trials: Sequence[Trial]) -> bool:
    """Return whether the model predicts runs about as well as it is as if calibrated on each."""
    lacks = [score(fits(planner, one, as_it_is=True)) - score(fits(planner, one)) for one in trials]
    known = [one for one in lacks if np.isfinite(one)]
    return bool(known) and float(np.median(known)) < PLAIN


def score(found: Sequence[Fit]) -> float:
    """Return the mean error of fits [nats]; NaN without any."""
    return float(np.mean([one.score for one in found])) if found else float("nan")
