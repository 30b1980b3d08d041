"""fit in a workspace: which trials are used, and how the result goes into grounded.toml."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.result import Result
from grounded.trial import Trial
from grounded_trials.workspace.adopting import settled
from grounded_trials.workspace.config import set_in_model, set_latency
from grounded_trials.workspace.folder import Folder

if TYPE_CHECKING:
    from grounded.engine import Engine
    from grounded.fit import Fit


@dataclass(frozen=True, eq=False, repr=False)
class Fitted(Result):
    """What `fit` found, and whether grounded.toml has it."""

    fit: Fit
    applied: bool
    asked: tuple[str, ...] = ()  # the options of the command that fits the same again

    @property
    def then(self) -> NextCommand:
        """Write the values where they predict better; go on with those that were written."""
        if not (self.applied or self.fit.helps):
            return NextCommand("diagnose")
        return NextCommand("propose" if self.applied else "fit", self.asked)

    def summary(self) -> str:
        """The values."""
        return ", ".join(f"{name} = {e.value:.4g}" for name, e in self.fit.params.items())

    def to_json(self) -> dict[str, Any]:
        """The document of `fit --json`: values, intervals, held-out prediction errors."""
        return self.fit.to_json() | {"applied": self.applied}


def usable_trials(workspace: Folder) -> list[Trial]:
    """Every stored trial of this model up to its first sample that is not a finite number.

    Raises:
        GroundedError: if there is none of at least 3 steps.
    """
    trials = ((trial, trial.finite_steps) for trial in workspace.task_trials())
    found = [trial.until(T) for trial, T in trials if T >= 3]
    if not found:
        raise GroundedError(
            "there is no trial to learn from: ingest some, runs of candidates or logs with --data"
        )
    return found


def fit_trials(
    workspace: Folder,
    names: Sequence[str] | None,
    *,
    latency: bool = False,
    engine: Engine | None = None,
    progress: Callable[[str], None] | None = None,
) -> Fit:
    """Parameters of the workspace's model, adopted effects in it, from its trials.

    The memory of an effect (a lag's output) is measured by nothing: the filter follows it from
    what the commands say of its start.
    """
    from grounded.estimate import of_states, record_of
    from grounded.fit import fit

    planner = workspace.planner
    guessed = {n for t in workspace.trials() for n in t.meta.get("estimated", "").split(",")}
    model, n = planner.plan.model, planner.task.model.n
    measured = [i for i, name in enumerate(model.state_names[:n]) if name not in guessed]
    records = []
    for trial in usable_trials(workspace):
        lifted = planner.lift(trial)
        known = np.r_[np.ones(n), 0.1 * np.ptp(lifted.states[:, n:], axis=0) + 1e-6]
        record = record_of(model, lifted)
        records.append(
            replace(
                record,
                measured=record.measured[:, measured],
                start=np.where(np.arange(model.n) < n, 0.0, lifted.states),
                start_std=known,
            )
        )
    return fit(
        planner.plan,
        records,
        names,
        fit_latency="common" if latency else "known",
        measurement=of_states(model, [model.state_names[i] for i in measured]),
        rng=np.random.default_rng(0),
        engine=engine,
        progress=progress,
    )


def apply_fit(workspace: Folder, found: Fit) -> None:
    """Writes the fitted values (and a fitted latency) that the data identify to grounded.toml.

    What they don't identify was held where it was while the others were fitted. A fitted latency
    is the whole one: it takes the place of adopted delays.
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
        set_latency(workspace.config.file, {name: round(float(d), 6) for name, d in delays})
        effects = [e for e in effects if not str(e["name"]).startswith("delay:")]
    set_in_model(
        workspace.config.file,
        params=dict(table.params) | own,
        effects=effects if table.effects else None,
    )
