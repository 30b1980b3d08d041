"""What the motion of a run tells of its commands: an input in reverse, late as sent or as logged.

A motor that was wired wrongly gives a faultless log: how its input acts tells, see `commands`.

A program that passes its policy the state and the time of some steps ago sends what was due then.
A log that stamps commands late has the same numbers. But the robot moves by what it was sent: in
the first case its motion follows the commands in the log as it does in every run, in the second it
leads them by that time. How far motion usually follows commands is not known from a crude model,
which may lack a delay, but from earlier runs whose commands were in time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum

import numpy as np

from grounded.accounts.commands import STARTS, Acts, how_inputs_act
from grounded.accounts.motion import HALF_ERROR, HORIZONS, MARGIN, Ahead
from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded.search.planner import Planner
from grounded.trial import Trial

BEYOND = 6  # steps beyond the lag in question that are tried: a delay may be missing
LEFT_BY_FLIP = 0.3  # share left of one state's error if the sign of an input is flipped
# [nats] by which one explanation must predict the run better than the other
PREDICTS_BETTER = MARGIN / 4
NEAR_EXPECTED_LAG = 0.35  # of the lag: how near the motion must be to what an explanation expects


def reversed_input(planner: Planner, trial: Trial, *, astray: bool) -> Finding | None:
    """Return the input that acted the other way round in a trial, or None.

    Args:
        planner: plans with the model, and the effects adopted.
        trial: a trial; only its part without gaps is used.
        astray: it is a run far from its prediction, where predictions with the flipped sign tell.
    """
    acts = _acts(planner, trial)
    wrong = {name: one for name, one in acts.items() if one.sign < 0}
    if wrong:
        name = min(wrong, key=lambda one: abs(wrong[one].share + 1))
        return found("run.reversed", name, share=-wrong[name].share)
    if not astray:
        return None
    # feedback with a wrong sign soon holds an input at its limit, where it does not move on its own
    model, m, own = planner.plan.model, planner.plan.model.m, list(range(planner.task.model.n))
    known = planner.lift(trial.until(max(trial.finite_steps, 0)))
    ahead = Ahead(model, known, range(model.n), STARTS, (0.0,), constant=False)
    if not ahead.enough:
        return None
    with np.errstate(all="ignore"):
        each = ahead.missed(np.vstack([np.ones(m), 1 - 2 * np.eye(m)]), model.values, 0)
        plain, *turned = [ahead.size(one) for one in each]
        nats = [float(np.log(plain / one).sum()) for one in turned]
        j = int(np.argmax(nats))
        shares = np.where(turned[j] > HALF_ERROR * ahead.moved, 1.0, turned[j] / plain)[own]
    i = int(np.argmin(shares))
    if nats[j] < 2 * MARGIN or shares[i] > LEFT_BY_FLIP:
        return None
    state = planner.task.model.state_names[i]
    return found("run.reversed", trial.input_names[j], state=state, times=1 / float(shares[i]))


def signs_of(planner: Planner, trial: Trial) -> dict[str, int]:
    """Return the sign with which each input acts: 1 as in the model, -1 reversed, 0 unknown.

    Args:
        planner: plans with the model, and the effects adopted.
        trial: a trial; only its part without gaps is used.
    """
    return {name: one.sign for name, one in _acts(planner, trial).items()}


def _acts(planner: Planner, trial: Trial) -> dict[str, Acts]:
    model = planner.plan.model
    acts = how_inputs_act(model, planner.lift(trial), range(planner.task.model.n))
    return dict(zip(model.input_names, acts, strict=True))


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
    shifts, now = _missed(planner, trial, late)
    if (own := _best(shifts, now)) is None:
        return Late.EITHER
    earlier = (_best(*_missed(planner, one, late)) for one in before)
    known = [by for by in earlier if by is not None]
    usual = float(np.median(known)) if known else 0.0
    led, followed = (float(np.interp(by, shifts, now)) for by in (usual - late, usual))
    leads = usual - own
    if (
        leads > (1 - NEAR_EXPECTED_LAG) * late and followed - led > PREDICTS_BETTER
    ):  # a cause comes before its effect
        return Late.LOG
    # without earlier runs the rest may be a delay that no model has yet
    follows = leads < NEAR_EXPECTED_LAG * late and led - followed > PREDICTS_BETTER
    return Late.PROGRAM if known and follows else Late.EITHER


def _missed(planner: Planner, trial: Trial, most: int) -> tuple[Array, Array]:
    """Return by how many steps the motion may follow the commands, and what is missed then [nats].

    Args:
        planner: its inputs arrive late by its own latency.
        trial: a run; only its part without gaps is used.
        most: the largest lag of interest [steps].
    """
    from grounded.effects.memory import late_inputs

    assert planner.plan.latency is not None
    shifts = np.arange(-most - 1.0, most + BEYOND + 1)
    lifted = planner.lift(trial.until(max(trial.finite_steps, 0)))
    if not len(lifted.inputs):
        return shifts, np.full(len(shifts), np.nan)
    sent = lifted.inputs[None]
    acts = late_inputs(sent, sent[:, 0], planner.plan.latency, trial.dt)[0]
    model, own, steps = planner.plan.model, range(planner.task.model.n), np.arange(len(acts))

    def missed(shift: int) -> float:
        """Return the mean error of predictions of several lengths, calibrated [nats]."""
        run = replace(lifted, inputs=acts[np.clip(steps - shift, 0, len(acts) - 1)])
        each = [Ahead(model, run, own, STARTS, (0.0,), horizon=one) for one in HORIZONS]
        scores = [one.best([np.ones(model.m)]).score for one in each if one.enough]
        return float(np.mean(scores)) if scores else np.nan

    with np.errstate(all="ignore"):
        return shifts, np.array([missed(int(shift)) for shift in shifts])


def _best(shifts: Array, missed: Array) -> float | None:
    """Return by how many steps the motion follows the commands; None if others fit as well."""
    if not np.isfinite(missed).all():
        return None
    k = int(np.argmin(missed))
    others = np.abs(shifts - shifts[k]) > 1
    if missed[others].min() < missed[k] + PREDICTS_BETTER or not 0 < k < len(missed) - 1:
        return None
    left, least, right = missed[k - 1 : k + 2]
    return float(shifts[k] + 0.5 * (left - right) / max(left - 2 * least + right, 1e-12))
