"""Random calls of the runner that a robot uses, and files that ask it for gigabytes."""

from __future__ import annotations

import importlib.util
import io
import random
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

STEPS, DT = 20, 0.05


class Raises:
    """An object whose methods raise an exception, whichever of them is used."""

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def _raise(self, *_: Any, **__: Any) -> Any:
        raise self.error

    __array__ = __float__ = __len__ = __iter__ = __getitem__ = __index__ = __bool__ = _raise
    __eq__ = __lt__ = __gt__ = __truediv__ = __add__ = __sub__ = __rsub__ = _raise  # type: ignore[assignment]
    __hash__ = None  # type: ignore[assignment]


class Returns:
    """An object that converts itself to something else."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __array__(self, *_: Any, **__: Any) -> Any:
        return self.value

    def __float__(self) -> Any:
        return self.value


def arrays(n: int, m: int, rng: random.Random, *, feedback: bool) -> dict[str, Any]:
    """Return the arrays of an exported policy."""
    depths = [rng.randint(1, 3) for _ in range(m)]
    nz, draw = n + sum(depths), np.random.RandomState(rng.randrange(2**31))
    scale = rng.choice((1.0, 1e-300, 1e150, 1e300))
    found = {
        "format": "grounded-policy-1",
        "feedforward": draw.normal(size=(STEPS, m)) * rng.choice((1.0, 1e300)),
        "low": -np.abs(draw.normal(size=m)) - 0.1,
        "high": np.abs(draw.normal(size=m)) + 0.1,
        "past": draw.normal(size=m) * 3,
        "dt": DT,
        "state_names": np.array(["x%d" % i for i in range(n)]),
        "input_names": np.array(["u%d" % i for i in range(m)]),
        "depths": np.array(depths),
        "angles": np.array([rng.random() < 0.5 for _ in range(n)]),
    }
    if feedback:
        found["gain"] = draw.normal(size=(STEPS, m, nz)) * scale
        found["reference"] = draw.normal(size=(STEPS, nz)) * scale
    return found


@dataclass
class Found:
    """What random calls led to."""

    calls: int = 0
    used: int = 0  # calls whose state and time were used
    raised: Counter = field(default_factory=Counter)  # type: ignore[type-arg]
    outside: list[str] = field(default_factory=list)


def fuzz(runner: Path, folder: Path, calls: int, seed: int) -> Found:
    """Call `action` and `done` with random things, NumPy's errors and all warnings raised."""
    spec = importlib.util.spec_from_file_location("fuzzed_onboard", runner)
    assert spec is not None and spec.loader is not None
    onboard = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(onboard)
    rng, found, path = random.Random(seed), Found(), folder / "fuzzed.npz"
    with np.errstate(all="raise"), warnings.catch_warnings():
        warnings.simplefilter("error")
        while found.calls < calls:
            n = rng.randint(1, 4)
            fields = arrays(n, rng.randint(1, 3), rng, feedback=rng.random() < 0.8)
            np.savez(path, **fields)
            run = onboard.load(path)
            low, high = run.policy.low.copy(), run.policy.high.copy()
            for k in range(rng.randint(1, 40)):
                t, s = _time(rng, k), _state(rng, n)
                found.calls += 1
                try:
                    u = run.action(t, s)
                    run.done(t)
                except BaseException as error:
                    found.raised[type(error).__name__] += 1
                    continue
                if not (u.shape == low.shape and ((low <= u) & (u <= high)).all()):
                    found.outside.append("%r for a state of type %s" % (u, type(s).__name__))
                if rng.random() < 0.1:
                    u[:] = np.nan  # it belongs to the caller
            found.used += k + 1 - run.blind
    return found


ODD = (0, -0.0, 1e-320, 1e300, -1e308, float("nan"), float("inf"), -float("inf"), 10**400, 1j)
ODD += (None, "1", "nan", b"1", True, [], {}, object(), np.ma.masked, np.datetime64("now"))  # type: ignore[assignment]
ERRORS = (ValueError, TypeError, RuntimeError, KeyError, MemoryError, RecursionError, OSError)
ERRORS += (ZeroDivisionError, OverflowError, StopIteration, AssertionError, UserWarning)  # type: ignore[assignment]


