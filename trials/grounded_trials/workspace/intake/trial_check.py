"""What a person should know about a trial before believing it, in sentences.

Whether it ran its candidate at all is asked in `who_drove.py`, whether its columns are what the
model calls by their names in `log_faults.py`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded.frozen import Array
from grounded.result import measured_alike
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import HUGE, Trial, interpolate_gaps
from grounded_trials.wording import count, in_digits_apart, with_unit
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.who_drove import UNLIKE, follows, latest, second_differences
from grounded_trials.workspace.off_target import reaches, weighed_groups

FAR = 0.1  # of a run's mean cost a step: a start this far from s_0 is worth a warning (or of its
# range in the run, of a state that [reward] does not weigh along the way),
SURE = 3.0  # if it is so many standard deviations of the sensor's noise off, and of earlier starts
MUCH = 1.0  # of a mean step's cost: the run's utility is another for it, however starts scatter
FEWEST = 2  # earlier runs whose starts say how they scatter
LATEST = 3  # steps by which inputs may be logged late, and are told so
WHITE = 0.6745 * 6**0.5  # the median of its second differences, in its standard deviations
AWAY = 0.02  # of its way: how much farther off after a run than at its end is told
WIDEN = "no plan will ask for that; widen them if the robot may get it"


def warnings_about(
    workspace: Folder,
    trial: Trial,
    last_s: float = float("nan"),
    fell: bool = False,
    scaled: Sequence[str] = (),
) -> tuple[str, ...]:
    """Gaps, an early end, a start far from s_0, what left [limits] or [safety].

    Args:
        workspace: whose task and candidates hold.
        trial: as it is stored.
        last_s: when the last of its states was logged, seconds of the run; NaN where all are on
            the control grid.
        fell: whether it is known, and told, that the run failed where the trial ends.
        scaled: inputs that are known, and told, to be logged in another unit.
    """
    task = workspace.task
    filled = interpolate_gaps(trial)
    found = []
    if filled.samples:
        found.append(
            f"{filled.samples} lost samples were interpolated, the longest gap is "
            f"{filled.longest_s:.2f} s of '{filled.state}' at {filled.at_s:.2f} s"
        )
    whole = filled.trial
    if whole.finite_steps < whole.steps:
        name, step = _first_bad(whole)
        found.append(
            f"'{name}' is not a finite number at {step * trial.dt:.2f} s: the trial counts as "
            "ended there"
        )
    if not trial.candidate:
        return (*found, *_beyond(task, whole, scaled))
    if whole.steps < task.horizon and not fell:
        ends = f"after {whole.steps} of {task.horizon} steps ({whole.steps * trial.dt:.2f} s)"
        found.append(
            f"the run ended {ends}: a failed candidate; its data stay usable for fit and diagnose"
            f". {_if_stopped(workspace, trial)}"
            if whole.whole(task.horizon) is whole
            else f"the log ends {ends}{_lacking(task, last_s)}: the rest is judged as if the robot "
            "had gone on as it did last. Log at least one more row after the last command"
        )
    if whole.steps > task.horizon:
        found.append(
            f"the log goes on for {whole.steps - task.horizon} steps after the horizon of "
            f"{task.horizon}: they are not judged"
        )
    whole = whole.until(task.horizon)
    found += _start(task, whole, _starts_before(workspace, trial.id))
    found += _inputs(task, whole)
    candidate, _ = workspace.candidate(trial.candidate)
    found += [] if fell else _unsafe(task, whole, candidate)
    ran = follows(candidate.policy, whole, max(LATEST, latest(task)))
    if ran is not None and ran.alike and ran.late and ran.moved < UNLIKE:
        by = count(abs(ran.late), "step")
        found.append(
            f"the inputs fit the policy better when moved by {by}: they seem to be logged {by} "
            f"{'late' if ran.late > 0 else 'early'}. Log each command at the time it is sent; "
            f"if it is, [log.span] start is {by} too {'early' if ran.late > 0 else 'late'}"
        )
    return tuple(found)


def _if_stopped(workspace: Folder, trial: Trial) -> str:
    """When a run that ended early is no loss of its candidate, and what takes it out."""
    horizon = workspace.task.horizon
    ran = [
        one.id
        for one in workspace.task_trials()
        if one.candidate == trial.candidate and one.whole(horizon).finite_steps >= horizon
    ]
    stopped = f"If you stopped it for a reason of your own, `discard {trial.id}`"
    if not ran:
        return f"{stopped} takes it out"
    return (
        f"{trial.candidate} ran to the end before ({', '.join(ran)}). {stopped} takes it out, as "
        "where only the log was cut"
    )


def _first_bad(trial: Trial) -> tuple[str, int]:
    """The first state or input that is not a finite number, and its step."""
    places = [
        (int(step), name)
        for values, names in ((trial.states, trial.state_names), (trial.inputs, trial.input_names))
        for column, name in zip(values.T, names, strict=True)
        for step in np.flatnonzero(~(np.abs(column) < HUGE))[:1]
    ]
    step, name = min(places, key=lambda place: place[0])
    return name, step


def _lacking(task: Task, last_s: float) -> str:
    """By how much a log of a run misses the last state of the plan, as a part of a sentence."""
    missing = task.horizon * task.dt - last_s
    if not missing > 0:  # its commands end, or its rows are the control steps
        return ""
    return f", its last state {1e3 * missing:.3g} ms before the plan's last"


def _starts_before(workspace: Folder, identity: str) -> Array:
    """How far from s_0 the other runs of this task started, (N, n)."""
    task = workspace.task
    runs = [one for one in workspace.task_trials() if one.candidate and one.id != identity]
    off = [task.model.difference(one.states[0], task.start) for one in runs]
    return np.array(off).reshape(len(off), task.model.n)


def _start(task: Task, trial: Trial, before: Array) -> list[str]:
    """Where a run did not start at s_0, by more than the noise that its sensor shows.

    What [reward] weighs along the way counts by what the first state costs beside a mean step of
    the run, the dearest first; another state by how far the run takes it. A robot is never set
    down twice at one place: as far as the starts `before` (N, n) scatter, nobody can mend it.
    """
    if trial.finite_steps < 0:
        return []
    off = task.model.difference(trial.states[0], task.start)
    states = trial.states[: trial.finite_steps + 1]
    usual = np.ptp(states, axis=0)
    jumps = np.abs(second_differences(states, task.model.angle_mask))
    noise = np.median(jumps, axis=0) / WHITE if len(jumps) else np.zeros(len(usual))
    known = -task.rewards(trial)[: len(states)]
    known = known[np.isfinite(known)]
    usually = known.sum() / max(len(known), 1)
    weight = task.reward.state
    with np.errstate(all="ignore"):
        share = np.where(weight > 0, weight * off**2 / usually, np.abs(off) / usual)
    told = (share > FAR) & (np.abs(off) > np.maximum(SURE * noise, 1e-9))
    if len(before) >= FEWEST:
        told &= (np.abs(off) > SURE * before.std(axis=0, ddof=1)) | (share > MUCH)
    found = []
    for i in sorted(np.flatnonzero(told), key=lambda i: (weight[i] == 0, -share[i])):
        name, unit = list(task.model.states.items())[i]
        began, start = in_digits_apart(float(trial.states[0, i]), float(task.start[i]))
        turned = f" ({np.rad2deg(off[i]):+.2g} degrees)" if unit == "rad" else ""
        does = (
            "its utility is another for it. Set the robot down nearer to the start, `discard "
            f"{trial.id}` and run it again"
            if share[i] > MUCH
            else "it counts as it is, no need to run it again. Set the robot down nearer next time"
        )
        found.append(
            f"the run started with {name} = {with_unit(began, unit)}, the task's start is {start}: "
            f"{with_unit(f'{off[i]:+.2g}', unit)}{turned} off, more than the noise of its log. "
            f"{does[0].upper()}{does[1:]}"
        )
    return found


def _unsafe(task: Task, trial: Trial, ran: Candidate) -> list[str]:
    """Where a run left [safety], which holds of predictions: by most, and what was predicted."""
    assert task.safety_low is not None and task.safety_high is not None
    states = trial.states[: trial.finite_steps + 1]
    found = []
    for i, (name, unit) in enumerate(task.model.states.items() if len(states) else ()):
        low, high, values = task.safety_low[i], task.safety_high[i], states[:, i]
        excess = np.maximum(low - values, values - high)
        t = int(np.argmax(excess))
        if excess[t] > 0:
            first = float(np.argmax(excess > 0)) * trial.dt
            predicted = with_unit(f"{ran.predicted_states[t, i]:.3g}", unit)
            found.append(
                f"the run left [safety] {name} = [{low:g}, {high:g}] at {first:.2f} s: {name} was "
                f"{with_unit(f'{values[t]:.3g}', unit)} at {t * trial.dt:.2f} s, where "
                f"{predicted} was predicted"
            )
    return found


def afterwards(task: Task, whole: Trial) -> list[str]:
    """What a robot did after a run, as far as its log goes on: left [safety], or moved on."""
    return _left_afterwards(task, whole) or _moved_on(task, whole)


def _moved_on(task: Task, whole: Trial) -> list[str]:
    """How far a robot that was to get somewhere is from there once the run is over.

    Where the same inputs are held after the run: what somebody drove is another matter.
    """
    end, last = task.horizon, whole.finite_steps
    groups = weighed_groups(task) if reaches(task) else []
    held = whole.inputs[end:last]
    if not groups or last <= end + 1 or np.ptp(held[1:], axis=0).any():
        return []
    names, what = groups[0]
    states = [task.model.state_names.index(name) for name in names]
    off = task.model.difference(whole.states[: last + 1], task.target[-1])[:, states]
    far = np.linalg.norm(off, axis=1)
    way = np.linalg.norm(np.ptp(np.vstack([task.start, task.target])[:, states], axis=0))
    worst = end + int(np.argmax(far[end:]))
    if not far[worst] > max(AWAY * way, 2 * far[end]):
        return []
    later, then = measured_alike([far[worst], far[end]], task.model.states[names[0]])
    return [
        f"{(worst - end) * task.dt:.2g} s after the run {what} was {later} from its target, at its "
        f"end {then}: [reward] judges the run alone. For a robot that stays there let the target "
        "hold still at its end (target --hold), or weigh the end's rates ([reward] terminal)"
    ]


def _left_afterwards(task: Task, whole: Trial) -> list[str]:
    """Where a robot left [safety] after a run that stayed inside."""
    assert task.safety_low is not None and task.safety_high is not None
    states = whole.states[: whole.finite_steps + 1]
    out = np.maximum(task.safety_low - states, states - task.safety_high)
    if (out[: task.horizon + 1] > 0).any() or not (out > 0).any():
        return []
    t, i = np.unravel_index(int(np.argmax(out)), out.shape)
    first = int(np.argmax((out > 0).any(axis=1))) - task.horizon
    name, unit = list(task.model.states.items())[int(i)]
    low, high = task.safety_low[i], task.safety_high[i]
    return [
        f"{first * whole.dt:.2g} s after its end the robot left [safety] {name} = [{low:g}, "
        f"{high:g}]: {name} was {with_unit(f'{states[t, i]:.3g}', unit)}. Stop it in time, or let "
        "the target come to rest inside"
    ]


def _inputs(task: Task, trial: Trial) -> list[str]:
    if not trial.steps:
        return []
    excess = np.maximum(task.low - trial.inputs, trial.inputs - task.high).max(axis=0)
    return [
        f"the log has {name} up to {excess[i]:.3g} outside its [limits]: log the COMMANDS, after "
        "clipping"
        for i, name in enumerate(trial.input_names)
        if excess[i] > 1e-6
    ]


def _beyond(task: Task, trial: Trial, scaled: Sequence[str]) -> list[str]:
    """Where data show that the robot got more than a plan may ask for: [limits] of one log."""
    from grounded.instruments.inputs import beyond_limits, in_percent, limits_of, span

    past = np.any(beyond_limits(task, trial.inputs), axis=0)
    return [
        f"{name} goes from {span(trial.inputs[:, i])} in this log, beyond its [limits], "
        f"{limits_of(task, i)}: {in_percent(task, trial.inputs, i) or WIDEN}"
        for i, name in enumerate(trial.input_names)
        if past[i] and name not in scaled
    ]
