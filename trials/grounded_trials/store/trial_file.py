"""Writes trial files, at once or while the trial runs, and reads them back exactly.

The format is described in this folder's `__init__`.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import zip_longest
from pathlib import Path
from typing import IO, Any

import numpy as np

from grounded.checks import of_shape, refused, wrong
from grounded.frozen import Array
from grounded.trial import Trial
from grounded_trials.formats.protobuf import encode_doubles
from grounded_trials.plain_file import unwritable
from grounded_trials.store.own_files import TRIAL, Meta, Units, read_own, stated, with_units
from grounded_trials.store.store import write_atomically

FLUSH_NS = 10**9  # [ns] of trial time between flushes: the most that a power failure loses


class TrialWriter:
    """Writes a trial while it runs; data older than a second survive a crash.

    Args:
        target: a path (an existing file is refused) or a writable binary stream.
        dt: control interval [s].
        states: name -> unit, in array order.
        inputs: name -> unit, in array order.
        meta: further entries of the metadata record.
        candidate: the candidate that is run, "" for none.
        policy: the bytes of the candidate's file.
        start_inputs: inputs held before t = 0, (m,); None: zero.
        start_states: states at t = 0 as the samples before show them, by name.
        start_ns: absolute time of t = 0 [ns], for display. If it is negative (simulation time),
            stamps count from 0, since those of MCAP are unsigned.

    Raises:
        GroundedError: if the file can't be written or an entry of `meta` is reserved.
    """

    def __init__(
        self,
        target: str | Path | IO[bytes],
        dt: float,
        states: Units,
        inputs: Units,
        meta: Meta,
        *,
        candidate: str = "",
        policy: bytes | None = None,
        start_inputs: Array | None = None,
        start_states: Mapping[str, float] | None = None,
        start_ns: int = 0,
    ) -> None:
        from grounded_trials.formats.mcap_writer import McapWriter

        held = None if start_inputs is None else np.asarray(start_inputs, float).tolist()
        table = stated(
            TRIAL,
            dt,
            states,
            inputs,
            meta,
            candidate=candidate,
            start_inputs=json.dumps(held),
            start_ns=str(int(start_ns)),
            **({"start_states": json.dumps(dict(start_states))} if start_states else {}),
        )
        self._n, self._m, self._start_ns = len(states), len(inputs), start_ns
        self._owned = isinstance(target, str | Path)
        self._stream = _create(Path(target)) if isinstance(target, str | Path) else target
        self._closed = False
        self._log = McapWriter(self._stream)
        self._log.metadata("grounded", table)
        if policy is None:
            self._log.attachment("about", "text/plain", b"A trial; no policy was run.")
        else:
            self._log.attachment("policy", "application/octet-stream", policy)
        self._state = self._log.doubles("/state", "State", list(states))
        self._input = self._log.doubles("/input", "Input", list(inputs))
        self._flushed = max(start_ns, 0)
        self._log.flush()

    def append(self, t: float, state: Array, input: Array | None) -> None:
        """Add the state (n,) at `t` seconds after the start, and the input (m,) sent at that time.

        The last state of a trial has the input None.

        Raises:
            GroundedError: if a shape is wrong, or the file can't be written.
        """
        (data,) = encode_doubles(_row(state, self._n)[None])
        sent = None if input is None else encode_doubles(_row(input, self._m)[None])[0]
        with self._writing():
            self._add(max(self._start_ns, 0) + round(t * 1e9), data, sent)

    def extend(self, trial: Trial) -> None:
        """Add a whole trial, as repeated calls of `append`."""
        states, inputs = encode_doubles(trial.states), encode_doubles(trial.inputs)
        with self._writing():
            for k, (state, input) in enumerate(zip_longest(states, inputs)):
                self._add(max(self._start_ns, 0) + round(k * trial.dt * 1e9), state, input)

    def _add(self, time: int, state: bytes, input: bytes | None) -> None:
        self._log.message(self._state, time, state)
        if input is not None:
            self._log.message(self._input, time, input)
        if time - self._flushed >= FLUSH_NS:
            self._log.flush()
            self._flushed = time

    def close(self) -> None:
        """Finish the file; a second call does nothing.

        Raises:
            GroundedError: if it can't be written, for example on a full disk.
        """
        if not self._closed:
            self._closed = True
            with self._writing():
                self._log.finish()
                if self._owned:
                    self._stream.close()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise unwritable("the trial", error, mend="recover") from None

    def __enter__(self) -> TrialWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def trial_bytes(
    trial: Trial,
    meta: Meta,
    policy: bytes | None = None,
    *,
    state_units: Units | None = None,
    input_units: Units | None = None,
    start_ns: int = 0,
) -> bytes:
    """Return a trial as the bytes of a file; equal arguments give equal bytes.

    `meta` holds the entries besides the reserved ones, `policy` is the file of the candidate that
    was run, units are "1" where missing, and `start_ns` is the absolute time of t = 0 [ns].
    """
    stream = io.BytesIO()
    with TrialWriter(
        stream,
        trial.dt,
        with_units(trial.state_names, state_units),
        with_units(trial.input_names, input_units),
        meta,
        candidate=trial.candidate,
        policy=policy,
        start_inputs=trial.start_inputs,
        start_states=trial.start_states,
        start_ns=start_ns,
    ) as writer:
        writer.extend(trial)
    return stream.getvalue()


def write_trial(
    path: str | Path, trial: Trial, meta: Meta, policy: bytes | None = None, **about: Any
) -> None:
    """Write a whole trial atomically; for the arguments see `trial_bytes`.

    Raises:
        GroundedError: if the file can't be written or an entry of `meta` is reserved.
    """
    write_atomically(Path(path), trial_bytes(trial, meta, policy, **about))


def read_trial(
    source: str | Path | bytes, name: str = "trial"
) -> tuple[Trial, dict[str, str], bytes | None]:
    """Read a trial file.

    Args:
        source: the file's path, or its bytes.
        name: name of the file in messages, if `source` is bytes.

    Returns:
        The trial, whose `id` is the SHA-256 of the file; its metadata; the bytes of the file of
        the candidate that was run, or None.

    Raises:
        GroundedError: if the file is damaged, is not a trial file of grounded's, or has samples off
            its time grid.
    """
    own = read_own(source, name, TRIAL)
    states, inputs = own.names("states"), own.names("inputs")
    dt = own.number("dt")
    x, u = own.doubles("/state", states), own.doubles("/input", inputs)
    if len(x) == 0:
        raise wrong(f"{own.name}: states", x.shape, shape=f"(T + 1, {len(states)})")
    if len(u) == len(x):  # interrupted after the last input, before the resulting state
        u = u[:-1]
    if len(u) != len(x) - 1:
        raise wrong(f"{own.name}: inputs", u.shape, shape=f"({len(x) - 1}, {len(inputs)})")
    for topic in ("/state", "/input"):
        own.check_grid(topic, max(own.integer("start_ns", signed=True), 0), dt)
    held = None
    if own.entry("start_inputs") != "null":
        held = own.floats(own.json("start_inputs", list), "start_inputs", len(inputs))
    begun = own.json("start_states", dict) if "start_states" in own.meta else {}
    known = own.floats([*begun.values()], "start_states", len(begun))
    trial = Trial(
        states=x,
        inputs=u,
        dt=dt,
        state_names=tuple(states),
        input_names=tuple(inputs),
        id=own.sha256,
        candidate=own.meta.get("candidate", ""),
        start_inputs=held,
        start_states=dict(zip(begun, known.tolist(), strict=True)),
    )
    return trial, own.meta, own.attachments.get("policy")


def _row(values: Array, size: int) -> Array:
    row = np.asarray(values, dtype=np.float64)
    of_shape("a row of a trial", row, (size,))
    return row


def _create(path: Path) -> IO[bytes]:
    try:
        return path.open("xb")
    except FileExistsError:
        raise refused("file.exists", path) from None
    except OSError as error:
        raise unwritable(path, error) from None
