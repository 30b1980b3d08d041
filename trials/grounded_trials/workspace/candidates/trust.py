"""What a candidate promises, and how far its prediction can be trusted.

Predictions of the model as it is now are compared with the runs that tested them. A prediction
begins at [task] start; what it cost that runs began elsewhere is no error of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from grounded.findings import Finding, Quantity, found
from grounded.search.candidate import Candidate, Tried
from grounded.search.step_size import Step
from grounded.task import Task
from grounded_trials.workspace.off_target import roles_of, tracked

if TYPE_CHECKING:
    from grounded.search.standing import Standing
    from grounded_trials.workspace.folder import Folder

LAST = 3  # recent predictions whose errors are told
NOISE_SHARE = 0.2  # share of a cost above which its part due to sensor noise is told
STATES = 3  # target states whose range is told


@dataclass(frozen=True)
class Extent:
    """Where a predicted run goes in one state or input."""

    name: str
    unit: str
    low: float
    high: float
    limits: tuple[float, float] | None = None


def extent_of(made: Candidate, task: Task) -> tuple[Extent, ...]:
    """Return where a predicted run goes: its main states, then its inputs."""
    model, rows = task.model, []
    main = _main_states(task)
    for (name, unit), values in zip(model.states.items(), made.predicted_states.T, strict=True):
        if name in main:
            rows.append(Extent(name, unit, values.min(), values.max()))
    for j, (name, unit) in enumerate(model.inputs.items()):
        values, low, high = made.predicted_inputs[:, j], float(task.low[j]), float(task.high[j])
        limits = (low, high) if high < math.inf else None
        rows.append(Extent(name, unit, values.min(), values.max(), limits))
    return tuple(rows)


def _main_states(task: Task) -> set[str]:
    """Return the states whose range is told: the position; else those in [safety] or a target."""
    assert task.safety_low is not None and task.safety_high is not None
    bounded = np.isfinite(task.safety_low) | np.isfinite(task.safety_high)
    found = roles_of(task.model).get("position") or [
        *np.flatnonzero(bounded),
        *tracked(task)[:STATES],
    ]
    return {task.model.state_names[i] for i in found}


def made_how(made: Candidate, task: Task, history: tuple[Tried, ...]) -> Finding:
    """Return how a candidate was made."""
    share = None
    if made.way == "gentler gains":
        base = next(t.candidate for t in history if t.candidate.id == made.base)
        share = made.policy.mean_gain / base.policy.mean_gain
    step = str(Step(made.damping, made.alpha)) if made.grounded else None
    return found(
        "plan.made",
        made.id,
        seconds=Quantity(task.horizon * task.dt, "s"),
        base=made.base or None,
        step=step,
        iteration=made.iteration,
        share=share,
        own=int(made.way == "own plan"),
        crashes=0 if made.base else round(made.caution),
        corrected=int((made.grounded and bool(made.slopes)) or made.way == "slopes by step"),
        gentle=int(bool(made.base) and made.caution > 0 and share is None),
    )


def much_noise(noise: float, utility: float) -> float | None:
    """Return how much of a logged run's cost is due to sensor noise, if it is much."""
    return min(noise, -utility) if noise > NOISE_SHARE * -utility else None


def promises(
    workspace: Folder, made: Candidate, now: Standing, cost: float, whole: float
) -> dict[str, Finding]:
    """Return what is told of a candidate, by the label of its line.

    `cost` is that of the sensor noise in its log that its prediction lacks, `whole` of all of it.
    """
    promised, best = made.predicted_utility, now.incumbent
    in_log = promised - cost
    log = in_log if cost > 0 and f"{in_log:.4g}" != f"{promised:.4g}" else None
    noise = much_noise(whole, in_log)
    told = {
        "what": made_how(made, workspace.task, now.history),
        "predicted": found("plan.predicted", made.id, utility=promised, log=log).also(noise=noise),
    }
    if best is not None:
        own = best.candidate.id
        noise = much_noise(best.noise_cost, best.utility)
        so_far = found("plan.so_far", own, best=own, utility=best.utility, noise=noise)
        told["so far"] = so_far
    return told | {"trust": _trust(workspace, made, now)}


def _trust(workspace: Folder, made: Candidate, now: Standing) -> Finding:
    """Return how far the last predictions were off, and the gain that this one promises."""
    ran = [tried for tried in now.history if tried.utilities]
    same = [tried for tried in ran if tried.candidate.model == workspace.planner.fingerprint]
    if not same:
        logs = len(workspace.trials()) - sum(len(tried.trials) for tried in now.history)
        exact = not now.trials and not workspace.config.reachable
        return found("plan.untested", made.id, changed=len(ran), exact=int(exact), logs=logs)
    last = sorted(same, key=lambda tried: max(trial.id for trial in tried.trials))[-LAST:]
    missed = [abs(one.promised - one.utility) for one in last]
    whole = tuple(f"{off:.2g}" for off in missed if math.isfinite(off))
    said = found("plan.tested", made.id, missed=whole, failed=len(missed) - len(whole))
    tried = {one.candidate.id for one in now.history}
    asked = made.id not in tried and made.way != "gentler gains"  # no model swings
    gain = made.promised_over(now.incumbent) if now.incumbent and asked else 0.0
    less = int(gain < missed[-1])
    return said.also(gain=gain, less=less) if gain > 0 and math.isfinite(missed[-1]) else said
