"""Fit in a workspace: choose the trials and write the result to grounded.toml.

As for a diagnosis, findings about the instruments are corrected first (`sound_trials`).
reports/fit.json records the trials and the model of the last fit of all parameters, and whether it
predicts better, so that a fit without effect is not suggested again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.result import Result, measured_alike
from grounded.share import share_of
from grounded.trial import Trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import estimated_in, unsure_times
from grounded_trials.workspace.last_diagnosis import fittable, ids_of, write_fit
from grounded_trials.workspace.next_step import after_fit, to_plan
from grounded_trials.workspace.user_files.config import set_in_model, set_latency

if TYPE_CHECKING:
    from grounded.accounts.finding import Finding
    from grounded.engine import Engine
    from grounded.fit import Fit


@dataclass(frozen=True, eq=False, repr=False)
class Fitted(Result):
    """What `fit` found, and whether grounded.toml has it."""

    fit: Fit
    applied: bool
    preflight: tuple[Finding, ...]  # findings about the instruments
    then: NextCommand  # the command to type next
    not_fitted: tuple[str, ...] = ()  # adopted delays that the intervals take as exact
    trials: tuple[str, ...] = ()  # the trials that were fitted
    rows_s: float = 0.0  # rows of a table, between which a command was sent; in delays' intervals
    mean_s: float = 0.0  # the most that the mean of two commands may move a delay; in them, too
    interpolated_s: float = 0.0  # standard deviation of times by interpolated states; in them, too

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
            "mean_s": self.mean_s,
            "interpolated_s": self.interpolated_s,
            "preflight": [one.to_json() for one in self.preflight],
        }


def fit_in(
    workspace: Folder,
    names: Sequence[str] | None,
    *,
    trials: Sequence[str] = (),
    latency: bool = False,
    apply: bool = False,
    engine: Engine | None = None,
    progress: Callable[[str], None] | None = None,
) -> Fitted:
    """Fit the workspace's model to its trials, see `Workspace.fit`.

    Raises:
        GroundedError: if `apply` is set but the fit predicts held-out time worse than before;
            nothing is written then.
    """
    share = share_of(fittable(workspace, trials))
    used = share.trials
    found, seen = fit_trials(
        workspace, used, names, latency=latency, engine=engine, progress=progress
    )
    rows, early = unsure_times(workspace.whole_trials(), ids_of(used))
    found, row, mean = _as_times_tell(workspace, found.of_share(share.sentence), rows, early)
    kept = () if names or latency else _taken_as_exact(workspace, found)
    if not (names or latency):
        write_fit(workspace, used, found)
    asked: tuple[str, ...] = ("--params", ",".join(names)) if names else ()
    asked += ("--trials", ",".join(trials)) if trials else ()
    asked += ("--latency",) * latency
    fitted = partial(Fitted, found, preflight=seen, not_fitted=kept, trials=ids_of(used))
    fitted = partial(fitted, rows_s=row, mean_s=mean, interpolated_s=early)
    if apply and not np.isfinite(found.loglik):
        raise GroundedError(f"nothing was written: {found.sentence}", then=after_fit(workspace))
    if apply and found.worse:
        why = f"nothing was written: {_worse(found)}"
        raise GroundedError(why, then=after_fit(workspace))
    if not apply:
        if not found.helps:
            return fitted(applied=False, then=after_fit(workspace))
        return fitted(applied=False, then=NextCommand("fit", (*asked, "--apply")))
    apply_fit(workspace, found)
    return fitted(applied=True, then=to_plan(workspace))


def _as_times_tell(
    workspace: Folder, found: Fit, row: float, early: float
) -> tuple[Fit, float, float]:
    """Return a fit with intervals of times widened by what it does not know of when things happen.

    A row of a table that repeats a command does not say if that was sent just then or up to a row
    [s] before. And where an input arrives a part f of a step late, the fit takes the mean of two
    commands, which moves the delay by less than f (1 - f) dt: 2.5 ms of 80 ms for a robot with a
    lag of 0.1 s, at 50 ms. (`diagnose` makes such steps in parts.) Delays and time constants take
    responses as they were interpolated, which may begin early [s].

    Returns:
        The fit, and what was added to each side of some delay [s] for either reason, at most.
    """
    from grounded.diagnosis.likelihood.intervals import NORMAL, moved_by

    adopted = _adopted_delays(workspace)
    late = [n for n in found.params if n in adopted or n.startswith("latency")]
    dt, params, means = workspace.config.task.dt, dict(found.params), [0.0]
    for name in late:
        e = params[name]
        part = e.value / dt % 1.0
        means.append(part * (1 - part) * dt)
        more = row + means[-1]
        std = math.hypot(e.std, row / 2, means[-1] / 2)
        params[name] = replace(e, std=std, low=e.low - more, high=e.high + more)
    for name, e in params.items() if early else ():
        off = moved_by(early, e.value, e.unit)
        low, high = e.low - NORMAL * off, e.high + NORMAL * off
        params[name] = replace(e, std=math.hypot(e.std, off), low=low, high=high)
    return replace(found, params=params), row * bool(late), max(means)


def _adopted_delays(workspace: Folder) -> dict[str, tuple[int, ...]]:
    """Return the inputs of each adopted delay that is all the latency that they have, by its name.

    Another delay of the same input can't be told from it, and a delay before a nonlinear effect is
    only partly latency (`planner_with`).
    """
    from grounded.effects import param_name

    plan, found = workspace.planner.plan, dict[str, tuple[int, ...]]()
    assert plan.latency is not None
    for effect in workspace.config.model.effects:
        family, _, target = str(effect["name"]).partition(":")
        if family != "delay":
            continue
        inputs = tuple(plan.model.input_names.index(name) for name in target.split("+"))
        if np.allclose(plan.latency[list(inputs)], effect["d"], rtol=0.0, atol=1e-9):
            found[param_name(str(effect["name"]), "d")] = inputs
    return found


def _taken_as_exact(workspace: Folder, found: Fit) -> tuple[str, ...]:
    """Return the adopted delays that were not fitted."""
    from grounded.effects import param_name

    names = (str(e["name"]) for e in workspace.config.model.effects)
    delays = (name for name in names if name.startswith("delay:"))
    return tuple(name for name in delays if param_name(name, "d") not in found.params)


def _worse(found: Fit) -> str:
    """Return a sentence on how much worse a fit predicts, with the most affected state."""
    before, after = found.before, found.after
    assert before is not None and after is not None
    far = before.windows > 0
    was, now = (before.ahead, after.ahead) if far else (before.one_step, after.one_step)
    text = "the fitted values predict held-out time worse than the model's current values"
    known = np.isfinite(was) & np.isfinite(now) & (was > 0)
    if not known.any():
        return text
    i = int(np.argmax(np.where(known, now / np.where(known, was, 1.0), -np.inf)))
    name, when = before.names[i], f"{before.horizon_s:.3g} s ahead" if far else "one step ahead"
    unit = found.model.states.get(name, "")
    off, then = measured_alike([now[i], was[i]], unit)
    return (
        f"{text} ({name} {when}: off by {off} instead of {then}); they compensate for something "
        "else that the model lacks"
    )


def fit_trials(
    workspace: Folder,
    used: Sequence[Trial],
    names: Sequence[str] | None,
    *,
    latency: bool = False,
    engine: Engine | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[Fit, tuple[Finding, ...]]:
    """Fit the parameters of the workspace's model, including adopted effects, to trials of it.

    Findings about the instruments are corrected first, as in `diagnose`. The memory of an effect (a
    lag's output) is not measured: the filter estimates it, with an initial value from the commands.

    Returns:
        The fit, and the findings about the instruments.
    """
    from grounded.accounts.sound_trials import sound_trials
    from grounded.estimate import of_states, record_of
    from grounded.fit import fit
    from grounded_trials.workspace.where_to_mend import one_message, where_to_mend

    planner = workspace.planner
    guessed = estimated_in(workspace.trials())
    model, n = planner.plan.model, planner.task.model.n
    shown = [i for i, name in enumerate(model.state_names[:n]) if name not in guessed]
    hidden = [name for i, name in enumerate(model.state_names) if i not in shown]
    lifted = [planner.lift(trial) for trial in used]
    looked = sound_trials(planner.plan, lifted, hidden, one_message=one_message(workspace))
    records, unknown = [], np.array([name in guessed for name in model.state_names])
    for trial, logged in zip(looked.trials, lifted, strict=True):
        # a sensor that was left out still says where the filter may begin
        states = np.where(np.isfinite(trial.states), trial.states, logged.states[: trial.steps + 1])
        width = np.where(unknown, 1.0, np.ptp(states, axis=0))
        known = np.where(np.arange(model.n) < n, np.maximum(width, 1.0), 0.1 * width + 1e-6)
        start = np.where(unknown, 0.0, states)  # an estimate is by the model that is fitted
        record = record_of(model, trial)
        records.append(
            replace(record, measured=record.measured[:, shown], start=start, start_std=known)
        )
    found = fit(
        planner.plan,
        records,
        names,
        fit_latency="common" if latency else "known" if names else _adopted_delays(workspace),
        measurement=of_states(model, [model.state_names[i] for i in shown]),
        filters=looked.filters,
        rng=np.random.default_rng(0),
        engine=engine,
        progress=progress,
    )
    return found, where_to_mend(workspace, used, looked.findings)


def apply_fit(workspace: Folder, found: Fit) -> None:
    """Write the fitted values (and a fitted latency) that the data identify to grounded.toml.

    Parameters that are not identified keep their values. A fitted latency is the total one: it
    replaces adopted delays.
    """
    from grounded_trials.workspace.adopted import settled

    base, table = workspace.base_model, workspace.config.model
    values = {
        name: float(f"{e.value:.8g}")
        for name, e in found.params.items()
        if name != "latency" and e.identified
    }
    own, effects = settled(values, table.effects)
    if "latency" in found.params and found.params["latency"].identified:
        delays = zip(base.input_names, found.latency, strict=True)
        set_latency(workspace.config.file, {name: round(float(d), 6) for name, d in delays})
        effects = [e for e in effects if not str(e["name"]).startswith("delay:")]
    set_in_model(
        workspace.config.file,
        params=dict(table.params) | own,
        effects=effects if table.effects else None,
    )
