"""Notes on the first plan of a task: what its configuration lacks or asks too much of.

A task may name no limits, ask for more than they allow, or weigh inputs so much that errors hardly
count or so little that sensor noise shakes them.

It may also give values in another unit than the model's: a target of 90 rad was meant as 90
degrees, a [safety] of 1500 m as millimetres. Nothing else tells: the plan goes there, or never
leaves [safety]. Stored logs show how far the robot really moved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from grounded.errors import NextCommand
from grounded.frozen import Array
from grounded.result import listed, measured, measured_alike, percent
from grounded.search.scatter import sensor_noise
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.wording import rendered, with_unit
from grounded_trials.workspace.candidates.rest_at_end import drawn
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.off_target import (
    cost_of_inputs,
    driven,
    position_names,
    reaches,
    still_logged,
    tracked,
    tracking_error,
    weighed_groups,
)
from grounded_trials.workspace.user_files.config import made_changes
from grounded_trials.workspace.user_files.task_file import limited_changes, seen_in

if TYPE_CHECKING:
    from grounded.search.candidate import Candidate
    from grounded.search.standing import Proposal

MOSTLY = 0.9  # share of the cost due to inputs above which a note says so
HELD = 0.8  # share of the steps at a limit above which an input counts as limited
BOUND = 0.05  # share of the steps at limits that only a log gave from which it is told
TIGHTER = 0.9  # of the plan's smallest turning radius: a target below it turns too tightly
ROUND = 0.05  # of that radius by which a plan must be off
TURNING = 0.1  # share of the steps at a limit above which that limit is the reason
LASTING = 0.25  # share of a plan at whose end an input is at a limit that keeps it off its target
SHORT = 0.25  # share of the target's extent by which a plan may end away from the target's end
MISSED = 0.1  # share of the target's extent above which an error is reported
SHAKEN = 0.05  # share of an input's [limits] (else of its range in the plan) moved by noise
ASIDE = 0.01  # share of the target's extent by which a plan may be off, as an rms
NARROW, LEAST = 0.02, 0.2  # or of its smallest range, counted as at least this of the largest
CLOSER, ENOUGH = 10.0, 0.6  # factor tried on the position's weights; share of the error then left
PIECES = 10  # pieces of the plan in which the effect of noise is computed
OFTEN = 4  # jumps over half the range of an input; a quick manoeuvre has two or three
SOMEWHERE = 1.5  # ratio of the noise in one piece to the whole above which its time is reported
FAR = 5.0  # times the largest command in any stored log: limits beyond it may be in another unit
OTHER = 1.5  # ratio of weights above which a weight was made for other [limits]
BEYOND = 20.0  # times as far as any log: from there on, the unit is doubted
NEAR = (0.2, 10.0)  # times as far as the logs that a value reaches in the right unit
TURN = 2 * math.pi  # angles up to a turn are not doubted
SMALLER = {"m": ("mm", 1000.0), "rad": ("degrees", 180 / math.pi)}  # unit, factor; also a second


def left_open(workspace: Folder, proposal: Proposal, held: Sequence[str]) -> list[str]:
    """Return notes on the configuration that the operator should know before the first run.

    Args:
        workspace: a workspace in which nothing was run yet.
        proposal: the first plan, or why there is none.
        held: the result of `at_rest.held_before`.
    """
    task, first, found = workspace.task, proposal.candidate, list[str]()
    off, extent, near = (0.0, 0.0, 0.0) if first is None else _off_path(task, first)
    astray = off > near
    free = [
        name
        for name, *both in zip(task.model.input_names, task.low, task.high, strict=True)
        if not np.isfinite(both).all()
    ]
    if np.allclose(task.target, task.start):
        found.append(
            "the target stays where the run starts, in every state: draw another with `target`"
        )
    if free:
        found.append(f"[limits] has none for {', '.join(free)}: plans may send values of any size")
    if first is not None and (idle := _without_effect(task, first)):
        found.append(
            f"{listed(idle)} change{'s' * (len(idle) == 1)} no state in the model: complete the "
            f"equations and values in {workspace.config.model.file or 'the model'}"
        )
    if log := seen_in(workspace.config):
        seen = f"[limits] are only the range used in {log} (0 included)"
        found.append(
            f"{_never_sent(workspace) or seen}: enter the robot's real limits, then delete seen_in "
            "there"
            + _at_limits(task, first)
            + "; and draw the manoeuvre (`target`): target.csv is the run in that log"
            * still_logged(workspace)
        )
    if first is not None and first.predicted_utility < 0:
        share = cost_of_inputs(task, first.predicted_run) / -first.predicted_utility
        if share > MOSTLY and (astray or not _chosen(workspace)):
            found.append(
                f"{percent(share)} of the plan's cost is [reward] input and input_change, so the "
                "search gains most by smoother inputs: with less weight there (a tenth, say), "
                "errors would count for more"
            )
    found += in_another_unit(workspace)
    found += _of_other_limits(workspace)
    if first is not None:
        short = (
            _turns_wide(task, first, off) or _held_back(task, first) or _falls_short(task, first)
        )
        if not short and astray and extent:
            short = _outweighed(workspace, first, off)
        found += short
        found += _thrown(task, first) or _shaken(workspace, first)
    found += held
    loose = _not_held(workspace, proposal.refused) if proposal.refused is not None else []
    found += loose
    leaves = proposal.refused is not None and _leaving(task, proposal.refused).any()
    if leaves and not held and not loose:
        found.append(
            "nothing was run yet: draw a target whose run stays inside [safety] (`target`) and "
            "propose again; widen [safety] only if the robot may really go there"
        )
    name = str(workspace.config.task.target)
    rows = len(workspace.read_target(workspace.folder / name)[1])
    if rows > task.horizon + 1:
        found.append(
            f"{name} has {rows} rows, but [task] horizon = {task.horizon} uses only the first "
            f"{task.horizon + 1}: the plan ends after {task.horizon * task.dt:g} s"
        )
    return found


def _at_limits(task: Task, first: Candidate | None) -> str:
    """Return for how much of a plan its inputs are at their limits, as a clause; or ""."""
    sent = None if first is None else first.predicted_inputs
    told = []
    for j, name in enumerate(task.model.input_names if sent is not None else ()):
        assert sent is not None
        ends = [end for end in (task.low[j], task.high[j]) if np.isfinite(end)]
        at = [np.isclose(sent[:, j], end, rtol=1e-3, atol=1e-9) for end in ends]
        share = float(np.any(at, axis=0).mean()) if at else 0.0
        told += [f"{name} is at them for {percent(share)} of this plan"] * (share > BOUND)
    return f" ({listed(told)})" if told else ""


def _never_sent(workspace: Folder) -> str:
    """Return which [limits] are FAR beyond all that was sent, as if in another unit; or ""."""
    task = workspace.task
    logs = [one.trial for one in workspace.whole_trials() if workspace.fits(one.trial)]
    told = []
    for j, (name, unit) in enumerate(task.model.inputs.items() if logs else ()):
        sent = max(float(np.abs(t.inputs[: t.known_steps, j]).max(initial=0.0)) for t in logs)
        most = max(abs(float(task.low[j])), abs(float(task.high[j])))
        if np.isfinite(most) and 0 < FAR * sent < most:
            times, size = f"{most / sent:.3g} times", with_unit(f"{sent:.4g}", unit)
            told.append(f"of {name} reach {times} as far as it was ever sent ({size})")
    return f"[limits] {' and '.join(told)}, so check their unit" if told else ""


def _chosen(workspace: Folder) -> bool:
    """Return whether the weights on input changes are not those that `init` or `target` wrote."""
    made = made_changes(workspace.config.file.read_text(encoding="utf-8"))
    names, weights = workspace.base_model.input_names, workspace.task.reward.input_change
    return not made or any(made.get(n) != w for n, w in zip(names, weights, strict=True))


def _without_effect(task: Task, plan: Candidate) -> list[str]:
    """Return the inputs that change no step of the model along a plan, at either of their limits.

    An example is a gain that is still 0 in a model skeleton.
    """
    model, sent, found = task.model, plan.predicted_inputs, list[str]()
    x = plan.predicted_states[: len(sent)]
    for j, name in enumerate(model.input_names):
        ends = [
            end if np.isfinite(end) else other
            for end, other in ((task.low[j], sent[:, j] - 1), (task.high[j], sent[:, j] + 1))
        ]
        after = []
        for end in ends:
            u = sent.copy()
            u[:, j] = end
            after.append(model.system.step(x, u, model.values, task.dt))
        if task.low[j] < task.high[j] and np.array_equal(after[0], after[1]):
            found.append(name)
    return found


def _of_other_limits(workspace: Folder) -> list[str]:
    """Return a note if weights on input changes were made for other [limits] than the current."""
    config, model = workspace.config, workspace.base_model
    made = made_changes(config.file.read_text(encoding="utf-8"))
    weights = dict(zip(model.input_names, workspace.task.reward.input_change, strict=True))
    now = {name: by for name, (_, by) in limited_changes(config, model).items()}
    off = [
        name
        for name, by in now.items()
        if weights[name] == made.get(name) and not 1 / OTHER < weights[name] / by < OTHER
    ]
    if not off:
        return []
    was = ", ".join(f"{name} = {weights[name]:.4g}" for name in off)
    new = ", ".join(f"{name} = {now.get(name, w):.4g}" for name, w in weights.items() if w)
    return [
        f"[reward] input_change has {was}, made for a different range from that in [limits]. For "
        f"the current [limits] write input_change = {{ {new} }}, or draw the target again "
        "(`target` updates it if no weight in [reward] was changed)"
    ]


def _not_held(workspace: Folder, refused: Candidate) -> list[str]:
    """Return notes on states that leave [safety] and have no target, or no weight on it."""
    task = workspace.task
    out = _leaving(task, refused)
    weight = task.reward.state + task.reward.terminal
    given, names = np.isfinite(task.target).any(axis=0), task.model.state_names
    bare = [names[i] for i in np.flatnonzero(out & ~given)]
    free = [names[i] for i in np.flatnonzero(out & given & (weight == 0))]
    found = []
    if bare:
        start = {name: float(task.start[names.index(name)]) for name in bare}
        more = " ".join(f"--to {name}={value:g}" for name, value in start.items())
        line = drawn(task)
        how = "with a column for each of them"
        if line is not None:
            again = NextCommand(line.verb, (*line.arguments, *more.split()))
            command = rendered(again, workspace.address)
            how = f"and add {more}: `{command}`, with your other options"
        found.append(
            f"{listed(bare)} {'leave' if len(bare) > 1 else 'leaves'} [safety] and "
            f"{'have' if len(bare) > 1 else 'has'} no column in the target, so nothing in [reward] "
            f"keeps the run inside. Draw the target again {how}"
        )
    if free:
        found.append(
            f"{listed(free)} {'leave' if len(free) > 1 else 'leaves'} [safety], and [reward] state "
            "has no weight for the target there: add one"
        )
    return found


def _leaving(task: Task, plan: Candidate) -> NDArray[np.bool_]:
    """Return which states leave [safety] in a plan, (n,)."""
    assert task.safety_low is not None and task.safety_high is not None
    states = plan.predicted_states
    out: NDArray[np.bool_] = np.any(
        (states < task.safety_low) | (states > task.safety_high), axis=0
    )
    return out


def _held_back(task: Task, first: Candidate) -> list[str]:
    """Return a note if [limits] keep a plan off its target.

    An input is at one nearly always, or throughout the last part, as for a pose that it can't hold.
    """
    names, sent, aim = task.model.input_names, first.predicted_inputs, task.input_target
    assert aim is not None
    held, ended = [], []
    for j, name in enumerate(names):
        for end in (float(task.low[j]), float(task.high[j])):
            at = np.isclose(sent[:, j], end, rtol=1e-3, atol=1e-9)
            last = len(at) if at.all() else int(np.argmin(at[::-1]))
            if not np.isfinite(end) or np.allclose(aim[:, j], end):
                continue
            its = f"{name} is at its limit of {with_unit(f'{end:.4g}', task.model.inputs[name])}"
            if (share := float(at.mean())) > HELD:
                held.append(f"{its} for {percent(share)} of the plan")
            elif last > LASTING * len(at):
                ended.append(f"{its} from {(len(at) - last) * task.dt:.3g} s on")
    off, far, what, unit = _end_off(task, first)
    if ended and not held and off > MISSED * far > 0:
        short, way = measured_alike([off, far], unit)
        return [
            f"{' and '.join(ended)}, and still the plan ends {short} from the end of the target, "
            f"which moves {what} over {way}: [limits] don't seem to allow reaching and holding it. "
            "Widen them if the robot can take more, or let the target end nearer or later"
        ]
    if not held or not (missed := _most_missed(task, first.predicted_run)):
        return []
    return [
        f"{' and '.join(held)}, and still {missed}: the target seems to require more "
        "than [limits] allow. Widen them if the robot can take more, or draw a slower target"
    ]


def _turns_wide(task: Task, first: Candidate, off: float) -> list[str]:
    """Return a note if the target turns tighter than a plan can with an input at its limits.

    Args:
        task: its target and limits.
        first: the plan.
        off: how far it is off its path, an rms.
    """
    model = task.model
    places = [model.state_names.index(n) for n in position_names(model) if n in model.states]
    if len(places) != 2 or not {*places} <= {*tracked(task)}:
        return []
    radii = []
    for run in (task.target, first.predicted_states):
        columns = {model.state_names[i]: run[:, i] for i in places}
        radii.append(driven(model, columns, task.dt)[1])
    asked, able = radii
    if not asked < TIGHTER * able < np.inf or off < ROUND * asked:
        return []
    sent, shares = first.predicted_inputs, list[tuple[float, str]]()
    for j, name in enumerate(model.input_names):
        ends = [end for end in (task.low[j], task.high[j]) if np.isfinite(end) and end != 0]
        at = [np.isclose(sent[:, j], end, rtol=1e-3, atol=1e-9) for end in ends]
        shares.append((float(np.any(at, axis=0).mean()) if at else 0.0, name))
    share, name = max(shares)
    if not share > TURNING:
        return []
    a, b = measured_alike([asked, able], model.states[model.state_names[places[0]]])
    return [
        f"the target turns with a radius of {a}, tighter than the model can within [limits]: "
        f"{name} is at its limits for {percent(share)} of the plan, whose tightest turn has {b}. "
        f"Draw it {able / asked:.2g} times as large (or slower, if the model turns tighter then), "
        f"or widen the limits of {name} if the robot can take more"
    ]


def _falls_short(task: Task, first: Candidate) -> list[str]:
    """Return a note if a plan ends far from the target's end although no input is at its limit."""
    off, far, what, unit = _end_off(task, first)
    if not off > SHORT * far > 0:
        return []
    short, way_told = measured_alike([off, far], unit)
    return [
        f"the plan ends {short} from the end of the target, which moves {what} "
        f"over {way_told}: either [reward] makes getting closer too costly, or the model cannot "
        "get there in time. Weigh inputs and their changes less, draw a slower target, or check "
        "model.py"
    ]


