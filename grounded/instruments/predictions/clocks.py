"""Clock faults: time stamps that run at a wrong rate, and states and commands on different clocks.

A clock that runs at half speed halves all derivatives. Sensor by sensor this looks like a scale
error of each. If two or more scales agree and none contradicts, the clock is to blame
(`told_by_the_clock`).

States that respond before their command is sent are on another clock, since no physics does that.
Two other causes look similar. Under feedback the commands follow the states, so future commands
help to predict the motion. Friction or back-EMF missing from the model makes the robot quicker than
the model. The model therefore predicts a quarter of a second ahead, once with the commands as
logged and once with commands from later. Both predictions are calibrated (`short_runs`), and
everything linear in the states, as friction would be, is projected out. The later commands are
accepted if they act about as the model says and leave a much smaller error than the commands up to
that time can explain. Those may act through the model with a delay, gains, other parameters or a
quicker actuator (commands extrapolated by their own slope), or through any law that is linear in
them. In a smooth motion past commands predict future ones, so such a law explains it just as well;
in a short log it explains nearly everything. Offsets below EARLY_S are ignored: an actuator lag
that is too large in the model can cause them.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array
from grounded.instruments.finding import Finding, unusable
from grounded.instruments.predictions.short_runs import Ahead, Fit
from grounded.model import Model
from grounded.places import integrals
from grounded.result import listed
from grounded.trial import Trial

EARLY_S, REACH_S, GRID_S = 0.1, 1.0, 0.05  # [s] smallest and largest shift tried; coarse spacing
ALIKE = 0.1  # relative tolerance within which the ratios agree
CHORD_S = 0.5  # [s] chord over which distance is measured: noise lengthens shorter ones
LEAST_M = 1.0  # shorter distances (by positions or by the speed) are not compared
PART = 0.25  # of a trial: the largest shift tried
HINT, CLEAR = 0.5, 0.8  # [nats] least reduction of the errors: uncalibrated, calibrated
SURELY = 1.6  # [nats] the same in fewer than half of the trials: all have one clock, mostly
HALF = 0.5  # the error of at least one state must fall to this share
LIKE = 4.0  # an input's gain must be within this factor of the model's
LEADS = (0.1, 0.3)  # [s] lead times of commands extrapolated by their slope
DIFFERENCE_S = 0.04  # [s] half the span of the difference that replaces an unmeasured velocity
STARTS = 120  # samples to predict from


@dataclass(frozen=True)
class Early:
    """By how much the states of a trial respond too early, and the evidence.

    Args:
        seconds: the shift, to about one step.
        state: the state whose prediction improves most with the later commands.
        logged: its rms error a quarter of a second ahead with the log as it is, in its unit.
        mended: the same with the later commands.
        gain: by how much the later commands reduce all errors [nats].
    """

    seconds: float
    state: int
    logged: float
    mended: float
    gain: float


def judge_clocks(model: Model, trials: Sequence[Trial], hidden: Sequence[str] = ()) -> None:
    """Raise an error if states respond to commands before they are sent.

    Args:
        model: however crude.
        trials: of its states and inputs.
        hidden: states without a sensor.

    Raises:
        GroundedError: naming the state, the seconds and the correction.
    """
    shown = [i for i, name in enumerate(model.state_names) if name not in hidden]
    each = [answers_early(model, one, shown) for one in trials]
    found = {k: early for k, early in enumerate(each) if early}
    few = 2 * len(found) < len(each)  # a swing that sticks may look like it once
    found = {k: early for k, early in found.items() if not few or early.gain > SURELY}
    if not found:
        return
    early = found[first := min(found)]
    mend = one_clock(model, _known(trials[first], shown), early)
    raise unusable(trials, list(found), too_soon(model, early), mend)


def one_clock(model: Model, shown: Sequence[int], early: Early) -> str:
    """Return the instruction that corrects the clocks."""
    tables = listed(f"[log.state.{model.state_names[i]}]" for i in shown)
    return (
        f"Subtract {early.seconds:.3g} s from delay_s in {tables} (delay_s = -{early.seconds:.3g} "
        "if it has none), or correct the commands' time stamps"
    )


def too_soon(model: Model, early: Early) -> str:
    """Return one clause: what is wrong, and the evidence."""
    name = model.state_names[early.state]
    unit = model.states[name]
    sent = list(model.input_names)
    return (
        f"{name} moves about {early.seconds:.3g} s before {listed(sent)} "
        f"command{'s' * (len(sent) == 1)} it: the clocks of states and commands differ (with "
        f"commands from that much later, the model's error of {name} 0.25 s ahead is "
        f"{early.mended:.2g} instead of {early.logged:.2g}{'' if unit == '1' else f' {unit}'})"
    )


def answers_early(model: Model, trial: Trial, shown: Sequence[int]) -> Early | None:
    """Return by how much the states of a trial lead its commands; None if they do not.

    Args:
        model: however crude.
        trial: of its states and inputs.
        shown: indices of the states with a sensor.
    """
    trial = trial.until(trial.known_steps)
    reach = min(round(REACH_S / trial.dt), int(PART * trial.steps))
    least, every = max(2, round(EARLY_S / trial.dt)), max(1, round(GRID_S / trial.dt))
    if reach <= least or not np.isfinite(trial.inputs).all():
        return None
    seen = _known(trial, shown)
    trial, known = _with_differences(model, trial, seen)

    def later(k: int) -> Ahead:
        moved = _moved(trial, k, reach)
        return Ahead(model, moved, known, STARTS, delays=(0.0,), linear=True)

    ones = np.ones(model.m)
    with np.errstate(all="ignore"):
        logged = Ahead(model, _moved(trial, 0, reach), known, STARTS, linear=True)
        if not logged.enough:
            return None
        moved = {k: later(k).plain(ones).score for k in range(least, reach + 1, every)}
        about = min(moved, key=lambda k: moved[k])
        if moved[about] > logged.plain(ones).score - HINT:
            return None
        near = range(max(least, about - every + 1), min(reach, about + every - 1) + 1)
        fits = {k: _as_told(later(k), ones) for k in near}
        k = min(fits, key=lambda k: fits[k].score)
        if fits[k].score > logged.still().score - CLEAR:
            return None  # the commands explain nothing
        causal = [
            logged.best([ones, np.zeros(model.m)]),
            logged.whatever_commands_do().best([ones]),
            *_quicker(model, trial, reach, known),
        ]
        before = min(causal, key=lambda fit: fit.score)
    parts = fits[k].rms / before.rms
    if before.score - fits[k].score < CLEAR or parts.min() > HALF:
        return None
    state = min(seen, key=lambda i: float(parts[i]))
    errors = float(before.rms[state]), float(fits[k].rms[state])
    return Early(k * trial.dt, state, *errors, gain=before.score - fits[k].score)


def _known(trial: Trial, shown: Sequence[int]) -> list[int]:
    return [i for i in shown if np.isfinite(trial.states[:, i]).any()]


def _as_told(ahead: Ahead, ones: Array) -> Fit:
    """Return the best fit whose input gains are near the model's, or else fixed at 1."""
    free = ahead.best([ones])
    if ((free.gains > 1 / LIKE) & (free.gains < LIKE)).all():
        return free
    return ahead.best([ones], free=False)  # a wrong mass may take the place of the gain


