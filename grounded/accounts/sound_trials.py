"""All instrument checks in one call, as used by `diagnose`, `fit` and `--instruments`."""

from __future__ import annotations

from collections.abc import Sequence

from grounded.instruments.finding import Preflight
from grounded.instruments.predictions.clocks import judge_clocks
from grounded.instruments.predictions.exchanged_states import judge_exchanged
from grounded.instruments.predictions.input_signs import judge_signs
from grounded.instruments.predictions.mistaken import judge_commands
from grounded.instruments.preflight import preflight
from grounded.instruments.units.plane_units import judge_positions
from grounded.model import Model
from grounded.task import Task
from grounded.trial import Trial


def sound_trials(
    subject: Task | Model,
    trials: Sequence[Trial],
    hidden: Sequence[str] = (),
    first: int | None = None,
    one_message: Sequence[str] = (),
) -> Preflight:
    """Run all instrument checks, and correct the trials where that is certain.

    Args:
        subject: the model, whose kinematics relate the sensors; a task adds the input limits.
        trials: real ones, of one time grid; unchanged if they don't fit the model.
        hidden: states without a sensor.
        first: number of trials in the first of two groups, between which inputs may change their
            signs; None: one group.
        one_message: states that are logged in one message, so that all or none of them are late.

    Returns:
        The findings and the corrected trials.

    Raises:
        GroundedError: for logs that can't be used, with the correction: states that respond before
            their commands are sent, exchanged columns, other units, inputs with two signs.
    """
    model = subject.model if isinstance(subject, Task) else subject
    names = (model.state_names, model.input_names)
    if all((trial.state_names, trial.input_names) == names for trial in trials):
        known = [t.until(t.known_steps) for t in trials]
        judge_exchanged(model, known, hidden)
        judge_positions(model, known, hidden)  # preflight may leave out a velocity
    looked = preflight(subject, trials, hidden, one_message)
    fit = [(trial.state_names, trial.input_names) == names for trial in looked.trials]
    if fit and all(fit):
        judge_positions(model, looked.trials, hidden)
        judge_clocks(model, looked.trials, hidden)
        judge_commands(model, looked.trials, hidden, looked.findings)
        for group in (looked.trials[:first], looked.trials[first:] if first else ()):
            judge_signs(model, group, hidden)
    return looked
