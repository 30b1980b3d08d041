"""What the first plan of a task should tell whoever runs it: what is left open, or out.

A task may name no limits, ask for more than they allow, weigh inputs so much that errors hardly
count or so little that the sensors' noise shakes them, or begin from an input under which the robot
does not stay where it starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.errors import NextCommand
from grounded.model import is_clock
from grounded.result import listed, measured, measured_alike, percent
from grounded.search.scatter import white_noise
from grounded.task import Task
from grounded.trial import Trial
from grounded.utility import step_rewards
from grounded_trials.wording import rendered, with_unit
from grounded_trials.workspace.config import FILE, made_changes
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.off_target import tracked, tracking_error, weighed_groups
from grounded_trials.workspace.task_file import limited_changes, seen_in

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from grounded.frozen import Array
    from grounded.search.candidate import Candidate
    from grounded.search.making import Proposal

MOSTLY = 0.9  # of a plan's cost
HELD = 0.8  # of a plan's steps: an input is at a limit nearly all the time
SHORT = 0.25  # of the way to where a target ends: the plan does not get there
MISSED = 0.1  # of the way that a target asks for: the plan falls short
SHAKEN = 0.05  # of what [limits] allow an input, else of what a plan uses of it
PIECES = 10  # of a plan, in each of which that is asked
OFTEN = 4  # jumps over half its range: a quick manoeuvre has two or three
SOMEWHERE = 1.5  # times what noise does over the whole plan: a piece that stands out
FARTHEST = 1e4  # in its unit: how far a state that nobody gave may be from where it starts
UNGIVEN = 3  # states, whose values at the start are asked for: of more nobody has thought
STILL = 1e-3  # of the rates under the held input: under another one the robot stands
OTHER = 1.5  # times the weight that [limits] would give: it was made by others
NOTHING = 1e-6  # of an input's [limits], else of 1 in its unit: 0
MOVED = 0.01  # of the same: a given input that no longer holds the start
BEGUN = (0.0, 1.0, -1.0)  # beside the held input: a thrust by its square has no slope at 0


def left_open(workspace: Folder, proposal: Proposal, held: Sequence[str]) -> list[str]:
    """What a task leaves open, or out, that whoever runs its first plan should know.

    Args:
        workspace: where nothing was run yet.
        proposal: with its plan, or why there is none.
        held: what `held_before` says.
    """
    task, first, found = workspace.task, proposal.candidate, list[str]()
    free = [
        name
        for name, *both in zip(task.model.input_names, task.low, task.high, strict=True)
        if not np.isfinite(both).all()
    ]
    if np.allclose(task.target, task.start):
        found.append(
            "the target is to stay where the run starts, in every state: `target` draws another"
        )
    if free:
        found.append(
            f"[limits] has none for {', '.join(free)}: what a plan asks for is sent, however much"
        )
    if log := seen_in(workspace.config):
        found.append(
            f"[limits] are those that {log} happened to use, and a target that `init` wrote is "
            "what that log did: put in what the robot may get, and draw the manoeuvre (`target`)"
        )
    if first is not None and first.predicted_utility < 0:
        none = np.zeros(task.model.n)
        reward, sent = replace(task.reward, state=none, terminal=none), first.predicted_inputs
        error, aim = np.zeros((len(sent) + 1, len(none))), task.input_target
        assert aim is not None
        share = step_rewards(reward, error, sent, aim, task.past).sum() / first.predicted_utility
        if share > MOSTLY:
            found.append(
                f"{percent(share)} of what the plan costs is [reward] input and input_change: with "
                "less weight there, errors would count for more"
            )
    found += _of_other_limits(workspace)
    if first is not None:
        found += _held_back(task, first) or _falls_short(task, first)
        found += _thrown(task, first) or _shaken(workspace, first)
    found += held
    loose = _not_held(workspace, proposal.refused) if proposal.refused is not None else []
    found += loose
    if proposal.standing.ending == "not allowed" and not held and not loose:
        found.append(
            "nothing was run yet: draw a target whose run stays inside [safety] (`target`) and "
            "propose again; widen [safety] only where the robot may really go there"
        )
    name = str(workspace.config.task.target)
    rows = len(workspace.read_target(workspace.folder / name)[1])
    if rows > task.horizon + 1:
        found.append(
            f"{name} has {rows} rows, of which [task] horizon = {task.horizon} uses the first "
            f"{task.horizon + 1}: the plan ends after {task.horizon * task.dt:g} s"
        )
    return found


def _of_other_limits(workspace: Folder) -> list[str]:
    """Where weights on changes of inputs are still those that were made by other [limits]."""
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
        f"[reward] input_change has {was}, made for another range than [limits] have now. "
        f"By [limits] as they are now it would be input_change = {{ {new} }}: write that, or draw "
        "the target again (`target` does so where no weight in [reward] was changed)"
    ]


def _not_held(workspace: Folder, refused: Candidate) -> list[str]:
    """Which states leave [safety] that nothing keeps on a target, and what gives them one."""
    task = workspace.task
    assert task.safety_low is not None and task.safety_high is not None
    states, weight = refused.predicted_states, task.reward.state + task.reward.terminal
    out = np.any((states < task.safety_low) | (states > task.safety_high), axis=0)
    given, names = np.isfinite(task.target).any(axis=0), task.model.state_names
    bare = [names[i] for i in np.flatnonzero(out & ~given)]
    free = [names[i] for i in np.flatnonzero(out & given & (weight == 0))]
    found = []
    if bare:
        start = {name: float(task.start[names.index(name)]) for name in bare}
        more = " ".join(f"--to {name}={value:g}" for name, value in start.items())
        drawn = _drawn(task)
        how = "with a column for each as well"
        if drawn is not None:
            again = NextCommand(drawn.verb, (*drawn.arguments, *more.split()))
            command = rendered(again, workspace.address)
            how = f"with {more} as well, so that it stays: `{command}`, and what else you gave"
        found.append(
            f"{listed(bare)} {'leave' if len(bare) > 1 else 'leaves'} [safety] and "
            f"{'have' if len(bare) > 1 else 'has'} no column in the target: nothing in [reward] "
            f"asks to stay inside. Draw the target again {how}"
        )
    if free:
        found.append(
            f"{listed(free)} {'leave' if len(free) > 1 else 'leaves'} [safety], and [reward] state "
            "gives no weight to keeping the target there: give it one"
        )
    return found


def _drawn(task: Task) -> NextCommand | None:
    """The line or step that a target seems to be, to states' values; None for another one."""
    from grounded_trials.logs.inspect_pairs import velocities

    names, rates = task.model.state_names, set(velocities(task.model).values())
    given = [i for i in tracked(task) if names[i] not in rates]
    way = task.model.difference(task.target, task.start)[:, given]
    if not way.any():
        return None
    k = int(np.argmax(np.abs(way[-1])))
    if not way[-1, k]:
        return None
    share = way[:, k] / way[-1, k]
    if not np.allclose(way, share[:, None] * way[-1], atol=1e-6 * abs(way[-1, k])):
        return None
    shape = "step" if np.allclose(share[1:], 1.0) else "line"
    to = (("--to", f"{names[i]}={task.target[-1, i]:g}") for i in given)
    return NextCommand("target", (shape, *(word for pair in to for word in pair)))


