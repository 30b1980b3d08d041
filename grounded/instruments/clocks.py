"""Clocks that differ: stamps of another pace, and two clocks that were put together wrongly.

A clock that runs at half speed halves all derivatives. Told sensor by sensor that is a wrong scale
of each; where two or more agree, and none contradicts, it is the clock (`told_by_the_clock`).

States that answer commands before they are sent have another clock: no physics does that. A run of
a feedback controller looks like it, though: its commands follow the states, so what will be sent
tells how the motion goes on; a friction or a back-EMF that the model lacks makes the robot quicker
than the model as well. So the model predicts a quarter of a second ahead with the commands as they
are logged and with commands of later, both times calibrated (`short_runs`) and without what is
linear in the states, which a friction would be. The later ones are believed where they do about
what the model says and leave much less than whatever the commands up to then may do: by the model
with a delay, gains, parameters or a quicker actuator (commands ahead by their own slope), and by
any law that is linear in them. A smooth motion foretells its own commands, so that such a law
follows it as well as the commands of later do; of a short one it follows nearly all. Less than
EARLY_S is not looked for: that little an actuator's crude lag may make.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array
from grounded.instruments.finding import Finding
from grounded.instruments.kinematics import integrals
from grounded.instruments.other_units import unusable
from grounded.instruments.short_runs import Ahead, Fit
from grounded.model import Model
from grounded.result import listed
from grounded.trial import Trial

EARLY_S, REACH_S, GRID_S = 0.1, 1.0, 0.05  # [s] the least and the most that is looked for, and how
ALIKE = 0.1  # of the factor: how nearly the ratios agree
CHORD_S = 0.5  # over which a way is measured: noise lengthens short ones
LEAST_M = 1.0  # chords' lengths of the speed's own: less was not driven
PART = 0.25  # of a trial, at most
HINT, CLEAR = 0.5, 0.8  # [nats] by which later commands must lower the errors: as it is, calibrated
HALF = 0.5  # of the error of one state at least
LIKE = 4.0  # times what the model says, or a part of it: what gain an input may have
LEADS = (0.1, 0.3)  # [s] by which commands are ahead of themselves, by their slope
DIFFERENCE_S = 0.04  # half of that over which a velocity without a sensor is a difference
STARTS = 120  # samples that are predicted from


@dataclass(frozen=True)
class Early:
    """What answers too early in a trial.

    Args:
        seconds: by how much, to a step or so.
        state: the one that is then predicted better by most.
        logged: its rms error a quarter of a second ahead, as it is logged, in its unit.
        mended: the same with the commands of so much later.
    """

    seconds: float
    state: int
    logged: float
    mended: float


def judge_clocks(model: Model, trials: Sequence[Trial], hidden: Sequence[str] = ()) -> None:
    """Stops at trials whose states answer commands before they are sent.

    Args:
        model: however crude.
        trials: of its states and inputs.
        hidden: states that no sensor has.

    Raises:
        GroundedError: with the state, the seconds and what mends them.
    """
    shown = [i for i, name in enumerate(model.state_names) if name not in hidden]
    each = [answers_early(model, one, shown) for one in trials]
    found = {k: early for k, early in enumerate(each) if early}
    if not found:
        return
    early = found[first := min(found)]
    mend = one_clock(model, _known(trials[first], shown), early)
    raise unusable(trials, list(found), too_soon(model, early), mend)


def one_clock(model: Model, shown: Sequence[int], early: Early) -> str:
    """What to do about it."""
    tables = listed(f"[log.state.{model.state_names[i]}]" for i in shown)
    return (
        f"Take {early.seconds:.3g} s off delay_s in {tables} (delay_s = -{early.seconds:.3g} where "
        "none is given), or put the commands' stamps right"
    )


def too_soon(model: Model, early: Early) -> str:
    """What is wrong and how it is known, one clause."""
    name = model.state_names[early.state]
    unit = model.states[name]
    sent = list(model.input_names)
    return (
        f"{name} moves about {early.seconds:.3g} s before {listed(sent)} "
        f"ask{'s' * (len(sent) == 1)} for it: the clocks of states and commands differ (with "
        f"commands of so much later the model misses {name} by {early.mended:.2g} rather than "
        f"{early.logged:.2g}{'' if unit == '1' else f' {unit}'} 0.25 s ahead)"
    )


def answers_early(model: Model, trial: Trial, shown: Sequence[int]) -> Early | None:
    """By how much the states of a trial are ahead of its commands; None where they are not.

    Args:
        model: however crude.
        trial: of its states and inputs.
        shown: states that a sensor has.
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
            return None  # commands tell nothing
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
    return Early(k * trial.dt, state, float(before.rms[state]), float(fits[k].rms[state]))


def _known(trial: Trial, shown: Sequence[int]) -> list[int]:
    return [i for i in shown if np.isfinite(trial.states[:, i]).any()]


def _as_told(ahead: Ahead, ones: Array) -> Fit:
    """The best fit in which commands do about what the model says, by gains or parameters."""
    free = ahead.best([ones])
    if ((free.gains > 1 / LIKE) & (free.gains < LIKE)).all():
        return free
    return ahead.best([ones], free=False)  # a mass may hide what a gain does


def _moved(trial: Trial, k: int, reach: int) -> Trial:
    """The trial with the commands of k steps later, always of the same states."""
    steps = trial.steps - reach
    return replace(trial, states=trial.states[: steps + 1], inputs=trial.inputs[k : k + steps])


def _quicker(model: Model, trial: Trial, reach: int, known: Sequence[int]) -> list[Fit]:
    """Fits with commands that are ahead by their own slope up to now: of a model that is slow."""
    sent = trial.inputs
    slope = np.diff(sent, axis=0, prepend=sent[:1]) / trial.dt
    ahead = [replace(trial, inputs=sent + lead * slope) for lead in LEADS]
    some = [Ahead(model, _moved(one, 0, reach), known, STARTS, linear=True) for one in ahead]
    return [one.best([np.ones(model.m)]) for one in some]


def _with_differences(model: Model, trial: Trial, known: list[int]) -> tuple[Trial, list[int]]:
    """With velocities that no sensor has as differences of their positions, over both sides."""
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
    """The findings, with one of the clock in place of several scales that it explains.

    Args:
        model: whose roles name the position and the speed.
        trials: real ones.
        found: of each sensor.
        refuted: effects that two sensors which agree rule out, `sensor_scale:w` among them.
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
        f"the clock, not a sensor: every rate is {pace:.3g} times that of its position over the "
        f"stamps, so a second of them is {1 / pace:.3g} s of the run: correct the stamps, times "
        f"{1 / pace:.3g}, and take the logs in again"
    )
    at = min(found.index(one) for one in rates)
    rest = [one for one in found if one not in rates]
    return [*rest[:at], Finding(names, text, "scale", scale=pace), *rest[at:]]


def _speed_over_way(model: Model, trials: Sequence[Trial]) -> float | None:
    """The speed that is shown over that of the way in the plane; None where nothing shows both."""
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
