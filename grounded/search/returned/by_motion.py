"""Compare a run's motion with its commands, by the model: two of them may have been exchanged.

Commands as a policy sends them don't tell whether they reached the motors that they were for. The
model, with the effects that were adopted and calibrated on the run, predicts from many samples a
quarter of a second to a second ahead: over longer times it tells more, but of a robot that is
unstable, or of a short run, only the shorter ones are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from grounded.accounts.motion import Ahead, Fit
from grounded.accounts.table import Account
from grounded.search.planner import Planner
from grounded.trial import Trial

STARTS = 80  # samples to predict from
AHEAD = 0.25, 0.5, 1.0  # [s] of the predictions; over a single one, a swing may fit a period late
SURE = 2.0  # [nats] by which exchanged inputs must predict a run better, and earlier runs worse
PLAIN = 1.0  # [nats] that a model may lack without calibration and still be used as it is
MOST = 12  # number of pairs of inputs that are tried


@dataclass(frozen=True)
class Exchanged:
    """Two inputs that acted in each other's place.

    Args:
        inputs: their names.
        state: the state that is predicted better with them exchanged.
        times: by how many times.
        shown: earlier runs in which they were in their places.
    """

    inputs: tuple[str, str]
    state: str
    times: float
    shown: tuple[str, ...]

    @property
    def said(self) -> str:
        """That they did, and what shows it: one clause."""
        a, b = self.inputs
        times = f"{self.times:.2g} times" if self.times < 100 else "over 100 times"
        return (
            f"the robot did with {a} what was sent as {b}, and the reverse: with them exchanged, "
            f"the model predicts {self.state} {times} as well"
        )


def exchanged(planner: Planner, trial: Trial, before: Sequence[Trial]) -> Exchanged | None:
    """Return the two inputs that acted in each other's place in a run, or None.

    Args:
        planner: plans with the model, and the effects adopted.
        trial: a run without gaps.
        before: earlier runs; those that the exchange predicts better as well speak against it.
    """
    units = list(planner.task.model.inputs.values())
    pairs = [(i, j) for i, j in combinations(range(len(units)), 2) if units[i] == units[j]]
    if not 0 < len(pairs) <= MOST:
        return None
    as_sent, least, best = fits(planner, trial), -SURE, None
    if not as_sent:
        return None
    for pair in pairs:
        other = fits(planner, _exchange(planner, pair).mended(trial))
        if other and (gain := score(other) - score(as_sent)) < least:
            least, best = gain, (pair, other)
    if best is None:
        return None
    (i, j), other = best
    known = [
        (one.id, score(fits(planner, one)), _exchange(planner, (i, j)).mended(one))
        for one in before
    ]
    told = [(name, plain - score(fits(planner, turned))) for name, plain, turned in known]
    if any(gain > 0 for _, gain in told):
        return None
    shares = other[-1].rms / as_sent[-1].rms
    k = int(np.argmin(shares[: planner.task.model.n]))
    names = trial.input_names
    shown = tuple(name for name, gain in told if gain < -SURE)
    return Exchanged((names[i], names[j]), trial.state_names[k], float(1 / shares[k]), shown)


def _exchange(planner: Planner, pair: tuple[int, int]) -> Account:
    n = planner.task.model.n
    return Account("exchange", pairs=((n + pair[0], n + pair[1]),))


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
