"""The path that always works: the user's function, called; its derivatives, differenced.

The function is first given arrays of N samples a name. One that can't take them (an `if` on a
state, `math.sin`, a simulator) is called sample by sample; a function that takes them but mixes
the samples up is found out by comparing a few samples with single calls.

Central differences with a step h = 6e-6 max(1, |x|) (the cube root of the machine's precision)
are good to about 1e-10 of the function's scale; all 2 (n + m) shifted points go in one call. A
function that computes in single precision would lose all its digits at that step: it is found out
by outputs that are float32 numbers, and stepped by h = 5e-3 max(1, |x|).
At a limit of the inputs the differences are taken inwards (`stencil`): what lies beyond, the
function may clamp, and a plan that saturates would see half of the slope or none.
`smoothing` is ignored here: what can't be traced can't be smoothed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from grounded.checks import refused, wrong
from grounded.compile.names import Named, check_names, raised_at, where, wrong_value
from grounded.compile.problem import Samples
from grounded.compile.run.interpreted import RELATIVE_STEP, System
from grounded.errors import GroundedError
from grounded.foreign import contained
from grounded.frozen import Array

SINGLE_STEP = float(np.cbrt(np.finfo(np.float32).eps))
WRONG = 1e-2  # share of the largest by which a given derivative may differ from differences
SLOW = (
    "; it can't take arrays of samples either and is called one sample at a time: planning takes "
    "seconds to minutes (np.where in place of `if` and np.sin in place of math.sin mend it)"
)
SINGLE = (
    "; it computes in single precision (float32): derivatives are differenced with steps of 0.5 % "
    "and good to four digits (float64 inside it mends it; in JAX, "
    "jax.config.update('jax_enable_x64', True))"
)


class DifferencedSystem(System):
    """Any Python callable as a System."""

    how = "differenced"

    _batches = True  # until the function fails on arrays
    _calls = 0
    _step = 0.0  # of the differences, relative; 0: not known yet

    def evaluate(self, x: Array, u: Array, p: Array, dt: float, smoothing: float) -> Array:
        """The function at N samples."""
        x, u = np.asarray(x, float), np.asarray(u, float)
        if len(x) > 1 and self._batches:
            result = self._batch(x, u, p, dt)
            if result is not None:
                return result
            self._batches = False
            self.note += SLOW
        return np.array([self._single(a, b, p, dt) for a, b in zip(x, u, strict=True)]).reshape(
            len(x), len(self.signature.states)
        )

    def check(self, x: Array, u: Array, p: Array, dt: float) -> None:
        """Compares derivatives that come with the model with differences, at three samples.

        Not those that are differences themselves (`Stepper.differenced`).
        At a kink, such as a limit of an input, those of either side or between them are right.
        """
        own = self.signature.jacobian
        if own is None or getattr(self.signature.function, "differenced", False):
            return
        at = np.unique(np.linspace(0, len(x) - 1, 3).astype(int))
        given = self._given(x[at], u[at], p, dt)
        both, free = np.concatenate([x[at], u[at]], axis=1), np.full(self.n + self.m, np.inf)
        relative, how = self._relative_step(x[at], u[at], p, dt), (p, dt, 0.0)
        ends = (both, free), (-free, both)
        sides = [self._slopes_at(both, how, relative, *some) for some in ends]
        off = np.abs(given - np.clip(given, np.minimum(*sides), np.maximum(*sides)))
        if off.max(initial=0.0) > WRONG * np.abs(sides).max(initial=1e-9):
            _, i, j = np.unravel_index(int(np.argmax(off)), off.shape)
            by = (*self.signature.states, *self.signature.inputs)[j]
            raise refused("model.differs", where(own), state=self.states[i], by=by, off=off.max())

    def inverse(self, x: Array, after: Array, p: Array, dt: float) -> Array | None:
        """See `System.inverse`; the function may have one, as simulators do."""
        known = getattr(self.signature.function, "inverse", None)
        return None if known is None else known(x, after, p, dt)

    def jacobian(self, at: Samples, width: int) -> Array:
        """See `System.jacobian`; by central differences.

        Where derivatives come with the model, those by a parameter are taken to one side: half the
        steps, and none with a friction below zero.
        """
        x, u, p, dt, *_ = at
        relative, shifted = self._relative_step(x, u, p, dt), self.n + self.m
        if self.signature.jacobian is None:
            return self.differences(at, width, relative)
        J = np.empty((len(x), self.n, width))
        J[:, :, :shifted] = self._given(x, u, p, dt)
        base = self.step(x, u, p, dt) if width > shifted else x
        for i in range(width - shifted):
            up = np.array(p, float)
            up[i] += relative * max(1.0, abs(p[i]))
            J[:, :, shifted + i] = (self.step(x, u, up, dt) - base) / (up[i] - p[i])
        return J

    def _relative_step(self, x: Array, u: Array, p: Array, dt: float) -> float:
        """The step that fits the precision in which the function computes.

        Two samples that are no float32 numbers: an output that is one at both, and not the same
        twice, was rounded.
        """
        if not self._step and len(x):
            near = 1.0 + np.array([[1.234567e-3], [2.718281e-3]]) / np.pi
            some = (x[:1] * near + (near - 1), u[:1] * near + (near - 1))
            found = self.evaluate(*some, p, dt, 0.0)
            rounded = (found == found.astype(np.float32)).all(axis=0) & (found[0] != found[1])
            single = np.isfinite(found).all() and rounded.any()
            self._step = SINGLE_STEP if single else RELATIVE_STEP
            self.note += SINGLE * bool(single)
        return self._step or RELATIVE_STEP

    def _given(self, x: Array, u: Array, p: Array, dt: float) -> Array:
        """The user's own derivatives [f_x f_u], (N, n, n + m): of arrays, or one by one."""
        own, names = self.signature.jacobian, self.signature
        assert own is not None
        parameters = Named("parameter", names.params, np.asarray(p, float).tolist())

        def call(xs: Sequence[Any], us: Sequence[Any]) -> Array:
            s, a = Named("state", names.states, xs), Named("input", names.inputs, us)
            with contained():
                f_x, f_u = own(s, a, parameters, dt)
            return np.concatenate([np.asarray(f_x, float), np.asarray(f_u, float)], axis=-1)

        shape = (len(x), self.n, self.n + self.m)
        try:
            found = call([*x.T], [*u.T]) if len(x) > 1 else None
        except Exception:  # it takes one sample at a time
            found = None
        if found is not None and found.shape == shape:
            return found
        try:
            return np.array([call([*s], [*a]) for s, a in zip(x, u, strict=True)]).reshape(shape)
        except Exception as error:
            shapes = f"({self.n}, {self.n}), ({self.n}, {self.m})"
            raise wrong(f"{where(own)}: jacobian", got=str(error), shape=shapes) from error

    def _batch(self, x: Array, u: Array, p: Array, dt: float) -> Array | None:
        """The function on arrays of samples; None when it can't take them."""
        self._calls += 1
        try:
            values = self._call([*x.T], [*u.T], p, dt)
            result = np.empty((len(x), len(self.signature.states)))
            for i, name in enumerate(self.signature.states):
                result[:, i] = np.broadcast_to(np.asarray(values[name], float), len(x))
        except Exception:  # whatever it is, the call on one sample tells the user
            return None
        if self._calls & (self._calls - 1):
            return result
        for i in (0, len(x) - 1):  # calls 1, 2, 4, 8 ... : do samples stay apart?
            alone = self._single(x[i], u[i], p, dt)
            if not np.allclose(alone, result[i], rtol=1e-9, atol=1e-9, equal_nan=True):
                return None
        return result

    def _single(self, x: Array, u: Array, p: Array, dt: float) -> Array:
        """The function on one sample; NaN where it leaves the finite numbers."""
        if not (np.isfinite(x).all() and np.isfinite(u).all()):
            return np.full(len(self.signature.states), np.nan)
        try:
            values = self._call(x.tolist(), u.tolist(), p, dt)
        except ArithmeticError:
            return np.full(len(self.signature.states), np.nan)
        except ValueError as error:
            if "math domain error" in str(error) or "nonnegative input" in str(error):
                return np.full(len(self.signature.states), np.nan)
            raise self._failure(error) from error
        except GroundedError:
            raise
        except Exception as error:
            raise self._failure(error) from error
        return np.array([self._number(name, values[name]) for name in self.signature.states])

    def _call(self, x: Sequence[Any], u: Sequence[Any], p: Array, dt: float) -> Mapping[str, Any]:
        with np.errstate(all="ignore"):
            values = self.signature.call(x, u, np.asarray(p, float).tolist(), dt)
        check_names(values, self.signature.states, self.signature.function)
        return values

    def _number(self, name: str, value: Any) -> float:
        try:
            array = np.asarray(value)
            if array.size == 1 and array.dtype.kind in "fiub":
                return float(array.reshape(()))
        except Exception:  # ragged lists and stranger things are described below
            array = np.asarray(None)
        raise wrong_value(name, value, self.signature.function)

    def _failure(self, error: Exception) -> GroundedError:
        line = raised_at(error, self.signature.function)
        called = isinstance(error, TypeError) and "positional argument" in str(error)
        why = f"{type(error).__name__}: {error}"
        return refused("model.fails", line, why=why, called=called)