def _held_back(task: Task, first: Candidate) -> list[str]:
    """Where [limits] keep a plan from its target: an input is at one nearly all the time."""
    names, sent, aim = task.model.input_names, first.predicted_inputs, task.input_target
    assert aim is not None
    held = []
    for j, name in enumerate(names):
        for end in (float(task.low[j]), float(task.high[j])):
            share = float(np.isclose(sent[:, j], end, rtol=1e-3, atol=1e-9).mean())
            if np.isfinite(end) and share > HELD and not np.allclose(aim[:, j], end):
                limit = with_unit(f"{end:.4g}", task.model.inputs[name])
                held.append(f"{name} is at its limit of {limit} for {percent(share)} of the plan")
    plan = Trial(first.predicted_states, sent, task.dt, task.model.state_names, names)
    if not held or not (missed := _most_missed(task, plan)):
        return []
    return [
        f"{' and '.join(held)}, and still {missed}: the target seems to ask for more "
        "than [limits] allow. Widen them if the robot may get more, or draw a slower target"
    ]


def _falls_short(task: Task, first: Candidate) -> list[str]:
    """Where a plan ends far from where its target ends, though no input is at its limit."""
    if not (groups := weighed_groups(task)):
        return []
    names, what = groups[0]
    states, unit = [task.model.state_names.index(n) for n in names], task.model.states[names[0]]
    way = np.vstack([task.start, task.target])[:, states]
    left = task.model.difference(first.predicted_states[-1], task.target[-1])[states]
    off, far = float(np.linalg.norm(left)), float(np.linalg.norm(np.ptp(way, axis=0)))
    if not off > SHORT * far > 0:
        return []
    short, way_told = measured_alike([off, far], unit)
    return [
        f"the plan ends {short} from where the target does, which takes {what} "
        f"over {way_told}: by [reward] it is not worth more, or the model does not get "
        "there in that time. Weigh inputs and their changes less, draw a slower target, or look at "
        "model.py"
    ]


