"""Run an exported policy on the robot. Needs only Python 3.8 and numpy, not grounded.

    u_t = clip( ubar_t + K_t (z_t - zbar_t) ),     z_t = [x_t, inputs already sent]

    runner = load("turn.npz", states=("delta", "v", "x", "y", "psi", "psi_rate"))
    while not runner.done(t):
        send(runner.action(t, state))          # array (m,), inside the hard limits

`grounded export ID --runner` copies this file beside the candidate. `action` never raises an
exception inside the control loop. It ignores invalid states and times, and `runner.blind` counts
the calls concerned:

  - The controller of the step nearest to t is used, so `action` may be called at the rate of the
    state estimate. If calls were missed, the input counts as held in between.
  - A state that is not finite, has the wrong length or is not an array of numbers switches the
    feedback off for that call: only the feed-forward is sent.
  - If the time goes backwards, the latest step is used. If it is not a number, the last input is
    sent again.
  - After the last step, `done` is true and the input held before the start is sent, clipped to the
    limits. Keep recording for one more second: the last state is part of the run.
  - A finished run stays finished, even if the time restarts: use a new runner for each run.
"""

from __future__ import annotations

import sys
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Optional, Tuple
from zipfile import ZipFile

import numpy as np

EARLY = 0.1  # fraction of a step by which a timer may be early at the end of the run
LIMIT = 2**28  # [bytes] largest decompressed size of an exported policy

FORMAT = "grounded-policy-1"
NUMBERS = ("feedforward", "low", "high", "past")
Names = Optional[Tuple[str, ...]]


class Runner:
    """Executes one run of a policy; make a new one for each run.

    Args:
        policy: a `Policy`, or any object with its fields: feedforward (H, m), low, high and past
            (m,), dt [s], state_names, depths, angles, gain (H, m, nz), reference (H, nz).

    Attributes:
        blind: number of calls so far whose state or time could not be used.

    Raises:
        ValueError: if `policy` is a file or something else without these fields.
    """

    def __init__(self, policy: Any) -> None:
        if isinstance(policy, (str, Path)):
            raise ValueError(f"Runner takes a policy, not a file: use load({str(policy)!r})")
        if not hasattr(policy, "feedforward"):
            kind = type(policy).__name__
            hint = ": pass its policy" if hasattr(policy, "policy") else ""
            raise ValueError(f"Runner takes a policy, got a {kind}{hint}")
        self.policy = policy
        self.blind = 0  # calls whose state or time could not be used
        self._H = len(policy.feedforward)
        self._deep = max(policy.depths, default=1)
        self._held = np.minimum(np.maximum(policy.past, policy.low), policy.high)
        self._sent = np.tile(np.asarray(policy.past, float), (self._H + self._deep, 1))
        self._latest = -1
        columns = [(j, i + 1) for j, d in enumerate(policy.depths) for i in range(d)]
        self._queue_input = np.array([c[0] for c in columns], dtype=int)
        self._queue_lag = np.array([c[1] for c in columns], dtype=int)
        self._angles = np.flatnonzero(policy.angles)
        self._n = len(policy.state_names)
        self._z = np.empty(self._n + len(columns))

    def done(self, t: float) -> bool:
        """Return whether the run is over at t seconds after the start."""
        return self._step(t) >= self._H

    def action(self, t: float, s: Any) -> Any:
        """Return the inputs to send, (m,), inside the hard limits.

        Args:
            t: time since the start of the run [s].
            s: measured state (n,), in the policy's order and units.
        """
        policy, step = self.policy, self._step(t)
        if step < 0:  # the time is not a number
            self.blind += 1
            return np.array(
                self._held if self._latest < 0 else self._sent[self._latest + self._deep]
            )
        step = max(step, self._latest)
        if step >= self._H:
            return np.array(self._held)
        base = step + self._deep
        if step > self._latest + 1:  # calls were missed: the input was held meanwhile
            self._sent[self._latest + 1 + self._deep : base] = self._sent[self._latest + self._deep]
        u = policy.feedforward[step]
        if policy.gain is not None:
            correction = self._correction(step, base, s)
            if correction is None:
                self.blind += 1
            else:
                u = u + correction
        u = np.minimum(np.maximum(u, policy.low), policy.high)
        self._sent[base] = u
        self._latest = step
        return u

    def _step(self, t: float) -> int:
        """Return the control step nearest to t; -1 if t is not a number, H if the run is over.

        The last step lasts to the end of the horizon. Once it was sent, a time in the first half of
        the run means that the clock has restarted: the run is over.
        """
        try:
            where = float(t) / self.policy.dt + 0.5
        except (TypeError, ValueError):
            return -1
        if where != where:
            return -1
        last = self._H if where - 0.5 >= self._H - EARLY else self._H - 1
        step = int(min(max(where, 0.0), float(last)))
        return self._H if self._latest == self._H - 1 and step < self._H // 2 else step

    def _correction(self, step: int, base: int, s: Any) -> Any:
        """Return the feedback K_t (z - zbar), (m,); None if the state can't be used."""
        z = self._z
        try:
            state: Any = np.ma.filled(np.ma.asarray(s, dtype=float), np.nan)
        except (TypeError, ValueError):
            return None
        if state.ndim > 1 or state.size != self._n:
            return None
        z[: self._n] = state
        z[self._n :] = self._sent[base - self._queue_lag, self._queue_input]
        z -= self.policy.reference[step]
        if not np.isfinite(z).all():
            return None
        for i in self._angles:
            z[i] -= 2 * np.pi * round(z[i] / (2 * np.pi))
        correction = self.policy.gain[step] @ z
        return correction if np.isfinite(correction).all() else None