def _end_off(task: Task, first: Candidate) -> tuple[float, float, str, str]:
    """Return how far a plan ends from the target's end, the target's extent, what that is, unit."""
    if not (groups := weighed_groups(task)):
        return 0.0, 0.0, "", ""
    names, what = groups[0]
    states, unit = [task.model.state_names.index(n) for n in names], task.model.states[names[0]]
    left = task.model.difference(first.predicted_states[-1], task.target[-1])[states]
    return float(np.linalg.norm(left)), _extent(task, states), what, unit


def _outweighed(workspace: Folder, first: Candidate, off: float) -> list[str]:
    """Return a note if a plan leaves the path because [reward] weighs other states as much.

    That is tried: the note gives the error of a plan with larger weights on the position, beside
    that of the first plan, `off`.
    """
    from grounded.search.first_policy import finished

    task, aim = workspace.task, workspace.planner.aim
    groups = weighed_groups(task)
    if len(groups) < 2 or aim.model.system.how != "compiled":
        return []
    names, what = groups[0]
    states, unit = [task.model.state_names.index(n) for n in names], task.model.states[names[0]]
    ends = reaches(task)
    if not (ends or len(names) > 1) or not task.reward.state[states].all():
        return []
    state, terminal = aim.reward.state.copy(), aim.reward.terminal.copy()
    state[states], terminal[states] = CLOSER * state[states], CLOSER * terminal[states]
    reward = replace(aim.reward, state=state, terminal=terminal)
    closer = finished(replace(aim, reward=reward).problem(), first.predicted_inputs)
    left, *_ = _off_path(task, replace(first, predicted_states=closer.z[:, : task.model.n]))
    was, now = measured_alike([off, left], unit)
    how = "at its end" if ends else "rms"
    if not left < ENOUGH * off:
        own = ", ".join(f"{names[k]} = {task.reward.state[i]:.4g}" for k, i in enumerate(states))
        return [
            f"the plan is off {what} by {was} {how}, and by {now} with {CLOSER:g} times the weight "
            f"on it: are its weights in [reward] state ({own}) far below the others', or is the "
            "target beyond what the model or [limits] allow?"
        ]
    weights = ", ".join(f"{names[k]} = {state[i]:.4g}" for k, i in enumerate(states))
    return [
        f"the plan is off {what} by {was} {how}, because [reward] state weighs "
        f"{listed([name for others, _ in groups[1:] for name in others])} as well: with "
        f"{CLOSER:g} times the weight on it ({weights}) a plan is off by {now}"
        + "; its feedback is stronger then, and carries more sensor noise"
        * bool(np.any(first.policy.gain))
    ]


