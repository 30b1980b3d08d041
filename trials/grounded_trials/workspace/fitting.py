"""Fit in a workspace: choose the trials and write the result to grounded.toml.

Trials and model are those that `diagnose` takes, adopted effects included.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.diagnosis.error_report import errors
from grounded.effects import param_name
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, settle
from grounded.findings import found as finding
from grounded.fit import fit
from grounded.result import Result
from grounded_trials.workspace.adopted import settled
from grounded_trials.workspace.adoption import keep, to_adopt
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import unsure_times
from grounded_trials.workspace.last_diagnosis import chosen, readable_diagnosis, since_diagnosis
from grounded_trials.workspace.new_target import to_plan
from grounded_trials.workspace.next_step import after_fit
from grounded_trials.workspace.readings import one_message
from grounded_trials.workspace.user_files.config import listed, set_keys
from grounded_trials.workspace.where_to_mend import where_to_mend

if TYPE_CHECKING:
    from grounded.accounts.finding import Finding as Fault
    from grounded.engine import Engine
    from grounded.fit import Fit


@dataclass(frozen=True, eq=False, repr=False)
class Fitted(Result):
    """What `fit` found, and whether grounded.toml has it."""

    fit: Fit
    applied: bool
    preflight: tuple[Fault, ...]  # findings about the instruments
    then: NextCommand  # the command to type next
    not_fitted: tuple[str, ...] = ()  # adopted delays that the intervals take as exact
    trials: tuple[str, ...] = ()  # the trials that were fitted
    rows_s: float = 0.0  # rows of a table, between which a command was sent; in delays' intervals
    interpolated_s: float = 0.0  # standard deviation of times by interpolated states; in them, too

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What to know of the fit, the heaviest first."""
        told = list(self.fit.findings)
        if self.not_fitted:
            told.append(finding("model.times", *self.not_fitted))
        if self.rows_s or self.interpolated_s:
            told.append(finding("model.times", rows=self.rows_s, early=self.interpolated_s))
        return settle(told)

    def summary(self) -> str:
        """Return the fitted values."""
        return ", ".join(f"{name} = {e.value:.4g}" for name, e in self.fit.params.items())

    def to_json(self) -> dict[str, Any]:
        """Return the document of `fit --json`: values, intervals, held-out prediction errors."""
        return self.fit.to_json() | {
            "applied": self.applied,
            "trials": list(self.trials),
            "not_fitted": list(self.not_fitted),
            "rows_s": self.rows_s,
            "interpolated_s": self.interpolated_s,
            "preflight": [one.to_json() for one in self.preflight],
            "findings": [one.to_json() for one in self.findings],
        }


def fit_in(
    workspace: Folder,
    params: Sequence[str] | None = None,
    *,
    trials: Sequence[str] = (),
    latency: bool = False,
    apply: bool = False,
    engine: Engine | None = None,
    progress: Callable[[str], None] | None = None,
) -> Fitted:
    """Estimate the model's parameters from trials, after correcting sensor errors.

    Args:
        workspace: the workspace.
        params: names of the parameters to fit; None: all.
        trials: short names such as t0007; empty: all usable trials.
        latency: also fit one transport delay, common to all inputs.
        apply: write the values to grounded.toml.
        engine: workers for the trials' likelihoods; their number does not change the result.
        progress: called with the stage and the time taken.

    Raises:
        GroundedError: if `apply` is set but the fit predicts held-out time worse than before;
            nothing is written then.
    """
    planner, share, names = workspace.planner, chosen(workspace, trials), params
    used, ids = share.trials, tuple(trial.id for trial in share.trials)
    adopted, every = _adopted_delays(workspace), tuple(range(planner.plan.model.m))
    rows, early = unsure_times(workspace.whole_trials(), ids)
    found = fit(
        planner.plan,
        [planner.lift(trial) for trial in used],
        names,
        delays={"latency": every} if latency else {} if names else adopted,
        hidden=planner.plan.model.state_names[planner.task.model.n :],
        one_message=one_message(workspace),
        interpolated_s=early,
        engine=engine,
        progress=progress,
    )
    late = [n for n in found.params if n in adopted or n.startswith("latency")]
    found = _as_rows_tell(found, late, rows)
    if share.finding is not None:
        found = replace(found, findings=(*found.findings, share.finding))
    seen = where_to_mend(workspace, used, found.preflight)
    kept = () if names or latency else _taken_as_exact(workspace, found)
    asked: tuple[str, ...] = ("--params", ",".join(names)) if names else ()
    asked += ("--trials", ",".join(trials)) if trials else ()
    asked += ("--latency",) * latency
    fitted = partial(Fitted, found, preflight=seen, not_fitted=kept, trials=ids)
    fitted = partial(fitted, rows_s=rows * bool(late), interpolated_s=early)
    if apply and found.worse:
        raise GroundedError(_worse(found), then=after_fit(workspace))
    if not apply:
        # parameters alone stand for what the last diagnosis has found beside them
        last = readable_diagnosis(workspace.reports)
        stale = last is None or since_diagnosis(workspace, last).changed
        asks = None if last is None or stale else to_adopt(workspace, last)
        own = {f"parameter:{name}" for name in workspace.base_model.params}
        if asks and asks.verb == "adopt" and not own.issuperset(asks.arguments):
            return fitted(applied=False, then=asks)
        if not found.helps:
            return fitted(applied=False, then=after_fit(workspace))
        return fitted(applied=False, then=NextCommand("fit", (*asked, "--apply")))
    apply_fit(workspace, found)
    return fitted(applied=True, then=to_plan(workspace))


