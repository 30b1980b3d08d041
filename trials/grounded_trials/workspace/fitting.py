"""fit in a workspace: which trials are used, and how the result goes into grounded.toml."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.errors import GroundedError
from grounded.trial import Trial
from grounded_trials.workspace.config import set_in_model, set_latency
from grounded_trials.workspace.folder import Workspace

if TYPE_CHECKING:
    from grounded.fit import Fit


def usable_trials(workspace: Workspace) -> list[Trial]:
    """Every stored trial of this model up to its first sample that is not a finite number.

    Raises:
        GroundedError: if there is none of at least 3 steps.
    """
    found = []
    for trial in workspace.task_trials():
        T = trial.finite_steps
        if T >= 3:
            found.append(replace(trial, states=trial.states[: T + 1], inputs=trial.inputs[:T]))
    if not found:
        raise GroundedError(
            "there is no trial to learn from: ingest some, runs of candidates or logs with --data"
        )
    return found


def fit_trials(workspace: Workspace, names: Sequence[str] | None, *, latency: bool = False) -> Fit:
    """Parameters of the workspace's model from its trials."""
    from grounded.estimate import of_states, record_of
    from grounded.fit import fit

    model, guessed = workspace.task.model, workspace.estimated_states()
    measured = [i for i, name in enumerate(model.state_names) if name not in guessed]
    records = [record_of(model, trial) for trial in usable_trials(workspace)]
    return fit(
        workspace.task,
        [replace(r, measured=r.measured[:, measured]) for r in records],
        names,
        fit_latency="common" if latency else "known",
        measurement=of_states(model, [model.state_names[i] for i in measured]),
        rng=np.random.default_rng(0),
    )


def apply_fit(workspace: Workspace, found: Fit) -> None:
    """Writes all fitted values (and a fitted latency) to grounded.toml.

    Those that the data do not identify by themselves go too: the others were fitted beside them,
    and only together do they predict what was measured.
    """
    base = workspace.base_model
    values = {
        name: float(f"{e.value:.8g}") for name, e in found.params.items() if name in base.params
    }
    set_in_model(workspace.config.file, params=dict(workspace.config.model.params) | values)
    if "latency" in found.params and found.params["latency"].identified:
        delays = zip(base.input_names, found.latency, strict=True)
        set_latency(workspace.config.file, {name: round(float(d), 6) for name, d in delays})
