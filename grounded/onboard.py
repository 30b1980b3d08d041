"""Run an exported policy on the robot. Needs only Python 3.8 and numpy, not grounded.

    u_t = clip( ubar_t + K_t (z_t - zbar_t) ),     z_t = [x_t, inputs already sent]

    runner = load("turn.npz", states=("delta", "v", "x", "y", "psi", "psi_rate"))
    while not runner.done(t):
        send(runner.action(t, state))          # array (m,), inside the hard limits

`grounded export ID --runner` copies this file beside the candidate. `action` never raises an
exception inside the control loop, whatever it is given. It ignores invalid states and times, and
`runner.blind` counts the calls concerned:

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
LIMIT = 2**28  # [bytes] largest size of an exported policy, as a file and decompressed
PARTS = 100  # arrays in a file
NAMES, WIDTH = 1000, 100_000  # states or inputs; entries of z, the past inputs included

FORMAT = "grounded-policy-1"
NUMBERS = ("feedforward", "low", "high", "past")
FEEDBACK = ("gain", "reference")
FIELDS = {  # NumPy's kinds of each array of a file, and the largest number of its values
    **dict.fromkeys(("format", "task"), ("U", 1)),
    "dt": ("fiu", 1),
    **dict.fromkeys((*NUMBERS, *FEEDBACK), ("fiu", LIMIT // 8)),
    **dict.fromkeys(("state_names", "input_names"), ("U", NAMES)),
    "depths": ("iu", NAMES),
    "angles": ("b", NAMES),
}
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
        try:
            with np.errstate(all="ignore"):  # a program may have set it to raise
                u = self._command(self._step(t), s)
            if np.isfinite(u).all():
                return u
        except Exception:  # whatever an object that is passed as a state may do
            pass
        self.blind += 1
        return self._safe()

    def _safe(self) -> Any:
        """Return the last input that was sent."""
        return np.array(self._held if self._latest < 0 else self._sent[self._latest + self._deep])

    def _command(self, step: int, s: Any) -> Any:
        """Return the inputs (m,) at a step, which are remembered; the last ones at step -1."""
        policy = self.policy
        if step < 0:  # the time is not a number
            self.blind += 1
            return self._safe()
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
        if np.isfinite(u).all():
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
        except Exception:
            return -1
        if where != where:
            return -1
        last = self._H if where - 0.5 >= self._H - EARLY else self._H - 1
        step = int(min(max(where, 0.0), float(last)))
        return self._H if self._latest == self._H - 1 and step < self._H // 2 else step

    def _correction(self, step: int, base: int, s: Any) -> Any:
        """Return the feedback K_t (z - zbar), (m,); None if the state can't be used."""
        z = self._z
        try:  # an object's own methods may raise anything
            state: Any = np.ma.asarray(s)
            if state.dtype.kind not in "fiubO" or state.ndim > 1 or state.size != self._n:
                return None
            state = np.ma.filled(state.astype(float), np.nan)
        except Exception:
            return None
        z[: self._n] = state
        z[self._n :] = self._sent[base - self._queue_lag, self._queue_input]
        z -= self.policy.reference[step]
        if not np.isfinite(z).all():
            return None
        for i in self._angles:
            z[i] -= 2 * np.pi * np.rint(z[i] / (2 * np.pi))
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
        present = [name for name in (*NUMBERS, *FEEDBACK) if name in NUMBERS or name in data]
        if any(np.iscomplexobj(data[name]) for name in present):
            raise ValueError("complex numbers")
        found: dict[str, Any] = {name: np.array(data[name], float) for name in present}
        found["dt"] = float(data["dt"])
        for name, kind in (("state_names", str), ("input_names", str), ("depths", int)):
            found[name] = tuple(map(kind, data[name]))
        found["angles"] = tuple(map(bool, data["angles"]))
    except KeyError as error:
        raise ValueError(f"{path} lacks {error}; export it again") from None
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged: {error}; export it again") from None
    policy = SimpleNamespace(**{**dict.fromkeys(FEEDBACK), **found})
    check_robot(path, policy, states, inputs)
    check_task(path, str(data.get("task", "")), task)
    check_limits(path, policy)
    return vars(policy)


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


def check_limits(path: Any, policy: Any) -> None:
    """Raise ValueError unless the policy may run on a robot: no `fault`, and finite limits."""
    wrong = fault(policy)
    if not wrong and not np.isfinite([policy.low, policy.high]).all():
        wrong = "an input has no limit, so a robot may be sent anything: state it in [limits]"
    if wrong:
        raise ValueError(f"{path} must not be run: {wrong}; export it again")


