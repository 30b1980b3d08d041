"""Trial: one real run, sampled on the control grid. A simulated run is a `Rollout`.

Samples may be missing, for instance when a camera loses the car for half a second. Short gaps in
the states are interpolated (`interpolate_gaps`); 2 % of lost samples do no harm. A long gap ends
the trial. Inputs are never interpolated: a trial ends before its first unknown input. A recording
that stops one or two steps early is extrapolated to the end of the run (`Trial.whole`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from grounded.checks import numbers, of_shape, positive, wrong
from grounded.frozen import Array, calm, readonly, resampled_noise, wrapped

MAX_GAP_S = 1.0  # a longer gap ends a trial
LAST = 2  # steps at the end of a run that may be missing and are extrapolated,
STEPS_FACTOR = 10  # if the trial has at least this many times as many steps
RECENT = 4  # steps whose mean rate is used to extrapolate
HUGE = 1e100  # treated as infinite: squares and products must stay finite


@dataclass(frozen=True, eq=False)
class Trial:
    """A recorded run: states s_0 .. s_T and COMMANDED inputs a_0 .. a_{T-1}, sampled every dt.

    T is the horizon, or less when the run ended early. NaN marks a missing sample.

    Args:
        states: (T + 1, n) measured states in the model's units, angles unwrapped.
        inputs: (T, m) commanded inputs in the model's units.
        dt: control interval [s].
        state_names: n names, in column order.
        input_names: m names, in column order.
        id: content hash of the stored file; "" before it is stored.
        candidate: id of the candidate that was run; "" for a log that ran none.
        start_inputs: (m,) input held before t = 0; None if unknown, then the task's `past` is used,
            or zero without a task.
        start_states: states at t = 0 as the samples before it show them, by name, where they show
            them better than the first row alone does: of a robot that stood still before its run.
        group: the condition that the trial was run in, if the user names it ("wet"): a diagnosis
            fits values without a group and predicts it.

    Raises:
        GroundedError: if the shapes do not match.
    """

    states: Array
    inputs: Array
    dt: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    id: str = ""
    candidate: str = ""
    start_inputs: Array | None = None
    start_states: Mapping[str, float] = field(default_factory=dict)
    group: str = ""

    def __post_init__(self) -> None:
        states = numbers(self.states, "trial: states")
        inputs = numbers(self.inputs, "trial: inputs")
        for kind in ("state_names", "input_names"):
            names = getattr(self, kind)
            several = isinstance(names, Iterable) and not isinstance(names, str)
            if not several or not all(isinstance(name, str) for name in names):
                raise wrong(f"trial: {kind}", names, must="names")
            object.__setattr__(self, kind, tuple(names))
        positive("trial: dt", self.dt)
        n, m, rows = len(self.state_names), len(self.input_names), len(states) if states.ndim else 0
        if states.ndim != 2 or states.shape[1] != n or not rows:
            do = "turned" if states.ndim == 2 and rows == n else "rows"
            raise wrong("trial: states", states.shape, shape=f"(T + 1, {n})", do=do)
        if inputs.shape != (rows - 1, m):
            mend = {
                (rows, m): ": the last state has no input, leave out the last row",
                (rows - 1,): ": make it a column, inputs[:, None]" * (m == 1),
                (m, rows - 1): ": transpose it",
            }
            mend = {(rows, m): "last", (m, rows - 1): "turned"}
            mend |= {(rows - 1,): "column"} if m == 1 else {}
            of_shape("trial: inputs", inputs, (rows - 1, m), do=mend.get(inputs.shape))
        object.__setattr__(self, "states", states)
        object.__setattr__(self, "inputs", inputs)
        if self.start_inputs is not None:
            held = numbers(self.start_inputs, "trial: start_inputs")
            of_shape("trial: start_inputs", held, (m,))
            object.__setattr__(self, "start_inputs", held)

    def __repr__(self) -> str:
        names = f"states {', '.join(self.state_names)}; inputs {', '.join(self.input_names)}"
        return f"Trial({self.id or 'new'}: {self.steps} steps of {self.dt:.4g} s; {names})"

    @property
    def steps(self) -> int:
        """T, the number of control steps that were run."""
        return len(self.inputs)

    @property
    def began(self) -> Array:
        """Where the run began, (n,): `start_states`, and the first row for the others."""
        known = self.start_states
        pairs = zip(self.state_names, self.states[0], strict=True)
        return np.array([known.get(name, float(first)) for name, first in pairs])

    @property
    def finite_steps(self) -> int:
        """Number of steps before the first non-finite value; -1 if the first state has one."""
        states = ~(np.abs(self.states) < HUGE).all(axis=1)
        inputs = ~(np.abs(self.inputs) < HUGE).all(axis=1)
        known = int(np.argmax(states)) - 1 if states.any() else self.steps
        return min(known, int(np.argmax(inputs))) if inputs.any() else known

    @property
    def known_steps(self) -> int:
        """Number of steps up to the last state with any known value, before divergence.

        All inputs up to there are known. For uses that tolerate gaps in the states (a diagnosis):
        they lose the samples in a gap, but not those after it.
        """
        known = np.flatnonzero(np.isfinite(self.states).any(axis=1))
        wild = (np.abs(self.states) >= HUGE).any(axis=1)
        bad = ~(np.abs(self.inputs) < HUGE).all(axis=1)
        last = int(known[-1]) if len(known) else 0
        last = min(last, int(np.argmax(wild)) - 1) if wild.any() else last
        return max(0, min(last, int(np.argmax(bad))) if bad.any() else last)

    def noise(self, rows: int | None = None) -> Array:
        """Return the noise (std) of the sensors, (n,), see `resampled_noise`; found once.

        Args:
            rows: use the first ones only; None for all.
        """
        known: dict[int, Array] = vars(self).setdefault("_noise", {})
        length = len(self.states) if rows is None else min(rows, len(self.states))
        if length not in known:
            settled = calm(self.inputs[: length - 1])
            known[length] = readonly(resampled_noise(self.states[:length], settled))
        return known[length]

    def repeats(self, other: Trial) -> bool:
        """Return whether the other trial has exactly the same states, bit for bit."""
        return np.array_equal(self.states, other.states, equal_nan=True)

    def whole(self, steps: int) -> Trial:
        """Cut the trial to `steps` steps, or extrapolate it if only one or two are missing.

        For missing steps the last input is held and the states continue at their recent mean rate.
        """
        missing = steps - self.steps
        if not (0 < missing <= LAST and self.steps >= STEPS_FACTOR * missing):
            return self.until(steps)
        if self.finite_steps < self.steps:
            return self
        rate = (self.states[-1] - self.states[-1 - RECENT]) / RECENT
        ahead = self.states[-1] + np.arange(1, missing + 1)[:, None] * rate
        held = np.repeat(self.inputs[-1:], missing, axis=0)
        return replace(
            self,
            states=np.concatenate([self.states, ahead]),
            inputs=np.concatenate([self.inputs, held]),
        )

    def until(self, steps: int) -> Trial:
        """Return the trial cut to at most `steps` steps."""
        if steps >= self.steps:
            return self
        return replace(self, states=self.states[: steps + 1], inputs=self.inputs[:steps])


def scattered(trials: Sequence[Trial]) -> bool:
    """Return whether repeats of a candidate, or of the same commands, gave different states.

    If so, the system has noise, and two trials that agree to the last bit must be copies.
    """
    first: dict[str | bytes, Trial] = {}
    return any(
        not first.setdefault(trial.candidate or trial.inputs.tobytes(), trial).repeats(trial)
        for trial in trials
    )


def mean_trial(trials: Sequence[Trial], angles: NDArray[np.bool_] | None = None) -> Trial:
    """Return the mean of repeated trials of equal length: states, inputs and held input.

    Args:
        trials: at least one; a single trial is returned as it is.
        angles: (n,) bool, which states are angles; they are unwrapped relative to the first trial,
            since logs may differ by full turns.
    """
    if len(trials) == 1:
        return trials[0]
    first = trials[0]
    off = np.array([t.states - first.states for t in trials])
    if angles is not None:
        wrapped(off, angles)
    held = [t.start_inputs for t in trials if t.start_inputs is not None]
    return Trial(
        states=first.states + off.mean(axis=0),
        inputs=np.mean([t.inputs for t in trials], axis=0),
        dt=first.dt,
        state_names=first.state_names,
        input_names=first.input_names,
        candidate=first.candidate,
        start_inputs=np.mean(held, axis=0) if len(held) == len(trials) else None,
    )


@dataclass(frozen=True, eq=False)
class Interpolated:
    """A trial with its short gaps filled, and a summary of them."""

    trial: Trial
    samples: int  # number of interpolated samples
    longest_s: float  # duration of the longest gap [s]
    state: str  # the state with the longest gap, "" if there was none
    at_s: float  # start of the longest gap [s]


def interpolate_gaps(trial: Trial) -> Interpolated:
    """Interpolate gaps in the states of at most MAX_GAP_S, linearly between known samples.

    A longer gap, or one that reaches the end, stays: the trial then counts as ended there. Nothing
    is changed if the first state is not fully known.
    """
    bad = ~np.isfinite(trial.states)
    if not bad.any() or bad[0].any():
        return Interpolated(trial, 0, 0.0, "", 0.0)
    states = np.array(trial.states)
    filled, longest, where, at = 0, 0, "", 0.0
    for i, name in enumerate(trial.state_names):
        for first, last in stretches(bad[:, i]):
            if last == len(states) or (last - first) * trial.dt > MAX_GAP_S:
                continue
            known = [first - 1, last]
            states[first:last, i] = np.interp(range(first, last), known, states[known, i])
            filled += last - first
            if last - first > longest:
                longest, where, at = last - first, name, first * trial.dt
    return Interpolated(replace(trial, states=states), filled, longest * trial.dt, where, at)


def stretches(true: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return [first, last) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], true.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