def _odd(rng: random.Random) -> Any:
    how = rng.randrange(6)
    if how == 0:
        return Raises(rng.choice(ERRORS)("no"))
    if how == 1:
        return Returns(rng.choice(ODD))
    if how == 2:
        return np.array(rng.choice(ODD[:8]))
    return rng.choice(ODD)


def _time(rng: random.Random, k: int) -> Any:
    how = rng.random()
    if how < 0.7:
        return k * DT * rng.choice((1.0, 1.0, 0.7, 1.6))
    if how < 0.8:
        return rng.choice((np.float32, np.int64, np.array, str))(k)
    return _odd(rng)


def _state(rng: random.Random, n: int) -> Any:
    how = rng.random()
    plain = [rng.gauss(0, 1) * rng.choice((1.0, 1.0, 1e150, 1e308)) for _ in range(n)]
    if how < 0.4:
        return plain
    if how < 0.6:
        kind = rng.choice(("f4", "f8", "f2", "i1", "u8", "c8", "O", "U9", "S9", "?", "M8[s]"))
        return np.array([rng.randint(0, 1) for _ in range(n)]).astype(kind)
    if how < 0.7:
        return np.ma.array(plain, mask=[rng.random() < 0.3 for _ in range(n)])
    if how < 0.8:
        plain[rng.randrange(n)] = _odd(rng)
        return rng.choice((list, tuple, iter))(plain)
    if how < 0.85:
        return Returns(np.array(plain[: rng.randint(0, n)]))
    return _odd(rng)


# --- files ---------------------------------------------------------------------------------------


def _with(kind: int = zipfile.ZIP_DEFLATED, **changes: Any) -> bytes:
    """Return an exported policy in which arrays are replaced, by arrays or by their bytes."""
    fields = {**arrays(2, 1, random.Random(0), feedback=True), **changes}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", kind) as archive:
        for name, value in fields.items():
            part = io.BytesIO()
            if isinstance(value, bytes):
                part.write(value)
            else:
                np.save(part, np.asarray(value))
            archive.writestr(name + ".npy", part.getvalue())
    return out.getvalue()


def _claims(shape: str, kind: str = "<f8") -> bytes:
    """Return an array that states a shape, and has no values."""
    head = "{'descr': '%s', 'fortran_order': False, 'shape': %s}" % (kind, shape)
    text = head.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def _many_parts() -> bytes:
    out = io.BytesIO(_with())
    with zipfile.ZipFile(out, "a") as archive:
        for i in range(30000):
            archive.writestr("a%d.npy" % i, b"")
    return out.getvalue()


HOSTILE: dict[str, Callable[[], bytes]] = {
    "zeros": lambda: _with(feedforward=np.zeros((2**25, 1))),
    "zeros of a byte": lambda: _with(feedforward=np.zeros((2**27, 1), np.int8)),
    "zeros, bz2": lambda: _with(zipfile.ZIP_BZIP2, gain=np.zeros((2**22, 1))),
    "a claimed size": lambda: _with(feedforward=_claims("(1000000000, 1)")),
    "a size beyond the address space": lambda: _with(gain=_claims("(%s, 1, 3)" % ("9" * 40))),
    "a negative size": lambda: _with(low=_claims("(-1,)")),
    "deep queues": lambda: _with(depths=np.array([10**9])),
    "many names": lambda: _with(state_names=np.zeros(2**24, "U1")),
    "long names": lambda: _with(state_names=np.zeros(100, "U999999")),
    "many depths": lambda: _with(depths=np.ones(2**24, np.int8)),
    "complex numbers": lambda: _with(feedforward=np.ones((STEPS, 1)) * 1j),
    "infinite limits": lambda: _with(low=np.array([-np.inf]), high=np.array([np.inf])),
    "Python objects": lambda: _with(past=_claims("(1,)", "|O")),
    "30,000 parts": _many_parts,
}
