"""Check by a run's commands whether its states are in the model's units.

A controller computes each command from the state. If the logged commands are what the policy sends
only after one group of states is multiplied by a unit's factor, the log has those states in another
unit, although all of its columns agree with each other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grounded.model import Model
from grounded.policy import Policy
from grounded.result import listed
from grounded.trial import Trial

LEAST = 10  # fewest steps that can be judged
OFF, FITS = 0.1, 0.01  # rms difference of commands, in units of their size: without, with a factor
ANGLES, LENGTHS = ("rad", "rad/s"), ("m", "m/s")
UNITS = (  # units of the model, factor from the log's unit, and the log's unit
    (ANGLES, np.pi / 180, "degrees"),
    (LENGTHS, 1e-3, "mm"),
    (LENGTHS, 1e-2, "cm"),
    (LENGTHS, 1e3, "km"),
    (("deg", "deg/s"), 180 / np.pi, "radians"),
)


def unit_fed_back(model: Model, trial: Trial, policy: Policy) -> str:
    """Return a sentence that names the states in another unit and the factor; "" if none are.

    Args:
        model: the model, for the units of the states.
        trial: a run of the policy; gaps are not judged.
        policy: the policy that was run.
    """
    T = min(trial.finite_steps, policy.horizon)
    if policy.gain is None or T < LEAST:
        return ""
    run = trial.until(T)
    with np.errstate(all="ignore"):
        plain = _off(policy, run)
        if not plain > OFF:
            return ""
        for units, factor, unit in UNITS:
            names = [name for name, own in model.states.items() if own in units]
            by = np.where([own in units for own in model.states.values()], factor, 1.0)
            if names and _off(policy, replace(run, states=run.states * by)) < FITS:
                verb = "is" if len(names) == 1 else "are"
                return (
                    f"{listed(names)} {verb} in {unit}, not in {' and '.join(_units(model, names))}"
                    f": times {factor:.4g}, the policy sends the commands of the run"
                )
    return ""


def _units(model: Model, names: list[str]) -> list[str]:
    return list(dict.fromkeys(model.states[name] for name in names))


def _off(policy: Policy, run: Trial) -> float:
    """Return the rms difference of commands and the policy's, in units of the largest command."""
    past = policy.past if run.start_inputs is None else run.start_inputs
    asked = policy.commands(run.states[None, : run.steps], past)[0]
    sent = np.clip(run.inputs, policy.low, policy.high)
    size = np.maximum(np.abs(sent).max(axis=0), 1e-12)
    return float(np.sqrt((((sent - asked) / size) ** 2).mean()))
