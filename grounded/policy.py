"""Policies: what a robot runs, and the runner that runs it. numpy alone.

    u_t = clip( ubar_t + K_t (z_t - zbar_t) ),     z_t = [x_t, inputs already sent]

The past inputs in z (newest first, input by input, see `grounded.compile.problem`) are known to
whoever runs the policy: `Runner` keeps them. theta, the paper's policy parameters, are all
feed-forwards and gains; `theta + alpha d` is `toward(other, alpha)`.

`load` gives a `Runner` of an exported policy; how it acts in the control loop is told in
`onboard.py`, which is a file of its own so that it can be copied to a robot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array, readonly, wrapped

if TYPE_CHECKING:
    from grounded.onboard import Runner


@dataclass(frozen=True, eq=False)
class Policy:
    """Feed-forward, gain and reference for each control step.

    An open-loop policy (the paper's turn) has no gain and no reference. Sizes: H steps, m inputs,
    n states, nz = n + sum(depths).
    """

    feedforward: Array  # (H, m) ubar
    low: Array  # (m,) hard limits of the inputs
    high: Array  # (m,)
    dt: float  # [s]
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    depths: tuple[int, ...]  # past inputs in z, for each input
    angles: tuple[bool, ...]  # (n,) differences that wrap
    past: Array  # (m,) the input held before t = 0
    gain: Array | None = None  # (H, m, nz)
    reference: Array | None = None  # (H, nz) zbar

    def __post_init__(self) -> None:
        for name in ("feedforward", "low", "high", "past", "gain", "reference"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, readonly(getattr(self, name)))
        if self.feedforward.ndim != 2 or len(self.feedforward) == 0:
            raise GroundedError(
                f"a feed-forward must have shape (H, m), found {self.feedforward.shape}"
            )
        H, m = self.feedforward.shape
        n, nz = len(self.state_names), len(self.state_names) + sum(self.depths)
        sizes = (len(self.input_names), *self.low.shape, *self.high.shape, *self.past.shape)
        if sizes != (m,) * 4 or len(self.depths) != m or len(self.angles) != n:
            raise GroundedError(
                f"a policy of {n} states and {m} inputs: its names, limits, held input, depths and "
                "angles don't have these sizes"
            )
        if not (np.isfinite(self.dt) and self.dt > 0 and min(self.depths) >= 1):
            raise GroundedError("a policy's dt must be positive and its depths at least 1")
        if (self.gain is None) != (self.reference is None):
            raise GroundedError("a feedback policy needs both a gain and a reference")
        if self.gain is not None and self.reference is not None:
            found = (self.gain.shape, self.reference.shape)
            if found != ((H, m, nz), (H, nz)):
                raise GroundedError(
                    f"gain and reference must have shapes {((H, m, nz), (H, nz))}, got {found}"
                )

    def __repr__(self) -> str:
        names = f"states {', '.join(self.state_names)}; inputs {', '.join(self.input_names)}"
        loop = "open loop" if self.gain is None else "with feedback"
        return f"Policy({self.horizon} steps of {self.dt:.4g} s, {loop}; {names})"

    @property
    def horizon(self) -> int:
        """H, the number of control steps."""
        return len(self.feedforward)

    @property
    def z_names(self) -> tuple[str, ...]:
        """Names of z: the states, then the past inputs as `steering[t-1]`."""
        past = [
            f"{name}[t-{i + 1}]"
            for name, depth in zip(self.input_names, self.depths, strict=True)
            for i in range(depth)
        ]
        return (*self.state_names, *past)

    def laid_out(
        self, state_names: tuple[str, ...], angles: tuple[bool, ...], depths: tuple[int, ...]
    ) -> Policy:
        """The same policy over another z: columns go by name, new ones have no gain, others go.

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
        """The same policy, written about another reference (H, nz)."""
        if self.gain is None or self.reference is None:
            return self
        shift = z_difference(reference, self.reference, self.angles)
        moved = self.feedforward + np.einsum("tij,tj->ti", self.gain, shift)
        return replace(self, feedforward=moved, reference=reference)

    def toward(self, other: Policy, alpha: float) -> Policy:
        """Theta + alpha d with d = theta' - theta (footnote 11): alpha = 1 is `other` itself."""
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
        """What it sends on given states, (B, T, m); T is at most H.

        It remembers what it sent itself: a gain on the last inputs would make any smooth log look
        alike if they were the logged ones.

        Args:
            states: (B, T, n), B runs.
            past: (m,) the inputs held before the first step.
            sent: (B, T, m) what it remembers instead, many times quicker.
        """
        T, n = states.shape[1:]
        asked: Array = np.repeat(self.feedforward[None, :T], len(states), 0)
        if self.gain is None or self.reference is None:
            return np.clip(asked, self.low, self.high)
        off = z_difference(states, self.reference[:T, :n], self.angles)
        asked += np.einsum("tij,btj->bti", self.gain[:T, :, :n], off)
        memory, newest = self.gain[:T, :, n:], np.cumsum([0, *self.depths[:-1]])
        asked -= np.einsum("tij,tj->ti", memory, self.reference[:T, n:])
        if sent is not None:
            oldest = max(self.depths)
            held = np.concatenate([np.repeat(past[None, None], oldest, 1), sent], axis=1)
            places = [(j, oldest - i) for j, d in enumerate(self.depths) for i in range(1, d + 1)]
            for k, (j, start) in enumerate(places):
                asked += memory[:, :, k] * held[:, start : start + T, j, None]
            return np.clip(asked, self.low, self.high)
        z = np.repeat(np.repeat(past, self.depths)[None], len(states), 0)
        for t in range(T):
            low = np.maximum(asked[:, t] + z @ memory[t].T, self.low)  # clip takes twice as long
            asked[:, t] = np.minimum(low, self.high)
            z[:, 1:] = z[:, :-1].copy()
            z[:, newest] = asked[:, t]
        return asked


def z_difference(a: Array, b: Array, angles: tuple[bool, ...]) -> Array:
    """The difference a - b of augmented states (..., nz), angles wrapped."""
    return wrapped(np.asarray(a, float) - np.asarray(b, float), angles)


def to_arrays(policy: Policy, **about: str) -> dict[str, Any]:
    """A policy as arrays and strings for `numpy.savez`; `about` adds what a reader may check."""
    from grounded.onboard import FORMAT, NUMBERS

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
    """A runner from a candidate: exported (`grounded export ID --format npz`), or as proposed.

    Args:
        path: the .npz or .mcap file; it is data, nothing in it is executed. The .mcap needs
            `grounded_trials`, found by its entry point in the group `grounded.policies`.
        states: the robot's state names in the order in which it will pass them.
        inputs: the robot's input names in the order in which it will send them.
        task: the task hash that the robot is set up for.

    Raises:
        GroundedError: if the file is no exported candidate, or one for another robot or task.
    """
    from grounded import onboard

    if Path(path).suffix == ".mcap":
        return onboard.Runner(_proposed(Path(path), states, inputs, task))
    try:
        return onboard.Runner(Policy(**onboard.read(path, states, inputs, task)))
    except ValueError as error:
        raise GroundedError(str(error)) from None


def _proposed(
    path: Path, states: tuple[str, ...] | None, inputs: tuple[str, ...] | None, task: str | None
) -> Policy:
    """A policy from a file whose format is registered by its suffix, checked as an .npz is."""
    from importlib.metadata import entry_points

    from grounded import onboard

    readers = [p for p in entry_points(group="grounded.policies") if p.name == path.suffix[1:]]
    if not readers:
        raise GroundedError(
            f"{path}: nothing here reads {path.suffix}; install grounded with its trials, or "
            "export the candidate with --format npz"
        )
    policy, made_for = readers[0].load()(path)
    assert isinstance(policy, Policy)
    try:
        onboard.check_robot(path, policy, states, inputs)
        onboard.check_task(path, made_for, task)
    except ValueError as error:
        raise GroundedError(str(error)) from None
    return policy