def _moved(trial: Trial, k: int, reach: int) -> Trial:
    """Return the trial with commands from k steps later; the states are the same for all k."""
    steps = trial.steps - reach
    return replace(trial, states=trial.states[: steps + 1], inputs=trial.inputs[k : k + steps])


def _quicker(model: Model, trial: Trial, reach: int, known: Sequence[int]) -> list[Fit]:
    """Return fits with commands extrapolated by their past slope, as for an actuator lag too large.

    These are causal explanations that compete with the later commands.
    """
    sent = trial.inputs
    slope = np.diff(sent, axis=0, prepend=sent[:1]) / trial.dt
    ahead = [replace(trial, inputs=sent + lead * slope) for lead in LEADS]
    some = [Ahead(model, _moved(one, 0, reach), known, STARTS, linear=True) for one in ahead]
    return [one.best([np.ones(model.m)]) for one in some]


def _with_differences(model: Model, trial: Trial, known: list[int]) -> tuple[Trial, list[int]]:
    """Fill in unmeasured velocities by central differences of their positions."""
    states, w = np.array(trial.states), max(1, round(DIFFERENCE_S / trial.dt))
    found = list(known)
    for one in integrals(model):
        if one.exact and one.i in known and one.j not in found and trial.steps > 2 * w:
            x = states[:, one.i]
            states[:, one.j] = np.nan
            states[w:-w, one.j] = (x[2 * w :] - x[: -2 * w]) / (2 * w * trial.dt * one.c)
            found.append(one.j)
    return replace(trial, states=states), sorted(found)


def told_by_the_clock(
    model: Model, trials: Sequence[Trial], found: Sequence[Finding], refuted: Set[str]
) -> list[Finding]:
    """Replace several scale findings by one of the clock, if that explains them all.

    Args:
        model: its roles name the position and the speed.
        trials: real ones.
        found: the findings of all sensors.
        refuted: effects ruled out by two sensors that agree, such as `sensor_scale:w`.
    """
    rates = [one for one in found if one.kind == "scale" and not one.corrected]
    ratios = [one.scale for one in rates]
    if (way := _speed_over_way(model, trials)) is not None:
        ratios.append(way)
    if len(ratios) < 2 or not rates or any(name.startswith("sensor_scale:") for name in refuted):
        return list(found)
    pace = float(np.exp(np.mean(np.log(ratios))))
    if max(abs(r / pace - 1) for r in ratios) > ALIKE or abs(pace - 1) < 2 * ALIKE:
        return list(found)
    names = "+".join(one.signal for one in rates)
    text = (
        f"the clock is wrong, not a sensor: every rate is {pace:.3g} times the derivative of its "
        f"position by the time stamps, so one second of stamps is {1 / pace:.3g} s of the run: "
        f"multiply the stamps by {1 / pace:.3g} and ingest the logs again"
    )
    at = min(found.index(one) for one in rates)
    rest = [one for one in found if one not in rates]
    return [*rest[:at], Finding(names, text, "scale", scale=pace), *rest[at:]]


def _speed_over_way(model: Model, trials: Sequence[Trial]) -> float | None:
    """Return the measured speed over that from the positions; None unless both are measured."""
    position, speed = model.roles.get("position", ()), model.roles.get("speed")
    if len(position) < 2 or not isinstance(speed, str):
        return None
    names = model.state_names
    at = [names.index(name) for name in position]
    shown = gone = 0.0
    for trial in trials:
        every = max(1, round(CHORD_S / trial.dt))
        places = trial.states[::every, at]
        size = np.abs(trial.states[:, names.index(speed)])
        along = np.concatenate([[0.0], np.cumsum((size[1:] + size[:-1]) / 2 * trial.dt)])[::every]
        chords, driven = np.linalg.norm(np.diff(places, axis=0), axis=1), np.diff(along)
        known = np.isfinite(chords) & np.isfinite(driven)
        shown, gone = shown + float(driven[known].sum()), gone + float(chords[known].sum())
    return shown / gone if min(shown, gone) > LEAST_M else None
