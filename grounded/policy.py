"""Policies: the feed-forward, gains and reference that a robot runs. Needs numpy alone.

    u_t = clip( ubar_t + K_t (z_t - zbar_t) ),     z_t = [x_t, inputs already sent]

`Runner` keeps the past inputs in z (input by input, newest first, see `grounded.compile.problem`).
The paper's policy parameters theta are all feed-forwards and gains; `theta + alpha d` is
`toward(other, alpha)`.

`load` returns a `Runner` of an exported policy. `onboard.py` documents how it behaves in the
control loop; it is a separate file so that it can be copied to a robot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from grounded import onboard
from grounded.checks import refused
from grounded.errors import GroundedError
from grounded.frozen import Array, readonly, wrapped
from grounded.onboard import FORMAT, NUMBERS, Runner, misfit


@dataclass(frozen=True, eq=False)
class Policy:
    """Feed-forward, feedback gain and reference for each control step.

    The command at step t is clip(feedforward_t + gain_t (z_t - reference_t), low, high), where
    z_t holds the measured state and the inputs sent before. An open-loop policy has no gain and
    no reference. Sizes: H steps, m inputs, n states, nz = n + sum(depths).

    Args:
        feedforward: (H, m) ubar, in the inputs' units.
        low: (m,) hard lower limits of the inputs.
        high: (m,) hard upper limits of the inputs.
        dt: control interval [s].
        state_names: n names, in the order of z.
        input_names: m names, in column order.
        depths: (m,) number of past inputs in z, for each input; at least 1.
        angles: (n,) whether the difference of a state wraps to [-pi, pi].
        past: (m,) input held before t = 0.
        gain: (H, m, nz) feedback gains, or None.
        reference: (H, nz) zbar, or None.

    Raises:
        GroundedError: if the shapes do not match.
    """

    feedforward: Array
    low: Array
    high: Array
    dt: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    depths: tuple[int, ...]
    angles: tuple[bool, ...]
    past: Array
    gain: Array | None = None
    reference: Array | None = None

    def __post_init__(self) -> None:
        for name in ("feedforward", "low", "high", "past", "gain", "reference"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, readonly(getattr(self, name)))
        if wrong := misfit(self):
            raise refused("model.fails", "policy", why=wrong)

    def __repr__(self) -> str:
        names = f"states {', '.join(self.state_names)}; inputs {', '.join(self.input_names)}"
        loop = "open loop" if self.gain is None else "with feedback"
        return f"Policy({self.horizon} steps of {self.dt:.4g} s, {loop}; {names})"

    @property
    def horizon(self) -> int:
        """H, the number of control steps."""
        return len(self.feedforward)

    @property
    def mean_gain(self) -> float:
        """The mean absolute feedback gain; 0 without feedback."""
        return 0.0 if self.gain is None else float(np.abs(self.gain).mean())

    def after(self, steps: int) -> Policy:
        """Return the policy without its first steps."""
        return self._of_steps(slice(steps, None))

    def until(self, steps: int) -> Policy:
        """Return the policy's first steps."""
        return self._of_steps(slice(steps))

    def _of_steps(self, steps: slice) -> Policy:
        gain = None if self.gain is None else self.gain[steps]
        reference = None if self.reference is None else self.reference[steps]
        return replace(self, feedforward=self.feedforward[steps], gain=gain, reference=reference)

    @property
    def z_names(self) -> tuple[str, ...]:
        """Names of the entries of z: the states, then past inputs such as `steering[t-1]`."""
        past = [
            f"{name}[t-{i + 1}]"
            for name, depth in zip(self.input_names, self.depths, strict=True)
            for i in range(depth)
        ]
        return (*self.state_names, *past)

    def laid_out(
        self, state_names: tuple[str, ...], angles: tuple[bool, ...], depths: tuple[int, ...]
    ) -> Policy:
        """Return the policy over another z: columns are matched by name.

        Columns that are new get zero gain; columns that the new z lacks are dropped.

        Args:
            state_names: states of the new z, in order.
            angles: which of them wrap.
            depths: past inputs of the new z, for each input.
        """
        layout = replace(
            self, state_names=state_names, angles=angles, depths=depths, gain=None, reference=None
        )
        if self.gain is None or self.reference is None:
            return layout
        mine, names = self.z_names, layout.z_names
        if mine == names:
            return replace(layout, gain=self.gain, reference=self.reference)
        gain = np.zeros((*self.feedforward.shape, len(names)))
        reference = np.zeros((self.horizon, len(names)))
        for column, name in enumerate(names):
            if name in mine:
                gain[:, :, column] = self.gain[:, :, mine.index(name)]
                reference[:, column] = self.reference[:, mine.index(name)]
        return replace(layout, gain=gain, reference=reference)

    def about(self, reference: Array) -> Policy:
        """Return the same control law written about another reference (H, nz)."""
        if self.gain is None or self.reference is None:
            return self
        shift = z_difference(reference, self.reference, self.angles)
        moved = self.feedforward + np.einsum("tij,tj->ti", self.gain, shift)
        return replace(self, feedforward=moved, reference=reference)

    def toward(self, other: Policy, alpha: float) -> Policy:
        """Return theta + alpha (theta' - theta) (footnote 11), with theta' the other policy."""
        if alpha == 1.0:
            return other
        if self.z_names != other.z_names:
            start = self.laid_out(other.state_names, other.angles, other.depths)
            return start.toward(other, alpha)
        if other.reference is None or other.gain is None:
            mixed = (1 - alpha) * self.feedforward + alpha * other.feedforward
            return replace(other, feedforward=mixed)
        mine = self.about(other.reference)
        mixed = (1 - alpha) * mine.feedforward + alpha * other.feedforward
        own_gain = np.zeros_like(other.gain) if mine.gain is None else mine.gain
        gain = (1 - alpha) * own_gain + alpha * other.gain
        return replace(other, feedforward=mixed, gain=gain)

    def commands(self, states: Array, past: Array, sent: Array | None = None) -> Array:
        """Return the commands (B, T, m) of the policy for given states; T is at most H.

        Past inputs in z are the policy's own commands unless `sent` is given. With the logged
        inputs, a gain on the last inputs would make the commands follow any smooth log.

        Args:
            states: (B, T, n) states of B runs.
            past: (m,) the input held before the first step.
            sent: (B or 1, T, m) past inputs to use instead of the policy's own; many times faster.
        """
        T, n = states.shape[1:]
        asked: Array = np.repeat(self.feedforward[None, :T], len(states), 0)
        if self.gain is None or self.reference is None:
            return np.clip(asked, self.low, self.high)
        off = z_difference(states, self.reference[:T, :n], self.angles)
        by_step = np.matmul(off.swapaxes(0, 1), self.gain[:T, :, :n].swapaxes(1, 2))
        asked += by_step.swapaxes(0, 1)
        memory, oldest = self.gain[:T, :, n:], max(self.depths)
        if not memory.any():
            return np.clip(asked, self.low, self.high)
        asked -= np.einsum("tij,tj->ti", memory, self.reference[:T, n:])
        places = [(j, oldest - i) for j, d in enumerate(self.depths) for i in range(1, d + 1)]
        if sent is not None:
            held = np.broadcast_to(past, (len(sent), oldest, len(past)))
            held = np.concatenate([held, sent], axis=1)
            added = np.zeros((len(sent), T, len(past)))
            for k, (j, start) in enumerate(places):
                added += memory[:, :, k] * held[:, start : start + T, j, None]
            return np.clip(asked + added, self.low, self.high)
        return self._on_own(asked, past, memory, places)

    def _on_own(
        self, asked: Array, past: Array, memory: Array, places: list[tuple[int, int]]
    ) -> Array:
        """Add the feedback from the policy's own past commands (B, T, m), step by step, and clip.

        For each of the gains (T, m, sum(depths)) in `memory`, `places` has the input, and its row
        among the last commands.
        """
        B, T, m = asked.shape
        oldest = max(self.depths)
        gains = np.zeros((T, m, oldest * m))  # on the last commands as they lie in `sent`
        gains[:, :, [row * m + j for j, row in places]] = memory
        sent = np.empty((oldest + T, m, B))
        sent[:oldest] = past[:, None]
        last = sent.reshape((oldest + T) * m, B)
        low, high = (np.repeat(limit[:, None], B, 1) for limit in (self.low, self.high))
        without, now = np.ascontiguousarray(asked.transpose(1, 2, 0)), np.empty((m, B))
        for t in range(T):  # clip takes twice as long as minimum and maximum
            np.dot(gains[t], last[t * m : (t + oldest) * m], out=now)  # less overhead than matmul
            now += without[t]
            np.maximum(now, low, out=now)
            np.minimum(now, high, out=sent[oldest + t])
        return np.ascontiguousarray(sent[oldest:].transpose(2, 0, 1))