def _off_path(task: Task, plan: Candidate) -> tuple[float, float, float]:
    """Return the error of a plan in the first weighed group, the group's extent, and what is near.

    It is the error at the end if the task is to reach a point, else the rms error. What is near is
    a share of the extent or, of a path that is long and narrow, of its width: a boat that was to
    change its lane by 0.8 m along 5 m was planned 51 mm off it, as its heading weighed as much.
    """
    groups = weighed_groups(task)
    if not groups:
        return 0.0, 0.0, 0.0
    states = [task.model.state_names.index(name) for name in groups[0][0]]
    error = task.model.difference(plan.predicted_states, task.target)[:, states]
    off = np.linalg.norm(error[-1:] if reaches(task) else error, axis=1)
    extent, ranges = _extent(task, states), _ranges(task, states)
    near = min(ASIDE * extent, NARROW * max(ranges.min(), LEAST * ranges.max()))
    return float(np.sqrt(np.mean(off**2))), extent, float(near)


def _extent(task: Task, states: Sequence[int]) -> float:
    """Return the diagonal of the box that the start and the target of some states span."""
    return float(np.linalg.norm(_ranges(task, states)))


def _ranges(task: Task, states: Sequence[int]) -> Array:
    """Return the ranges of some states in the start and the target."""
    return np.asarray(np.ptp(np.vstack([task.start, task.target])[:, states], axis=0))


