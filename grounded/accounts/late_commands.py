"""Tell a program that sends its commands late from a log that has them late, by the robot's motion.

A program that passes its policy the state and the time of some steps ago sends what was due then.
A log that stamps commands late has the same numbers. But the robot moves by what it was sent: in
the first case its motion follows the commands in the log as it does in every run, in the second it
leads them by that time. How far motion usually follows commands is not known from a crude model,
which may lack a delay, but from earlier runs whose commands were in time. The model, calibrated on
the run, predicts a quarter of a second to a second ahead: over longer times it tells more, but of a
robot that is unstable, or of a short run, only the shorter ones are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum

import numpy as np

from grounded.accounts.motion import Ahead, Fit
from grounded.search.planner import Planner
from grounded.trial import Trial

BEYOND = 1, 6  # steps beyond the lead or lag in question that are tried: a delay may be missing
CLEAR = 0.2  # [nats] by which one explanation must predict the run better than the other
BESIDE = 1  # steps about the best shift in which another that is as good is the same
STARTS = 80  # samples to predict from
AHEAD = 0.25, 0.5, 1.0  # [s] of the predictions; over a single one, a swing may fit a period late
PLAIN = 1.0  # [nats] that a model may lack without calibration and still be used as it is
NEAR = 0.35  # of the lag: how near the motion must be to what an explanation expects


class Late(Enum):
    """What is late where the commands of a log lag those of its policy."""

    PROGRAM = "program"
    LOG = "log"
    EITHER = "either"


def what_is_late(planner: Planner, trial: Trial, late: int, before: Sequence[Trial]) -> Late:
    """Return whether a run's commands were sent late or logged late.

    Args:
        planner: plans with the model, and the effects adopted.
        trial: a run without gaps, whose commands are those of its policy `late` steps before.
        late: [steps], > 0.
        before: earlier runs, whose commands were in time.
    """
    plain = explains(planner, before)
    now = Shifted(planner, trial, late, as_it_is=plain)
    if (own := now.best) is None:
        return Late.EITHER
    earlier = [Shifted(planner, one, late, as_it_is=plain).best for one in before]
    known = [by for by in earlier if by is not None]
    usual = float(np.median(known)) if known else 0.0
    clear, leads = now.missed(usual - late) - now.missed(usual), usual - own
    if leads > (1 - NEAR) * late and clear < -CLEAR:  # a cause comes before its effect
        return Late.LOG
    # without earlier runs the rest may be a delay that no model has yet
    return Late.PROGRAM if known and leads < NEAR * late and clear > CLEAR else Late.EITHER


class Shifted:
    """How well the model predicts a run with its commands moved by some steps.

    Args:
        planner: plans with the model, and the effects adopted.
        trial: a run without gaps.
        most: the largest lead or lag of interest [steps].
        as_it_is: do not calibrate the model on the run.
    """

    def __init__(
        self, planner: Planner, trial: Trial, most: int, *, as_it_is: bool = False
    ) -> None:
        whole = trial.until(max(trial.finite_steps, 0))
        self.shifts = np.arange(-most - BEYOND[0], most + BEYOND[1] + 1)
        each = [_shifted(whole, int(shift)) for shift in self.shifts]
        self.scores = np.array([score(fits(planner, one, as_it_is=as_it_is)) for one in each])

    @property
    def best(self) -> float | None:
        """By how many steps the motion follows the commands, beyond the model's delays.

        Negative if it leads; None if the run does not tell, since another shift fits as well.
        """
        if not np.isfinite(self.scores).all():
            return None
        k = int(np.argmin(self.scores))
        others = np.abs(self.shifts - self.shifts[k]) > BESIDE
        rival = self.scores[others].min() < self.scores[k] + CLEAR
        if rival or not 0 < k < len(self.scores) - 1:
            return None
        left, least, right = self.scores[k - 1 : k + 2]
        return float(self.shifts[k] + 0.5 * (left - right) / max(left - 2 * least + right, 1e-12))

    def missed(self, shift: float) -> float:
        """Return the errors of predictions with commands moved later by `shift` steps [nats]."""
        return float(np.interp(shift, self.shifts, self.scores))


def _shifted(trial: Trial, shift: int) -> Trial:
    """Return a trial with its commands moved later by `shift` steps."""
    at = np.clip(np.arange(len(trial.inputs)) - shift, 0, len(trial.inputs) - 1)
    return replace(trial, inputs=trial.inputs[at])


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