def z_difference(a: Array, b: Array, angles: tuple[bool, ...]) -> Array:
    """Return the difference a - b of augmented states (..., nz), with angles wrapped."""
    return wrapped(np.asarray(a, float) - np.asarray(b, float), angles)


def to_arrays(policy: Policy, **about: str) -> dict[str, Any]:
    """Return a policy as arrays for `numpy.savez`, with strings that a reader may check."""
    arrays: dict[str, Any] = {name: getattr(policy, name) for name in NUMBERS}
    arrays |= {
        "format": FORMAT,
        "dt": policy.dt,
        "state_names": np.array(policy.state_names),
        "input_names": np.array(policy.input_names),
        "z_names": np.array(policy.z_names),
        "depths": np.array(policy.depths),
        "angles": np.array(policy.angles),
    }
    if policy.gain is not None:
        arrays |= {"gain": policy.gain, "reference": policy.reference}
    return arrays | about


def load(
    path: str | Path,
    *,
    states: tuple[str, ...] | None = None,
    inputs: tuple[str, ...] | None = None,
    task: str | None = None,
) -> Runner:
    """Load a runner from a candidate file: an exported .npz, or the .mcap as proposed.

    Args:
        path: the .npz (`grounded export ID --format npz`) or .mcap file; nothing in it is executed.
            An .mcap needs `grounded_trials`, found by its entry point in the group
            `grounded.policies`.
        states: the robot's state names in the order in which it passes them; None for no check.
        inputs: the robot's input names in the order in which it sends them; None for no check.
        task: the task hash that the robot is set up for; None for no check.

    Returns:
        A `Runner` for one run.

    Raises:
        GroundedError: if the file is not a candidate, or is for another robot or task.
    """
    if Path(path).suffix == ".mcap":
        return onboard.Runner(_proposed(Path(path), states, inputs, task))
    try:
        return onboard.Runner(Policy(**onboard.read(path, states, inputs, task)))
    except ValueError as error:
        raise GroundedError(str(error)) from None


def _proposed(
    path: Path, states: tuple[str, ...] | None, inputs: tuple[str, ...] | None, task: str | None
) -> Policy:
    """Read a policy with the reader registered for the file's suffix, with the checks of `load`."""
    from importlib.metadata import entry_points

    readers = [p for p in entry_points(group="grounded.policies") if p.name == path.suffix[1:]]
    if not readers:
        raise refused("file.unreadable", path, why=path.suffix, mend="trials")
    policy, made_for = readers[0].load()(path)
    assert isinstance(policy, Policy)
    try:
        onboard.check_robot(path, policy, states, inputs)
        onboard.check_task(path, made_for, task)
        onboard.check_limits(path, policy)
    except ValueError as error:
        raise GroundedError(str(error)) from None
    return policy