def _thrown(task: Task, first: Candidate) -> list[str]:
    """Return notes on inputs that often jump over more than half their [limits] in one step."""
    from grounded.search.feedback.oscillation import jumps

    times = jumps(first.predicted_inputs, task.high - task.low)
    return [
        f"in the plan {name} jumps over half its [limits] from one step to the next, "
        f"{times[j]} times: for a smoother {name} increase [reward] input_change of {name}"
        for j, name in enumerate(task.model.input_names)
        if times[j] >= OFTEN
    ]


def _shaken(workspace: Folder, first: Candidate) -> list[str]:
    """Return notes on inputs that sensor noise moves much through the feedback gains."""
    task, gain, found = workspace.task, first.policy.gain, []
    if gain is None:
        return []
    noise = sensor_noise(workspace.task_trials(), workspace.base_model.n)
    parts = gain[:, :, : task.model.n] ** 2 * noise**2  # (H, m, n)
    pieces = np.array_split(parts, min(PIECES, len(parts)))  # gains grow towards an end
    each = np.sqrt([piece.sum(axis=2).mean(axis=0) for piece in pieces])  # (pieces, m)
    rms, overall = each.max(axis=0), np.sqrt(parts.sum(axis=2).mean(axis=0))
    planned = np.ptp(first.predicted_inputs, axis=0)
    given = np.isfinite(task.high - task.low)
    allowed = np.where(given, np.nan_to_num(task.high - task.low, posinf=0.0), planned)
    for j, (name, unit) in enumerate(task.model.inputs.items()):
        if not rms[j] > SHAKEN * allowed[j] > 0:
            continue
        at = int(np.argmax(each[:, j]))
        k = int(np.argmax(pieces[at][:, j].mean(axis=0)))
        state, its = list(task.model.states.items())[k]
        when = sum(len(piece) for piece in pieces[:at]) * task.dt
        where = f" from {when:.3g} s on" * bool(rms[j] > SOMEWHERE * overall[j])
        found.append(
            f"sensor noise moves {name} by {measured(rms[j], unit)} rms{where} through the gains, "
            f"mostly the noise of {state} ({measured(noise[k], its)}): for a smoother {name} "
            f"increase [reward] input_change of {name}"
        )
    return found