def load(
    path: Any, states: Names = None, inputs: Names = None, task: Optional[str] = None
) -> Runner:
    """Load a runner from an exported candidate; nothing in the file is executed.

    Its `policy` has the fields of a `Policy`, `horizon` (the number of steps) included.

    Args:
        path: the .npz file.
        states: the robot's state names in the order in which it passes them; None for no check.
        inputs: the robot's input names in the order in which it sends them; None for no check.
        task: the task hash that the robot is set up for; None for no check.

    Raises:
        ValueError: if the file is not an exported candidate, or is for another robot or task.
    """
    found = read(path, states, inputs, task)
    return Runner(SimpleNamespace(horizon=len(found["feedforward"]), **found))


def read(path: Any, states: Names, inputs: Names, task: Optional[str]) -> dict[str, Any]:
    """Read and check the fields of an exported policy; see `load` for the arguments."""
    data = _archive(path)
    if str(data.get("format", "")) != FORMAT:
        raise ValueError(f"{path} is not a candidate exported by `grounded export --format npz`")
    try:
        found: dict[str, Any] = {name: np.asarray(data[name], float) for name in NUMBERS}
        found["dt"] = float(data["dt"])
        found["state_names"] = tuple(map(str, data["state_names"]))
        found["input_names"] = tuple(map(str, data["input_names"]))
        found["depths"] = tuple(map(int, data["depths"]))
        found["angles"] = tuple(map(bool, data["angles"]))
        found["gain"], found["reference"] = data.get("gain"), data.get("reference")
    except KeyError as error:
        raise ValueError(f"{path} lacks {error}; export it again") from None
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged: {error}; export it again") from None
    check_robot(path, SimpleNamespace(**found), states, inputs)
    check_task(path, str(data.get("task", "")), task)
    _check(path, found)
    return found


def check_robot(path: Any, policy: Any, states: Names, inputs: Names) -> None:
    """Raise ValueError unless the policy has these state and input names, in this order."""
    for kind, names, own in (
        ("states", states, policy.state_names),
        ("inputs", inputs, policy.input_names),
    ):
        if names is not None and tuple(names) != own:
            raise ValueError(f"{path} is for {kind} {own}; this robot has {tuple(names)}")


def check_task(path: Any, made_for: str, task: Optional[str]) -> None:
    """Raise ValueError unless the policy was made for the task with this hash."""
    if task is not None and made_for != task:
        raise ValueError(f"{path} is for task {made_for}; this robot is set up for {task}")


def _check(path: Any, found: dict[str, Any]) -> None:
    """Raise ValueError unless sizes, limits and dt are consistent and the arrays are finite."""
    ubar, gain, reference = found["feedforward"], found["gain"], found["reference"]
    H, m = ubar.shape if ubar.ndim == 2 else (0, 0)
    n, nz = len(found["state_names"]), len(found["state_names"]) + sum(found["depths"])
    fits = H > 0 and all(found[name].shape == (m,) for name in NUMBERS[1:])
    fits = fits and len(found["input_names"]) == m == len(found["depths"])
    fits = fits and len(found["angles"]) == n and found["dt"] > 0
    fits = fits and min(found["depths"], default=0) >= 1 and (gain is None) == (reference is None)
    if gain is not None and reference is not None:
        fits = fits and gain.shape == (H, m, nz) and reference.shape == (H, nz)
    if not fits:
        raise ValueError(f"{path} is damaged: its fields are inconsistent; export it again")
    parts = [found[name] for name in ("feedforward", "past", "gain", "reference")]
    finite = all(np.isfinite(part).all() for part in parts if part is not None)
    if not (finite and (found["low"] <= found["high"]).all()):  # NaN is not below anything
        raise ValueError(
            f"{path} holds numbers that are not finite, or a lower limit above the upper one; "
            "export it again"
        )


def _archive(path: Any) -> dict[str, Any]:
    try:
        if not Path(path).is_file() and Path(path).exists():
            raise ValueError(f"{path} is a folder, a pipe or a device, not a file")
        content = Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"{path} can't be read: {error.strerror}") from None
    try:
        size = sum(part.file_size for part in ZipFile(BytesIO(content)).infolist())
        if size > LIMIT:
            raise ValueError(f"its decompressed size is {size} bytes, the limit is {LIMIT}")
        with np.load(BytesIO(content), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:  # numpy, zipfile and zlib each have errors of their own
        raise ValueError(
            f"{path} is damaged, or not an exported candidate (.npz): {error}; export it again"
        ) from None


if __name__ == "__main__":  # check a file and print its contents
    if len(sys.argv) != 2:
        sys.exit(f"usage: python {sys.argv[0]} CANDIDATE.npz")
    try:
        shown = load(sys.argv[1]).policy
    except ValueError as problem:
        sys.exit(f"error: {problem}")
    print(f"{shown.horizon} steps of {shown.dt:g} s")
    print("states ", ", ".join(shown.state_names))
    for name, low, high in zip(shown.input_names, shown.low, shown.high):
        print(f"input   {name}, limits {low:g} to {high:g}")
