"""The data of a diagnosis or a fit: trials whose sensor faults are corrected, cut into runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from grounded.accounts.finding import Preflight
from grounded.accounts.lag import whole_steps
from grounded.accounts.sound_trials import sound_trials
from grounded.diagnosis.likelihood.data import Data, prepare
from grounded.diagnosis.validation.limits import with_measured_filters
from grounded.model import Model
from grounded.task import Task
from grounded.trial import Trial

MOST_STATES = 50  # of a filter, whose step costs their cube; of a diagnosis with the inputs


def sound_data(
    subject: Task | Model,
    trials: Sequence[Trial],
    *,
    hidden: Sequence[str] = (),
    one_message: Sequence[str] = (),
    first: int | None = None,
    interpolated_s: float = 0.0,
) -> tuple[Data, Preflight]:
    """Return the data of a likelihood, and what the sensors show by themselves.

    Args:
        subject: the task (its latency counts as modelled) or a model.
        trials: real runs with one time step.
        hidden: names of states without a sensor, such as the memory of adopted effects.
        one_message: states that are logged in one message.
        first: number of trials in the first of two groups; None: one group.
        interpolated_s: standard deviation of times [s] because the states were interpolated.

    Raises:
        GroundedError: if the trials don't fit the model, or hold no data.
    """
    model = subject.model if isinstance(subject, Task) else subject
    latency = subject.latency if isinstance(subject, Task) else None
    past = subject.past if isinstance(subject, Task) else None
    looked = sound_trials(subject, trials, hidden, first, one_message)
    model = with_measured_filters(model, looked.findings)
    data = prepare(model, looked.trials, latency, past, hidden)
    filters = {model.state_names.index(name): tau for name, tau in looked.filters.items()}
    moved = [f for f in looked.findings if f.corrected and f.kind == "delay"]
    between = {f.signal for f in moved if not whole_steps(f.delay_s / data.dt)}
    return (
        replace(data, filters=filters, between=frozenset(between), interpolated_s=interpolated_s),
        looked,
    )