def _thrown(task: Task, first: Candidate) -> list[str]:
    """Inputs that a plan throws from one end of their [limits] towards the other, often."""
    from grounded.search.limit_cycle import jumps

    times = jumps(first.predicted_inputs, task.high - task.low)
    return [
        f"the plan throws {name} over half its [limits] from one step to the next, "
        f"{times[j]} times: for a calmer {name} give [reward] input_change of {name} more weight"
        for j, name in enumerate(task.model.input_names)
        if times[j] >= OFTEN
    ]


def _shaken(workspace: Folder, first: Candidate) -> list[str]:
    """Inputs that the sensors' noise moves much through the gains, before anything was run."""
    task, gain, found = workspace.task, first.policy.gain, []
    if gain is None:
        return []
    noise = sensor_noise(workspace)
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
            f"the sensors' noise moves {name} by {measured(rms[j], unit)} rms{where} through the "
            f"gains, most of it that of {state} ({measured(noise[k], its)}): for a calmer {name} "
            f"give [reward] input_change of {name} more weight"
        )
    return found


def sensor_noise(workspace: Folder) -> Array:
    """The white noise of each state (n,) in the latest log; 0 without one."""
    trials = workspace.task_trials(measured=True)
    return white_noise(trials[-1].states) if trials else np.zeros(workspace.base_model.n)


def _most_missed(task: Task, plan: Trial) -> str:
    """What a plan misses by most, beside the way that its target asks for; "" for nothing much."""
    error, way, found = tracking_error(task, plan), np.vstack([task.start, task.target]), []
    for names, what in weighed_groups(task):
        states = [task.model.state_names.index(name) for name in names]
        far = np.linalg.norm(error[:, states], axis=1)
        k, asked = int(np.argmax(far)), float(np.linalg.norm(np.ptp(way[:, states], axis=0)))
        text = (
            f"{what} misses its target by {measured(far[k], task.model.states[names[0]])} at "
            f"{k * task.dt:.4g} s"
        )
        found.append((float(far[k]) / max(asked, 1e-300), text))
    share, text = max(found, default=(0.0, ""))
    return text if share > MISSED else ""


