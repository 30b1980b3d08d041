"""A foreign log as a trial's arrays: what the [log] table asks for, read and resampled at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from grounded.errors import GroundedError
from grounded_trials.resample import Gridded, Span, to_grid
from grounded_trials.signals import SignalSpec, read_signals


@dataclass(frozen=True)
class LogMapping:
    """The [log] table: where each state and input is found, and which part is the trial."""

    states: Mapping[str, SignalSpec]
    inputs: Mapping[str, SignalSpec]
    span: Span = field(default_factory=Span)


def read_log(
    paths: str | Path | Sequence[str | Path],
    mapping: LogMapping,
    dt: float,
    *,
    states: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    angles: Sequence[str] = (),
    steps: int | None = None,
) -> Gridded:
    """Reads a log and samples it every dt.

    Args:
        paths: an MCAP file, several that follow each other, or the folder of a bag.
        mapping: where to find what.
        dt: control interval [s].
        states: which of the mapped states, in array order; all of them by default.
        inputs: the same for the inputs.
        angles: states that are unwrapped.
        steps: at most this many steps.

    Raises:
        GroundedError: see `signals.read_signals` and `resample.to_grid`.
    """
    states = list(mapping.states) if states is None else states
    inputs = list(mapping.inputs) if inputs is None else inputs
    if not states or not inputs:
        raise GroundedError("[log] maps no state or no input; a trial needs one of each")
    specs = {name: mapping.states[name] for name in states}
    specs |= {name: mapping.inputs[name] for name in inputs}
    series = read_signals(paths, {**specs, **mapping.span.signals()})
    return to_grid(series, dt, states, inputs, mapping.span, angles=angles, steps=steps)
