"""What a person should know about a trial before believing it, in sentences.

Whether it ran its candidate at all is asked in `who_drove.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.model import Model
from grounded.result import measured_alike
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import HUGE, Trial, interpolate_gaps
from grounded_trials.wording import count, in_digits_apart, with_unit
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.estimating import read_estimate
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
TURNS, WIDER = 5.0, 2.0  # of [safety]: beyond it in radians, about inside it in degrees
WIDEN = "no plan will ask for that; widen them if the robot may get it"


def warnings_about(
    workspace: Folder, trial: Trial, last_s: float = float("nan"), fell: bool = False
) -> tuple[str, ...]:
    """Gaps, odd columns, an early end, a start far from s_0, what left [limits] or [safety].

    Args:
        workspace: whose task and candidates hold.
        trial: as it is stored.
        last_s: when the last of its states was logged, seconds of the run; NaN where all are on
            the control grid.
        fell: whether it is known, and told, that the run failed where the trial ends.
    """
    from grounded.instruments.kinematics import integrals
    from grounded.instruments.swapped import exchanged, swapped_columns

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
    model = workspace.base_model
    relations = integrals(model)
    if pair := swapped_columns(model, whole.until(whole.known_steps), relations=relations):
        found.append(exchanged(pair))
    found += dead_sensors(model, whole)
    found += thousands(model, whole)
    found += way_warnings(model, whole)
    found += told_in_degrees(model, whole, found) or _in_degrees(task, whole)
    found += clocks_apart(workspace, whole)
    sent, scaled = mistaken_in(model, whole)
    found += sent
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


def _in_degrees(task: Task, trial: Trial) -> list[str]:
    """Angles far beyond [safety] that would be inside, were they degrees."""
    assert task.safety_low is not None and task.safety_high is not None
    found = []
    for i, (name, unit) in enumerate(task.model.states.items()):
        x, low, high = trial.states[:, i], task.safety_low[i], task.safety_high[i]
        most = float(np.abs(x[np.isfinite(x)]).max(initial=0.0))
        allowed = max(abs(low), abs(high))
        inside = np.deg2rad(most) <= WIDER * allowed
        if unit == "rad" and np.isfinite(allowed) and most > TURNS * allowed and inside:
            found.append(
                f"{name} goes to {most:.3g} rad, [safety] is [{low:g}, {high:g}]: in degrees? "
                f"[log.state.{name}] scale = {np.pi / 180:.8g} would make it "
                f"{np.deg2rad(most):.3g} rad"
            )
    return found


def dead_sensors(model: Model, trial: Trial) -> list[str]:
    """Velocities that show nothing of what their positions do."""
    from grounded.instruments.dead import dead_rates

    return [
        f"{model.state_names[one.relation.j]} {one.told(model)}: is [log] its column, is its "
        "sensor on?"
        for one in dead_rates(model, trial)
    ]


def thousands(model: Model, trial: Trial) -> list[str]:
    """That a position, or its velocity, is in mm, or a thousand times too large twice over."""
    from grounded.instruments.other_units import MEND, units_apart

    known = trial.until(trial.known_steps)
    with np.errstate(all="ignore"):
        apart = units_apart(model, known, range(model.n)) if known.steps > 1 else []
    stored = f", without {trial.id}" if trial.id else ""
    return [f"{one}. {MEND}, and ingest it again{stored}" for one in apart]


def way_warnings(model: Model, trial: Trial) -> list[str]:
    """What the way that was travelled says of heading and speeds: other axes, a compass, knots."""
    from grounded.instruments.rows import kinematic_rows, tied
    from grounded.instruments.way import judge_way

    rows = tied(kinematic_rows(model, range(model.n)))
    known = replace(trial.until(trial.known_steps), id="")
    try:
        with np.errstate(all="ignore"):
            odd = list(judge_way(model, [known], rows))
    except GroundedError as error:
        return [str(error).replace("in trial number 1 ", "")]
    return [f"{one.signal} {one.finding}: {one.log} in [log.state.{one.signal}]" for one in odd]


def told_in_degrees(model: Model, trial: Trial, told: Sequence[str]) -> list[str]:
    """Degrees that a diagnosis would put right, but for those that are told already."""
    from grounded.instruments.preflight import preflight

    try:
        findings = preflight(model, [replace(trial.until(trial.known_steps), id="")]).findings
    except GroundedError:  # it stops the diagnosis, which tells it
        return []
    return [
        f"{said}: multiply the scale in [log.state.{one.signal}] by {one.log.split(' = ')[1]} (1 "
        "where none is given)"
        for one in findings
        if one.kind == "degrees" and one.log
        for said in [f"{one.signal} {one.finding}"]
        if not any(other.startswith(said) for other in told)
    ]


def clocks_apart(workspace: Folder, trial: Trial) -> list[str]:
    """That measured states answer commands before they are sent."""
    from grounded.instruments.clocks import answers_early, one_clock, too_soon

    model, table = workspace.base_model, workspace.config.estimate
    measured = read_estimate(table, model).measured if table.names() else model.state_names
    shown = [i for i, name in enumerate(model.state_names) if name in measured]
    if (early := answers_early(model, trial, shown)) is None:
        return []
    said = f"{too_soon(model, early)}. {one_clock(model, shown, early)}, and ingest it again"
    return [f"{said}, without {trial.id}"]


def mistaken_in(model: Model, trial: Trial) -> tuple[list[str], tuple[str, ...]]:
    """What the model says of exchanged commands or other units, and the inputs in other units."""
    from grounded.instruments.mistaken import as_logged, described, mended_by, mistaken
    from grounded.instruments.preflight import preflight

    known = trial.until(trial.known_steps)
    told = mistaken(model, [known], range(model.n))
    if told is not None:
        try:
            looked = preflight(model, [known])
        except GroundedError:  # of other instruments: the diagnosis tells what looks turned so
            told = None if told.mistake.turned else told
        else:
            told = mistaken(model, looked.trials, range(model.n))
            told = told and as_logged(model, told, looked.findings)
    if told is None:
        return [], ()
    stored = f", without {trial.id}" if trial.id else ""
    again = f"{mended_by(model, told)}, and ingest it again{stored}"
    scaled = () if told.mistake.swap else told.mistake.inputs
    return [f"{described(model, told)}. {again}"], tuple(model.input_names[j] for j in scaled)


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