def held_before(workspace: Folder, again: bool = False) -> list[str]:
    """That the robot does not stand at its start, but would under another input held before.

    Or with other values of states that nobody gave, a fan's speed say. Nothing is said of an input
    whose value somebody gave, nor where it makes no difference: without a price on changes and
    without latency the first command is as if nothing had been held.

    Args:
        workspace: whose first plan it is.
        again: another model was planned with before: what somebody gave may have held that one.
    """
    base, planner, config = workspace.task, workspace.planner, workspace.config.task
    task, loose = planner.plan, planner.loose
    assert base.latency is not None
    names, states, n = task.model.input_names, task.model.state_names, base.model.n
    memory = np.arange(task.model.n) >= n  # of adopted effects: it settles
    free = memory.copy()
    biased = {str(e["name"]).removeprefix("sensor_bias:") for e in workspace.config.model.effects}
    begun = dict(zip(states, base.target[0], strict=False))  # by no sensor: off by its bias
    free[:n] = [s not in config.start and (np.isnan(x) or s in biased) for s, x in begun.items()]
    chosen = any(name in config.start for name in names)
    priced = bool(base.reward.input_change.any() or base.latency.any())
    stands = None if (chosen and not again) or not priced else resting(task, memory, loose)
    if stands is None and 0 < free[:n].sum() <= UNGIVEN:
        stands = resting(task, free, loose)
    if stands is None:
        return []
    units = {**base.model.states, **task.model.inputs}
    given = np.concatenate([task.start[:n], task.past])
    stands = np.concatenate([stands[:n], stands[len(states) :]])
    span = np.append(np.ones(n), task.high - task.low)
    span = np.where(np.isfinite(span), span, np.maximum(1.0, np.abs(given)))
    stands[np.abs(stands) < NOTHING * span] = 0.0
    if chosen and not (np.abs(stands - given) > MOVED * span).any():
        return []
    rate = moved_at_start(task, task.past) / task.dt
    k = int(np.argmax(np.abs(rate[:n])))
    other = {
        name: to
        for name, at, to in zip(units, given, stands, strict=True)
        if name in names or abs(to - at) > STILL * (1 + abs(to))
    }
    before = dict(zip(units, given, strict=True))
    held = ", ".join(with_unit(f"{name} = {before[name]:.4g}", units[name]) for name in other)
    whole = {name: f"{value:.10g}" for name, value in config.start.items() if name in units}
    whole |= {name: f"{to:.4g}" for name, to in other.items()}
    told = ", ".join(f"{name} = {whole[name]}" for name in units if name in whole)
    return [
        f"at the start {held} counts as held, under which {states[k]} changes at once, by "
        f"{with_unit(f'{rate[k]:.3g}', units[states[k]])} a second; the plan begins from there, "
        "and after its end the runner holds that input again. If the robot stands until then, give "
        f"{FILE}'s [task] what holds it, and propose again (if not, propose again as it is): "
        f"start = {{ {told} }}"
    ]


def resting(task: Task, free: NDArray[np.bool_], loose: Task | None = None) -> Array | None:
    """States and inputs (n + m,) inside the limits that stay as they are, from where a run starts.

    None where it stands under the input held before, or nothing holds it: the start is in motion.
    The clock of an effect that grows with time goes on: what holds the start, holds it then.

    Args:
        task: whose start it is.
        free: (n,), states that may be others than those of the start.
        loose: the task with dry frictions that build up slowly: what sticks tells of no input
            whether it holds.
    """
    from grounded.search.first_guess import trim

    clocks = free & [is_clock(name) for name in task.model.state_names]
    free = free & ~clocks
    away = np.abs(moved_at_start(task, task.past))[~clocks].max()
    if not away > 1e-9 or _out_of_reach(task, free, clocks):
        return None
    still = np.tile(task.start, (2, 1))
    still[1, clocks] += task.dt
    middle, inside = task.past.copy(), np.isfinite(task.high - task.low)
    middle[inside] = 0.5 * (task.low[inside] + task.high[inside])
    for first in [*(task.past + move for move in BEGUN), middle]:
        begun = np.clip(first, task.low, task.high)
        one = replace(loose or task, target=still, input_target=None, past=begun)
        x, u = (found[0] for found in trim(one, still, ~free))
        moved = np.abs(moved_at_start(replace(task, start=x), u))[~clocks]
        if (moved <= STILL * away).all():
            return np.append(x, u)
    return None


def _out_of_reach(task: Task, free: NDArray[np.bool_], clocks: NDArray[np.bool_]) -> bool:
    """Whether nothing inside the limits stops the start, as of what flies: asked in one step."""
    if not np.isfinite(task.high - task.low).all():
        return False
    problem = task.problem(exact=True)
    u = np.array([task.past, task.low, 0.5 * (task.low + task.high), task.high])
    with np.errstate(all="ignore"):
        f_x, f_u = problem.system.linearise(np.tile(task.start, (4, 1)), u, problem.p, problem.dt)
    others = np.abs(f_x - np.eye(len(free))).max(axis=0)[:, free]
    reach = 2 * np.abs(f_u).max(axis=0) @ (task.high - task.low) + FARTHEST * others.sum(axis=1)
    return bool((np.abs(moved_at_start(task, task.past)) > reach)[~clocks].any())


def moved_at_start(task: Task, inputs: Array) -> Array:
    """By how much the start moves in the first step under an input, (n,)."""
    problem = task.problem(exact=True)
    with np.errstate(all="ignore"):
        after = problem.system.step(task.start[None], inputs[None], problem.p, problem.dt)[0]
    return task.model.difference(after, task.start)
