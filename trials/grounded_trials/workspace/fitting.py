"""fit in a workspace: which trials are used, and how the result goes into grounded.toml."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.result import Result
from grounded.trial import Trial
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
        """Write the values to grounded.toml, or go on with those that were written."""
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
    """Parameters of the workspace's model from its trials."""
    from grounded.estimate import of_states, record_of
    from grounded.fit import fit

    model = workspace.task.model
    guessed = {n for t in workspace.trials() for n in t.meta.get("estimated", "").split(",")}
    measured = [i for i, name in enumerate(model.state_names) if name not in guessed]
    records = [record_of(model, trial) for trial in usable_trials(workspace)]
    return fit(
        workspace.task,
        [replace(r, measured=r.measured[:, measured]) for r in records],
        names,
        fit_latency="common" if latency else "known",
        measurement=of_states(model, [model.state_names[i] for i in measured]),
        rng=np.random.default_rng(0),
        engine=engine,
        progress=progress,
    )


def apply_fit(workspace: Folder, found: Fit) -> None:
    """Writes the fitted values (and a fitted latency) that the data identify to grounded.toml.

    What they don't identify was held where it was while the others were fitted.
    """
    base = workspace.base_model
    values = {
        name: float(f"{e.value:.8g}")
        for name, e in found.params.items()
        if name in base.params and e.identified
    }
    set_in_model(workspace.config.file, params=dict(workspace.config.model.params) | values)
    if "latency" in found.params and found.params["latency"].identified:
        delays = zip(base.input_names, found.latency, strict=True)
        set_latency(workspace.config.file, {name: round(float(d), 6) for name, d in delays})
