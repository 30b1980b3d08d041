"""Tell how the robot's program ran its candidate: late, cut, on old samples, smoothed or swinging.

A policy's plan, gains and reference change from step to step, so its commands change even if no new
states arrive. Where they stay the same to the last digit all the same, the step was not run. A loop
at half the rate runs every other step and holds each command twice as long.

A policy takes what it is given for where the robot is now. At 1.8 m/s a pose that is 6.8 ms old is
12 mm behind, so the robot runs 12 mm ahead of its target, in every run. The first plan doesn't know
that; later ones allow for the age that the commands show (`grounded.search.feedback.sample_age`).
Samples with the same stamps have one age by these, also if a program filters its speeds: whether
only the velocities are late shows in the commands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from grounded.frozen import Array
from grounded.places import velocities
from grounded.result import figure, listed, measured_alike
from grounded.search.candidate import Candidate, Tried
from grounded.search.feedback.oscillation import SWINGS, calm_ranges, periodic, swings
from grounded.search.feedback.sample_age import PROBED, different, rates, sample_age
from grounded.search.returned.clipped import clipped
from grounded.search.returned.smoothed import smoothed
from grounded.search.returned.who_drove import LEAST, commanded
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.wording import ranges, with_unit
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.remarks.lagging import Lagging

CHANGES = 2e-3  # smallest change of a command by its step alone, relative to its size, that tells
UNSENT = 5  # steps without a command that are fewer are sought where the run begins
LACKING, SENT = 0.05, 0.25  # difference of commands in these, and share of it in the later steps
MOST = 0.3  # share of the steps that tell which may be lost in a run
RATHER = 0.7  # of the commands' squared errors: velocities alone are late if they leave less
NEARLY = 0.4  # largest part of an adopted delay by which states that were predicted ahead miss it
OLDEST, SURELY = 5, 0.5  # steps; share of other ages' errors of commands that tells an age
NAMED = 2  # largest number of states that are named
LARGE, MUCH_MORE = 0.2, 4.0  # swings, of an input's limits; of the cost that was predicted
LEADS = 0.3  # share of a state's error over the run: a smaller motion since the sample is not told


def ran_otherwise(workspace: Folder, trial: Trial, lag: Lagging | None) -> str:
    """Return the warning for a run whose program did not run its candidate as planned; or "".

    Args:
        workspace: the workspace with the task and the candidate.
        trial: the trial as stored.
        lag: by how many steps its commands are off, see `lagging`.
    """
    if not trial.candidate:
        return ""
    own, whole = workspace.candidate(trial.candidate)[0], interpolate_gaps(trial).trial
    if cut := clipped(own, whole):
        return f"its commands are {cut.told(own)}, and run {own.id} again"
    if told := steps_skipped(workspace, trial):
        return told
    if found := smoothed(workspace.base_model, own, whole):
        return f"its commands are {found.told(own)}, and run {own.id} again"
    if lag and lag.again:
        return lag.told()
    if told := _older_than_before(workspace, own, whole):
        return told
    return _predicted_ahead(workspace, own, whole)


def _older_than_before(workspace: Folder, own: Candidate, trial: Trial) -> str:
    """Return the warning for a run that acted on older samples than the earlier ones; or "".

    Samples that are as old in every run are the robot's, and later candidates allow for them. Of a
    single one, the next step took its loss for its candidate's: an aircraft's model was given up.
    """
    if own.sample_age or not (old := _steps_old(own, trial)):
        return ""
    ids = workspace.candidate_ids()  # not of another policy of its name, nor of one that is gone
    before = [t for t in workspace.task_trials() if t.candidate in ids and t.id != trial.id]
    ages = [
        _steps_old(workspace.candidate(t.candidate)[0], interpolate_gaps(t).trial) for t in before
    ]
    known = [age for age in ages if age is not None]
    if not known or any(known):
        return ""
    return (
        f"its commands are what {own.id} sends on states that are {1e3 * old * trial.dt:.3g} ms "
        "old, at the present time; earlier runs acted on the newest: pass `runner.action` the "
        f"newest sample, and run {own.id} again"
    )


def _steps_old(own: Candidate, trial: Trial) -> int | None:
    """Return how many steps old the states are by which a run's commands are its policy's.

    None if no age leaves clearly less of its commands than the others do.
    """
    T = min(trial.finite_steps, own.policy.horizon)
    if own.policy.gain is None or T < LEAST:
        return None
    run, off = commanded(own.policy, trial), []
    for old in range(OLDEST + 1):
        states = trial.states[None, np.maximum(np.arange(T) - old, 0)]
        asked = own.policy.commands(states, run.past, run.sent[None])[0]
        error = (asked - run.sent)[OLDEST:] / run.size
        off.append(float(np.median(np.abs(error).max(axis=1))))
    best = int(np.argmin(off))
    rest = min(one for age, one in enumerate(off) if age != best)
    return best if off[best] < SURELY * rest else None


def _predicted_ahead(workspace: Folder, own: Candidate, trial: Trial) -> str:
    """Return the warning for a run that acted on states as new as an adopted delay makes them."""
    effects = _delays(workspace)
    if not effects or own.sample_age:
        return ""
    delay = float(np.median([one["d"] for one in effects]))
    age = sample_age(workspace.task, own, [trial])
    if not abs(age + delay) < NEARLY * delay:
        return ""
    names = listed([str(one["name"]) for one in effects])
    return (
        f"its commands are what {own.id} sends on states that are {-1e3 * age:.2g} ms newer than "
        "those in the log: does its program predict them ahead, or is only the log late? The plan "
        f"allows for {names} already. Let it act on the samples as they are logged or, if only the "
        f"log is late, set delay_s in [log] in place of these effects; and run {own.id} again"
    )


def _delays(workspace: Folder) -> list[Mapping[str, Any]]:
    """Return the adopted delays of sensors."""
    effects = workspace.config.model.effects
    return [one for one in effects if str(one["name"]).startswith("sensor_delay:")]


def steps_skipped(workspace: Folder, trial: Trial) -> str:
    """Return the warning for a run in which many steps, or the first ones, were not run; or "".

    Args:
        workspace: the workspace with the task and the candidate.
        trial: the trial as stored.
    """
    if not (ran := trial.candidate):
        return ""
    trial, task = interpolate_gaps(trial).trial, workspace.task
    policy = workspace.candidate(ran)[0].policy
    T = min(trial.finite_steps, policy.horizon)
    if T < LEAST:
        return ""
    run = commanded(policy, trial)
    sent, asked, past, size = run.sent, run.asked, run.past, run.size
    before = asked[:-1]
    shifted = trial.states[None, np.r_[0, : T - 1]]  # no new states since the step before
    after = policy.commands(shifted, past, sent[None])[0][1:]
    if unsent := _unsent(np.abs(asked - sent) / size, np.abs(sent - past) / size):
        return (
            f"its first {unsent} steps ({unsent * task.dt:.3g} s) sent nothing but what was held "
            f"before the run, and from then on it sent the commands of {ran}: pass "
            "`runner.action` the seconds since the run began, not since the log did, and run "
            f"{ran} again"
        )
    moved = np.abs(np.diff(sent, axis=0))
    finest = np.where(moved > 0, moved, size).min(axis=0)  # to which the log is rounded
    tells = (np.abs(after - before) > np.maximum(CHANGES * size, finest)).any(axis=1)
    changed = np.flatnonzero(moved.any(axis=1))
    held = tells & ~moved.any(axis=1)
    if min(tells.sum(), len(changed)) < LEAST or held.sum() < MOST * tells.sum():
        return ""
    every = float(np.median(np.diff(changed)))
    if every < 2:
        return ""
    ms, dt, lost = 1e3 * every * task.dt, 1e3 * task.dt, 100 - 100 / every
    return (
        f"its commands change every {ms:.3g} ms, dt is {dt:.3g} ms: {lost:.0f} % of "
        f"the steps of {ran} were not run, or not logged. Call the runner every {dt:.3g} ms and "
        f"log every command, and run {ran} again; if the robot can't, set [task] dt = "
        f"{every * task.dt:.3g}"
    )


def _unsent(off: Array, held: Array) -> int:
    """Return how many steps of a run passed before its program sent anything; 0 for few or none.

    Args:
        off: (T, m) differences of the commands from the policy's, relative to their size.
        held: (T, m) differences from what was held before the run.
    """
    begins = int(np.argmax((held > CHANGES).any(axis=1)))
    if not UNSENT < begins < len(off) - LEAST:
        return 0
    lacking, sent = (
        float(np.median(off[part].max(axis=1))) for part in (slice(begins), slice(begins, None))
    )
    return begins if lacking > LACKING and sent < SENT * lacking else 0


def old_samples(workspace: Folder, own: Candidate, trial: Trial, old: Array) -> list[str]:
    """Return a note if the states that the program acted on had moved on by much of their errors.

    Args:
        workspace: whose task the run follows.
        own: the candidate that was run, whose commands the log reproduces.
        trial: its run.
        old: mean age of each state's samples when commands were sent [s], (n,).
    """
    task, delayed = workspace.task, [str(one["name"]) for one in _delays(workspace)]
    allowed = {n for name in delayed for n in name.partition(":")[2].split("+")}
    states = trial.states[: task.horizon + 1]
    if own.policy.gain is None or len(states) < 2:
        return []
    if own.sample_age:
        return _of_another_age(task, own, trial, old)
    by, what = "by the stamps", "samples"
    if old.any() and not np.ptp(old):
        old = _late_velocities(task, own, trial, old)
        by, what = ("by its commands", "velocities") if np.ptp(old) else (by, what)
    error = task.model.difference(states, task.target[: len(states)])
    moved_on = task.model.difference(states[1:], states[:-1]) / task.dt
    off, speed = (
        np.sqrt(np.nansum(e**2, axis=0) / np.isfinite(e).sum(axis=0).clip(1))
        for e in (error, moved_on)
    )
    fed = np.abs(own.policy.gain[..., : states.shape[1]]).max(axis=(0, 1)) > 0  # not past inputs
    counts = fed & (task.reward.state > 0) & (old > 0) & (old * speed > LEADS * off)
    told = [i for i in np.flatnonzero(counts) if task.model.state_names[i] not in allowed]
    if not told:
        return []
    names, units = task.model.state_names, list(task.model.states.values())
    cost = []
    for i in told:
        moved, missed = measured_alike([old[i] * speed[i], off[i]], units[i])
        cost.append(f"{names[i]} by {moved} (its error in this run: {missed} rms)")
    ages = sorted({float(f"{1e3 * old[i]:.2g}") for i in told})
    span = " to ".join(f"{age:g}" for age in dict.fromkeys((ages[0], ages[-1])))
    fresh = "newer samples, or each moved on by its rate times its age"
    then = f"{own.id} does not allow for that: pass `runner.action` {fresh}"
    if sample_age(task, own, [trial]):
        then = f"{own.id} does not allow for that, the next candidates do; better still are {fresh}"
    return [
        f"{by}, its program acted on {what} that were {span} ms old on average; by then "
        f"{listed(cost)} had moved on. {then}"
    ]


def _of_another_age(task: Task, own: Candidate, trial: Trial, old: Array) -> list[str]:
    """Return a note if the samples of a run were not as old as its candidate was planned for.

    Args:
        task: the manoeuvre.
        own: the candidate that was run, planned for `sample_age`.
        trial: its run.
        old: mean age of each state's samples when commands were sent [s], (n,).
    """
    assert own.policy.gain is not None
    age, planned = sample_age(task, own, [trial]) or float(np.median(old)), own.sample_age
    if not different(task, age, planned):
        return []
    states = trial.states[: task.horizon + 1]
    error = task.model.difference(states, task.target[: len(states)])
    moved_on = task.model.difference(states[1:], states[:-1]) / task.dt
    off, speed = (np.sqrt((e**2).mean(axis=0)) for e in (error, moved_on))
    by = abs(age - planned) * speed
    fed = np.abs(own.policy.gain[..., : states.shape[1]]).max(axis=(0, 1)) > 0
    names, units = task.model.state_names, list(task.model.states.values())
    counts, cost = np.flatnonzero(fed & (task.reward.state > 0) & (by > LEADS * off)), []
    for i in sorted(counts, key=lambda i: off[i] / by[i])[:NAMED]:
        moved, missed = measured_alike([by[i], off[i]], units[i])
        cost.append(f"{names[i]} by {moved} (its error in this run: {missed} rms)")
    ms = 1e3 * abs(age - planned)
    told = f": in the {ms:.2g} ms between {listed(cost)} moved on" * bool(cost)
    return [
        f"its program acted on samples that were {1e3 * age:.2g} ms old, {own.id} was planned for "
        f"{1e3 * planned:.2g} ms{told}. If the timer of the program starts at random against the "
        "sensor's, that differs from run to run: send each command when a new sample arrives"
    ]


def _late_velocities(task: Task, own: Candidate, trial: Trial, old: Array) -> Array:
    """Return the ages of a run's samples, all of one age by their stamps: perhaps of rates only.

    The commands are compared with those on samples an age ago, to first order, of all states and of
    the velocities alone. A program that filters its speeds sends the latter.

    Args:
        task: the manoeuvre.
        own: the candidate that was run.
        trial: its run.
        old: the age of each state's samples [s], (n,).
    """
    index, T = {n: i for i, n in enumerate(task.model.state_names)}, task.horizon
    late = [index[name] for name in velocities(task.model)]
    known = np.isfinite(trial.states[: T + 1]).all() and len(trial.states) > T
    if not late or len(late) == len(old) or not known:
        return old
    angles = tuple(map(bool, task.model.angle_mask))
    policy = own.policy.laid_out(task.model.state_names, angles, own.policy.depths)
    x, sent = trial.states[:T], trial.inputs[:T]
    past = policy.past if trial.start_inputs is None else trial.start_inputs
    back, some = PROBED * task.dt * rates(task, trial), np.isin(np.arange(len(old)), late)
    seen = np.stack([x, x - back, x - back * some])
    now, *later = policy.commands(seen, past, sent[None])
    size = np.abs(policy.feedforward).max(axis=0) + 1e-12
    e, by_age = (sent - now) / size, [(one - now) / (PROBED * task.dt) / size for one in later]
    ages = [float(np.vdot(g, e) / (np.vdot(g, g) + 1e-300)) for g in by_age]
    left = [float(np.sum((e - age * g) ** 2)) for age, g in zip(ages, by_age, strict=True)]
    return np.where(some, ages[1], 0.0) if left[1] < RATHER * left[0] else old


def _off_plan(made: Candidate, trial: Trial) -> Array:
    """Return how far a run's inputs are off a candidate's plan, (T, m)."""
    return trial.inputs[: len(made.predicted_inputs)] - made.predicted_inputs[: trial.steps]


def _counted(
    task: Task, counts: Array, sizes: Array, some: Sequence[int], how: str = ""
) -> list[str]:
    """Return some inputs with their swings, as `force (7 swings of more than 2.0 N)`."""
    inputs = [*task.model.inputs.items()]
    return [
        f"{name}{how} ({counts[i]} swings of more than {with_unit(figure(sizes[i], 2), unit)})"
        for i in some
        for name, unit in [inputs[i]]
    ]


def _wavering(task: Task, tried: Tried, trial: Trial) -> list[str]:
    """Return a warning on a run that cost far more than predicted as its inputs went to and fro.

    By less than the plan's range, which one pulse may have: an aircraft's aileron went from limit
    to limit at the end of a run that cost 72 times what was predicted, and nothing said why.
    """
    made = tried.candidate
    if not task.utility(trial) < MUCH_MORE * tried.promised < 0:
        return []
    size = LARGE * (task.high - task.low)
    counts = swings(made, trial, np.where(np.isfinite(size), size, 0.0))
    off = _off_plan(made, trial)
    some = [i for i in np.flatnonzero(counts >= SWINGS).tolist() if periodic(off[:, i])]
    if not some:
        return []
    told = listed(_counted(task, counts, size, some, " about its plan"))
    return [
        f"its feedback moved {told}, and the run cost far more than predicted: with what the model "
        "lacks, such a feedback may make the robot oscillate. Diagnose with this run; a larger "
        "[reward] input_change makes the feedback weaker"
    ]


def swung(task: Task, tried: Tried | None, trial: Trial, history: Sequence[Tried]) -> list[str]:
    """Return a warning that names the inputs that oscillated in a run; [] if none did.

    Args:
        task: the manoeuvre.
        tried: the candidate that was run; None if it is none of the search.
        trial: its run.
        history: all candidates with their trials.
    """
    if tried is None or tried.candidate.policy.gain is None:
        return []
    made = tried.candidate
    ids = [one.candidate.id for one in history]
    sizes = calm_ranges(task, history)[ids.index(made.id)]
    counts = swings(made, trial, sizes)
    some = np.flatnonzero(counts >= SWINGS).tolist()
    if not some:
        return _wavering(task, tried, trial)
    told, off = _counted(task, counts, sizes, some), _off_plan(made, trial)
    cycles = any(periodic(off[:, i]) for i in some)
    did = "oscillate about the plan" if cycles else "swing about the plan, at no one frequency"
    why = "" if cycles else ", as sensor noise does through high gains"
    others = [one for one in tried.trials if one.id != trial.id]
    calm = [one.id for one in others if not (swings(made, one, sizes) >= SWINGS).any()]
    if calm:
        return [
            f"its feedback made {listed(told)} {did}, but not in {ranges(calm)}: did the program "
            "or the robot differ?"
        ]
    return [
        f"its feedback made {listed(told)} {did}{why}: the next candidates get weaker feedback, or "
        "say if they can't"
    ]