def misfit(policy: Any) -> str:
    """Return which fields of a policy don't fit together; "" if all do."""
    shape = np.shape(policy.feedforward)
    if len(shape) != 2 or 0 in shape:
        return f"its feed-forward must have shape (H, m), found {shape}"
    (H, m), n = shape, len(policy.state_names)
    sizes = [len(policy.input_names), len(policy.depths), len(policy.angles)]
    limits = [np.shape(getattr(policy, name)) for name in NUMBERS[1:]]
    if sizes != [m, m, n] or limits != [(m,)] * 3:
        return (
            f"it has {n} states and {m} inputs, but its input names, depths and angles have sizes "
            f"{sizes}, its limits and held input the shapes {limits}"
        )
    nz = n + sum(policy.depths)
    if not (0 < policy.dt < np.inf and min(policy.depths) >= 1 and nz <= WIDTH):
        return (
            f"its dt is {policy.dt} and its depths are {policy.depths[:9]}; expected a positive "
            f"dt, depths of at least 1, and with the states at most {WIDTH}"
        )
    if (policy.gain is None) != (policy.reference is None):
        return "it has one of gain and reference; feedback needs both"
    if policy.gain is not None:
        found = [np.shape(getattr(policy, name)) for name in FEEDBACK]
        if found != [(H, m, nz), (H, nz)]:
            return f"gain and reference have shapes {found}, expected {[(H, m, nz), (H, nz)]}"
    return ""


def fault(policy: Any) -> str:
    """Return why a policy can't be run: a `misfit`, or a number that is not one; "" if it can."""
    if wrong := misfit(policy):
        return wrong
    for name in ("feedforward", "past", *FEEDBACK):
        values = getattr(policy, name)
        if values is not None and not np.isfinite(values).all():
            k = int(np.argwhere(~np.isfinite(values))[0][0])
            return f"'{name}' is not a finite number at step {k} ({k * policy.dt:.3f} s)"
    low, high = policy.low, policy.high
    if not ((low <= high) & (low < np.inf) & (high > -np.inf)).all():  # NaN is below nothing
        return f"its limits {low[:9]} to {high[:9]} are not a lower and an upper one"
    return ""


def _archive(path: Any) -> dict[str, Any]:
    """Return the arrays of a file by name, with their kinds and sizes checked."""
    try:
        if not Path(path).is_file() and Path(path).exists():
            raise ValueError(f"{path} is a folder, a pipe or a device, not a file")
        if Path(path).stat().st_size > LIMIT:
            raise ValueError(f"{path} has more than {LIMIT} bytes: it is not an exported candidate")
        content = Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"{path} can't be read: {error.strerror}") from None
    try:
        count = content.count(b"PK\1\2")  # an entry of the table of contents begins so
        if count > PARTS:
            raise ValueError(f"it has {count} parts, the limit is {PARTS}")
        with ZipFile(BytesIO(content)) as archive:
            parts = {part.filename: part for part in archive.infolist()}
            mine = {name: parts[f"{name}.npy"] for name in FIELDS if f"{name}.npy" in parts}
            size = sum(part.file_size for part in mine.values())
            if size > LIMIT or not {part.compress_type for part in mine.values()} <= {0, 8}:
                raise ValueError(f"its decompressed size is {size} bytes, the limit is {LIMIT}")
            return {name: _array(archive, part, *FIELDS[name]) for name, part in mine.items()}
    except Exception as error:  # numpy, zipfile and zlib each have errors of their own
        raise ValueError(
            f"{path} is damaged, or not an exported candidate (.npz): {error}; export it again"
        ) from None


def _array(archive: ZipFile, part: Any, kinds: str, most: int) -> Any:
    """Return an array of these kinds, with at most `most` values; no more memory is taken."""
    with archive.open(part) as stream:
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ValueError(f"{part.filename} has another version than 1.0 of NumPy's format")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
        count = 1
        for side in shape:
            count *= side
        if max(count, *shape, 0) > most or (count and dtype.kind not in kinds):
            raise ValueError(f"{part.filename} has the shape {shape} and type {dtype}")
        data = stream.read(part.file_size)  # to its end, so that the checksum is compared
    return np.ndarray(shape, dtype, data, order="F" if fortran else "C")


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
