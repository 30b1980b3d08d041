"""Trials that physics may be judged on: one answer for `diagnose`, `fit` and `--instruments`."""

from __future__ import annotations

from collections.abc import Sequence

from grounded.instruments.clocks import judge_clocks
from grounded.instruments.mistaken import judge_commands
from grounded.instruments.preflight import Preflight, preflight
from grounded.model import Model
from grounded.task import Task
from grounded.trial import Trial


def sound_trials(
    subject: Task | Model, trials: Sequence[Trial], hidden: Sequence[str] = ()
) -> Preflight:
    """The instruments' findings, and the trials without what could be corrected.

    Args:
        subject: the model, whose kinematics tie sensors together; of a task also the limits.
        trials: real ones, of one time grid; left as they are where they don't fit the model.
        hidden: states that no sensor has.

    Raises:
        GroundedError: for logs that can't be used as they are, with what mends them: states that
            answer commands before they are sent, exchanged columns, other units.
    """
    looked = preflight(subject, trials, hidden)
    model = subject.model if isinstance(subject, Task) else subject
    names = (model.state_names, model.input_names)
    fit = [(trial.state_names, trial.input_names) == names for trial in looked.trials]
    if fit and all(fit):
        judge_clocks(model, looked.trials, hidden)
        judge_commands(model, looked.trials, hidden, looked.findings)
    return looked
