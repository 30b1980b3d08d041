"""Trial: one real run on the control grid. A simulated run is a Rollout, never a Trial.

Samples get lost: a camera that misses the car for half a second loses states, not the trial. Short
gaps are interpolated (`interpolate_gaps`), and with them the bias (2 % lost samples are harmless);
long ones end the trial. Inputs are never invented: a trial ends before its first unknown
input. A recording that stops a step or two before the end of the run is judged as if it had gone on
(`Trial.whole`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grounded.errors import GroundedError
from grounded.frozen import Array, numbers, positive, wrapped

MAX_GAP_S = 1.0  # a longer gap ends a trial
LAST = 2  # steps that may be missing at the end of a run,
ENOUGH = 10  # if it has this many times as many
RECENT = 4  # steps whose mean rate goes on there
HUGE = 1e100  # from here on a number is as good as infinite: squares and products must be numbers


@dataclass(frozen=True, eq=False)
class Trial:
    """States s_0 .. s_T and the COMMANDED inputs a_0 .. a_{T-1}, sampled every dt.

    T is the horizon, or less when the run ended early. Angles are unwrapped.

    Raises:
        GroundedError: if the arrays do not fit each other.
    """

    states: Array  # (T + 1, n)
    inputs: Array  # (T, m)
    dt: float  # [s]
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    id: str = ""  # content hash of the stored file, "" before it is stored
    candidate: str = ""  # the candidate that was run; "" for a log that ran none
    start_inputs: Array | None = None  # (m,) held before t = 0; None: zero

    def __post_init__(self) -> None:
        states = numbers(self.states, "trial: states")
        inputs = numbers(self.inputs, "trial: inputs")
        for kind in ("state_names", "input_names"):
            names = getattr(self, kind)
            if isinstance(names, str) or not all(isinstance(name, str) for name in names):
                raise GroundedError(f"trial: {kind} must be a tuple of names, got {names!r:.60}")
            object.__setattr__(self, kind, tuple(names))
        positive("trial: dt", self.dt)
        n, m, rows = len(self.state_names), len(self.input_names), len(states) if states.ndim else 0
        if states.ndim != 2 or states.shape[1] != n or not rows:
            turned = ": transpose it" * (states.ndim == 2 and rows == n)
            raise GroundedError(
                f"a trial of {n} states needs an array (T+1, {n}), a row for each control step and "
                f"one for the end; got {states.shape}{turned}"
            )
        if inputs.shape != (rows - 1, m):
            mend = {
                (rows, m): ": the last state has no input, leave out the last row",
                (rows - 1,): ": make it a column, inputs[:, None]" * (m == 1),
                (m, rows - 1): ": transpose it",
            }
            raise GroundedError(
                f"a trial with {rows} rows of states and {m} inputs needs inputs of shape "
                f"({rows - 1}, {m}), got {inputs.shape}{mend.get(inputs.shape, '')}"
            )
        object.__setattr__(self, "states", states)
        object.__setattr__(self, "inputs", inputs)
        if self.start_inputs is not None:
            held = numbers(self.start_inputs, "trial: start_inputs")
            if held.shape != (m,):
                raise GroundedError(f"trial: start_inputs must have shape ({m},), got {held.shape}")
            object.__setattr__(self, "start_inputs", held)

    def __repr__(self) -> str:
        names = f"states {', '.join(self.state_names)}; inputs {', '.join(self.input_names)}"
        return f"Trial({self.id or 'new'}: {self.steps} steps of {self.dt:.4g} s; {names})"

    @property
    def steps(self) -> int:
        """T, the number of control steps that were run."""
        return len(self.inputs)

    @property
    def finite_steps(self) -> int:
        """Steps whose states and inputs are all finite numbers; -1 if the first state isn't."""
        states = ~(np.abs(self.states) < HUGE).all(axis=1)
        inputs = ~(np.abs(self.inputs) < HUGE).all(axis=1)
        known = int(np.argmax(states)) - 1 if states.any() else self.steps
        return min(known, int(np.argmax(inputs))) if inputs.any() else known

    @property
    def known_steps(self) -> int:
        """Steps whose inputs are known, up to the last state of which anything is; none diverged.

        What needs no whole states (a diagnosis) loses the samples of a gap, not what follows it.
        """
        known = np.flatnonzero(np.isfinite(self.states).any(axis=1))
        wild = (np.abs(self.states) >= HUGE).any(axis=1)
        bad = ~(np.abs(self.inputs) < HUGE).all(axis=1)
        last = int(known[-1]) if len(known) else 0
        last = min(last, int(np.argmax(wild)) - 1) if wild.any() else last
        return max(0, min(last, int(np.argmax(bad))) if bad.any() else last)

    def worth(self, task: str, compute: Callable[[], float]) -> float:
        """The utility in a task; a trial that remembers it computes it once.

        Args:
            task: stands for all that the utility depends on.
            compute: gives it.
        """
        return compute()

    def repeats(self, other: Trial) -> bool:
        """Whether the other has the very same states."""
        return np.array_equal(self.states, other.states, equal_nan=True)

    def whole(self, steps: int) -> Trial:
        """The trial up to so many steps; one that ends a step or two before goes on to there.

        The input is held meanwhile, and the states move as they did in the last steps.
        """
        missing = steps - self.steps
        if not (0 < missing <= LAST and self.steps >= ENOUGH * missing):
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
        """The trial up to so many steps; a log may go on after the horizon."""
        if steps >= self.steps:
            return self
        return replace(self, states=self.states[: steps + 1], inputs=self.inputs[:steps])


def scattered(trials: Sequence[Trial]) -> bool:
    """Whether a candidate, or the same commands, came out differently when run again.

    Then the system has noise, and two trials that agree to the last bit are one and its copy.
    """
    first: dict[str | bytes, Trial] = {}
    return any(
        not first.setdefault(trial.candidate or trial.inputs.tobytes(), trial).repeats(trial)
        for trial in trials
    )


def mean_trial(trials: Sequence[Trial], angles: NDArray[np.bool_] | None = None) -> Trial:
    """The mean of repeated whole trials: states, inputs, the held input; one trial is itself.

    Angles (n,) are taken near the first trial's: one log may be a full turn off another.
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
    """A trial without gaps: samples that were interpolated, and the state of the longest gap."""

    trial: Trial
    samples: int
    longest_s: float
    state: str  # where the longest gap was, "" if there was none
    at_s: float


def interpolate_gaps(trial: Trial) -> Interpolated:
    """Interpolates gaps of at most MAX_GAP_S between known samples; the first state must be known.

    A longer gap, or one that reaches the end, stays: the trial then counts as ended there.
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
    """[first, last) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], true.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
