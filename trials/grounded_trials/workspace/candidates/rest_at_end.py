"""Let a plan end at rest: the states that a line leaves free.

A column alone would get a weight at every step, and hold there what the run needs to move: a ball
rolls only on a beam that tilts. So it is weighed in [reward] terminal. The weight of a noisy state
is bounded by its noise: a load's angular rate cost a quarter of the utility by the noise of one
sample, and gains that were to bring it to zero in the last steps answered that noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from grounded.errors import NextCommand
from grounded.frozen import Array
from grounded.places import integrals, rate_states
from grounded.search.candidate import Candidate
from grounded.search.safety import coasts_out
from grounded.search.scatter import sensor_noise
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.workspace.candidates.at_rest import rest_value
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.off_target import tracked, usual_weights
from grounded_trials.workspace.user_files.config import OFFERED
from grounded_trials.workspace.user_files.task_file import LEAST


def ended_at_rest(task: Task, run: Trial, held: Array) -> Trial:
    """Return a run that ends where a predicted one does, but at rest and under the held input.

    Args:
        task: says which states are rates of positions.
        run: the predicted run, with the planning model's states.
        held: the input that is sent after it (m,).
    """
    still = run.states.copy()
    still[-1, [one.j for one in integrals(task.model) if one.exact]] = 0.0
    return replace(run, states=still, inputs=np.tile(held, (run.steps, 1)), start_inputs=held)


HOLD = 1.0  # [s] at rest that are proposed at least
NOISY = 0.02  # most utility that the noise of a state may cost at the end, by its weight


@dataclass(frozen=True, eq=False)
class Rest:
    """What makes the free states of a line rest at its end.

    Args:
        columns: of these states and their rates, (H + 1,) each; they count at the end only.
        weights: for [reward] terminal, also of the states that the line has: a ball that arrives
            too fast leaves a level beam as well.
        noise: standard deviation of the states whose weight is bounded by it.
    """

    columns: dict[str, Array]
    weights: dict[str, float]
    noise: dict[str, float]


def rest_at_end(
    workspace: Folder, columns: Mapping[str, Array], start: Mapping[str, float]
) -> Rest | None:
    """Return columns and weights for the free states of a line; None if it leaves none free.

    These are the states that have a rate, with it; if none has one, the first. A state rests where
    its sensor shows it at rest with all adopted effects.

    Args:
        workspace: the workspace with the model.
        columns: the line.
        start: [task] start.
    """
    model = workspace.base_model
    rates, free = rate_states(model), [name for name in model.states if name not in columns]
    if not free:
        return None
    last = {name: float(column[-1]) for name, column in columns.items()}
    last |= {name: 0.0 for name in rates.values() if name in last}
    rows, found, ranges = len(next(iter(columns.values()))), dict[str, Array](), {}
    for name in [name for name in free if name in rates] or free[:1]:
        begins, at = start.get(name, 0.0), rest_value(workspace, last, name)
        last[name] = at
        found[name] = np.linspace(begins, at, rows)
        ranges[name] = np.linspace(min(begins, at - LEAST), at, rows)
        if (rate := rates.get(name)) is not None and rate not in columns:
            found[rate], ranges[rate] = np.zeros(rows), ranges[name]  # only for its usual weight
    usual = usual_weights(model, {**columns, **ranges})
    weights, noisy = {name: OFFERED * weight for name, weight in usual.items()}, {}
    each = sensor_noise(workspace.task_trials(), model.n)
    for name, noise in zip(model.state_names, each.tolist(), strict=True):
        if name in found and weights[name] * noise**2 > NOISY:
            weights[name], noisy[name] = NOISY / noise**2, noise
    return Rest(found, {name: float(f"{w:.6g}") for name, w in weights.items()}, noisy)


def to_end_at_rest(workspace: Folder, made: Candidate) -> NextCommand | None:
    """Return the `target` command for a line whose plan leaves [safety] after its end, else None.

    It draws the same line so that free states rest at its end, and holds it there for a while.
    """
    planner, task = workspace.planner, workspace.task
    held = np.clip(made.policy.past, made.policy.low, made.policy.high)
    run = planner.lift(made.predicted_run)
    if not coasts_out(task, planner.plan, run, held):
        return None
    if (line := drawn(task)) is None or line.arguments[0] != "line":
        return None
    given = {*tracked(task)}
    free = [name for i, name in enumerate(task.model.state_names) if i not in given]
    words, rests = [*line.arguments], _rests(task)
    seconds = (task.horizon - rests) * task.dt
    words += ["--seconds", f"{seconds:.6g}"]
    if not free and rests * task.dt >= HOLD:
        return None
    if not free and coasts_out(task, planner.plan, ended_at_rest(task, run, held), held):
        return None  # an arm falls from rest as well: the input that is sent afterwards lets it go
    words += ["--hold", f"{max(rests * task.dt, HOLD):.6g}", *["--rest"] * bool(free)]
    return NextCommand("target", tuple(words))


def _rests(task: Task) -> int:
    """Return the number of steps at the end in which the target does not move."""
    given = task.target[:, tracked(task)]
    still = np.all(np.isclose(given, given[-1], atol=1e-9), axis=1)
    return int(np.argmin(still[::-1])) - 1 if not still.all() else task.horizon


def drawn(task: Task) -> NextCommand | None:
    """Return the `target` command for the line or step that a target appears to be; else None."""
    names, rates = task.model.state_names, {*rate_states(task.model).values()}
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