def _most_missed(task: Task, plan: Trial) -> str:
    """Return the largest error of a plan relative to the target's extent; "" if it is small."""
    error, found = tracking_error(task, plan), []
    for names, what in weighed_groups(task):
        states = [task.model.state_names.index(name) for name in names]
        far = np.linalg.norm(error[:, states], axis=1)
        k, asked = int(np.argmax(far)), _extent(task, states)
        text = (
            f"{what} misses its target by {measured(far[k], task.model.states[names[0]])} at "
            f"{k * task.dt:.4g} s"
        )
        found.append((float(far[k]) / max(asked, 1e-300), text))
    share, text = max(found, default=(0.0, ""))
    return text if share > MISSED else ""


def in_another_unit(workspace: Folder) -> list[str]:
    """Return a note on each state whose target, start or [safety] seems to be in another unit.

    Args:
        workspace: whose stored logs say how far each state moves.
    """
    task = workspace.task
    logs = [one.trial for one in workspace.whole_trials() if workspace.fits(one.trial)]
    found = []
    for i, (name, unit) in enumerate(task.model.states.items() if logs else ()):
        base, _, per = unit.partition("/")
        if base not in SMALLER or per not in ("", "s"):
            continue
        other, factor = SMALLER[base]
        moved = max(_largest(t.states[:, i]) for t in logs)
        for what, most in _given(workspace, i):
            far = most > max(BEYOND * moved, TURN * (base == "rad"))
            if far and moved > 0 and NEAR[0] < most / factor / moved < NEAR[1]:
                given, seen = (with_unit(f"{v:.4g}", unit) for v in (most, moved))
                found.append(
                    f"{what} of {name} is {given}, {most / moved:.3g} times as far as it moves in "
                    f"any log ({seen}): if it is in {other}{per and ' a second'}, multiply it by "
                    f"{1 / factor:.8g}"
                )
    return found


def _given(workspace: Folder, i: int) -> Iterator[tuple[str, float]]:
    """Yield what is given of a state, as the subject of a sentence, and its largest value."""
    task = workspace.task
    assert task.safety_low is not None and task.safety_high is not None
    name = task.model.state_names[i]
    columns, _ = workspace.read_target(workspace.folder / str(workspace.config.task.target))
    if name in columns:
        yield "the target", _largest(task.target[:, i])
    if name in workspace.config.task.start:
        yield "[task] start", abs(float(task.start[i]))
    yield "[safety]", _largest(np.array([task.safety_low[i], task.safety_high[i]]))


def _largest(values: np.ndarray) -> float:
    """Return the largest absolute value that is finite; 0 without any."""
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