def _as_rows_tell(found: Fit, late: Sequence[str], row: float) -> Fit:
    """Return a fit with intervals of delays widened by the rows of a table, see `Gridded`.

    A row that repeats a command does not say if that was sent just then or up to a row [s] before.
    """
    params = dict(found.params)
    for name in late if row else ():
        e = params[name]
        std = math.hypot(e.std, row / 2)
        params[name] = replace(e, std=std, low=e.low - row, high=e.high + row)
    return replace(found, params=params)


def _adopted_delays(workspace: Folder) -> dict[str, tuple[int, ...]]:
    """Return the inputs of each adopted delay that is all the latency that they have, by its name.

    Another delay of the same input can't be told from it, and a delay before a nonlinear effect is
    only partly latency (`planner_with`).
    """
    plan, found = workspace.planner.plan, dict[str, tuple[int, ...]]()
    assert plan.latency is not None
    for effect, values in workspace.config.model.effects.items():
        family, _, target = effect.partition(":")
        if family != "delay":
            continue
        inputs = tuple(plan.model.input_names.index(name) for name in target.split("+"))
        if np.allclose(plan.latency[list(inputs)], values["d"], rtol=0.0, atol=1e-9):
            found[param_name(effect, "d")] = inputs
    return found


def _taken_as_exact(workspace: Folder, found: Fit) -> tuple[str, ...]:
    """Return the adopted delays that were not fitted."""
    delays = (name for name in workspace.config.model.effects if name.startswith("delay:"))
    return tuple(name for name in delays if param_name(name, "d") not in found.params)


def _worse(found: Fit) -> Finding:
    """Return how much worse a fit predicts, with the most affected state."""
    row = found.prediction_error[-1]
    name = max(row.changes, key=lambda name: row.changes[name])
    ends = errors(row, name, now="with_effects", before="crude")
    return finding("model.fit_worse", state=name, ahead=row.horizon_s, **ends)


def apply_fit(workspace: Folder, found: Fit) -> None:
    """Write the fitted values (and a fitted latency) that the data identify to grounded.toml.

    Parameters that are not identified keep their values. A fitted latency is the total one: it
    replaces adopted delays.
    """
    base, table = workspace.base_model, workspace.config.model
    values = {
        name: float(f"{e.value:.8g}")
        for name, e in found.params.items()
        if name != "latency" and e.identified
    }
    own, effects = settled(values, table.effects)
    if "latency" in found.params and found.params["latency"].identified:
        delays = zip(base.input_names, found.latency, strict=True)
        late = {name: round(float(d), 6) for name, d in delays}
        set_keys(workspace.config.file, "task", latency=late)
        effects = {n: values for n, values in effects.items() if not n.startswith("delay:")}
    set_keys(
        workspace.config.file,
        "model",
        params=dict(table.params) | own,
        effects=listed(effects) if table.effects else None,
    )
    known = {n: (value, std) for n, value in values.items() if (std := found.params[n].std) >= 0}
    keep(workspace, known)
