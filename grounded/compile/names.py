"""What a user's function receives: named states, inputs and parameters.

`s.v` and `s["v"]` are the same value: a number, an array of samples, or an expression while the
function is traced. An unknown name is the user's slip, so the error names the line that asked for
it and the nearest name that exists.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any, Literal

import numpy as np

from grounded.checks import refused, unknown, wrong
from grounded.errors import GroundedError
from grounded.foreign import contained
from grounded.frozen import Array

_NOT_THE_USER = (str(Path(__file__).parents[1]), str(Path(np.__file__).parent), "<frozen")
STAGES: dict[str, tuple[tuple[float, float], ...]] = {  # (c, b): where and with what weight
    "rk4": ((0.0, 1 / 6), (0.5, 1 / 3), (0.5, 1 / 3), (1.0, 1 / 6)),
    "euler": ((0.0, 1.0),),
}


def integrated(
    rate: Callable[[list[Any]], Sequence[Any]],
    x: list[Any],
    dt: Any,
    integrator: str,
    count: int = 1,
) -> list[Any]:
    """The values x after dt, by `count` equal steps: numbers, arrays, expressions alike.

    `rate` are the values' rates at such values, `integrator` a name in STAGES.
    """
    h = dt / count if count > 1 else dt
    for _ in range(count):
        k, moved = list[Any](), x
        for c, b in STAGES[integrator]:
            at = [xi + c * h * ki for xi, ki in zip(x, k, strict=True)] if c else x
            k = [*rate(at)]
            moved = [m + b * h * ki for m, ki in zip(moved, k, strict=True)]
        x = moved
    return x


Kind = Literal["derivative", "step"]
Integrator = Literal["rk4", "euler"]


class Named(Mapping[str, Any]):
    """Values by attribute and by item, in declared order; also a read-only mapping.

    Args:
        what: "state", "input" or "parameter", for messages.
        names: the names, in order.
        values: one value a name.
    """

    def __init__(self, what: str, names: Sequence[str], values: Sequence[Any]) -> None:
        self.__dict__.update(zip(names, values, strict=True))
        object.__setattr__(self, " what", what)  # a key that no valid name can collide with

    def __getattr__(self, name: str) -> Any:
        """Only reached for a name that does not exist."""
        if name.startswith("__"):
            raise AttributeError(name)
        raise self._unknown(name, sys._getframe(1))

    def __getitem__(self, name: str) -> Any:
        try:
            return self.__dict__[name]
        except (KeyError, TypeError):
            raise self._unknown(name, sys._getframe(1)) from None

    def __setattr__(self, name: str, value: Any) -> None:
        what = self.__dict__[" what"]
        raise refused("model.name_only", line_of(sys._getframe(1)), what=what, name=name)

    def __iter__(self) -> Iterator[str]:
        return (name for name in self.__dict__ if name != " what")

    def __len__(self) -> int:
        return len(self.__dict__) - 1

    def __contains__(self, name: object) -> bool:
        return name in self.__dict__ and name != " what"

    def _unknown(self, name: object, frame: FrameType) -> GroundedError:
        what = self.__dict__[" what"]
        if isinstance(name, int | slice):
            return wrong(
                f"{line_of(frame)}: a {what}", name, must="named", like=f"s.{next(iter(self))}"
            )
        return unknown(what, name, [*self], where=line_of(frame))


@dataclass(frozen=True)
class Signature:
    """What a user's function is called with."""

    function: Callable[..., Mapping[str, Any]]
    kind: Kind
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    params: tuple[str, ...]
    within: tuple[Integrator, int] | None = None  # a step made of so many steps of a derivative
    jacobian: Callable[..., tuple[Any, Any]] | None = None  # the user's own f_x, f_u of a step

    def whole(self, integrator: Integrator, count: int = 1) -> Signature:
        """The same that returns the next state: a derivative, integrated in so many parts."""
        if self.kind == "step":
            return self
        return replace(self, kind="step", within=(integrator, count))

    def steps(self, x: Array, u: Array, p: Array, dt: float) -> Array:
        """The next states (N, n) of a step, called sample by sample; NaN where that is an error."""
        found, values = np.full(x.shape, np.nan), [*map(np.float64, p)]
        for k, (at, sent) in enumerate(zip(x, u, strict=True)):
            try:
                after = self.call(list(at), list(sent), values, np.float64(dt))
            except (ArithmeticError, ValueError):
                continue
            check_names(after, self.states, self.function)
            found[k] = [np.asarray(after[name], float).reshape(-1)[0] for name in self.states]
        return found

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers n, m, k of states, inputs and parameters."""
        return len(self.states), len(self.inputs), len(self.params)

    def call(
        self, x: Sequence[Any], u: Sequence[Any], p: Sequence[Any], dt: Any
    ) -> Mapping[str, Any]:
        """What the function, or a copy of it, returns for n, m and k values and dt."""
        a, parameters = Named("input", self.inputs, u), Named("parameter", self.params, p)
        with contained():
            if self.within is not None:
                return self._integrated(list(x), a, parameters, dt)
            more = (dt,) if self.kind == "step" else ()
            return self.function(Named("state", self.states, x), a, parameters, *more)

    def _integrated(self, x: list[Any], a: Named, p: Named, dt: Any) -> Mapping[str, Any]:
        """The next state by equal steps of Runge-Kutta or Euler within a control step."""
        assert self.within is not None

        def rate(at: list[Any]) -> list[Any]:
            values = self.function(Named("state", self.states, at), a, p)
            check_names(values, self.states, self.function)
            return [*map(values.__getitem__, self.states)]

        return dict(zip(self.states, integrated(rate, x, dt, *self.within), strict=True))


def line_of(frame: FrameType) -> str:
    """file:line of a stack frame."""
    return f"{frame.f_code.co_filename}:{frame.f_lineno}"


def where(function: Any) -> str:
    """file:line where a callable is defined, or its representation when Python can't tell."""
    function = getattr(function, "func", function)  # functools.partial
    function = getattr(function, "__wrapped__", function)
    if not hasattr(function, "__code__"):  # a bound method, or an object with __call__
        function = getattr(function, "__func__", getattr(type(function), "__call__", None))  # noqa: B004
    code = getattr(function, "__code__", None)
    return f"{code.co_filename}:{code.co_firstlineno}" if code is not None else repr(function)


def raised_at(error: BaseException, function: Any) -> str:
    """file:line of the deepest frame of `error` in the user's code."""
    trace, found = error.__traceback__, where(function)
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        if not file.startswith(_NOT_THE_USER):
            found = f"{file}:{trace.tb_lineno}"
        trace = trace.tb_next
    return found


def check_names(values: Any, states: Sequence[str], function: Any) -> None:
    """Whether a function returned a dict of exactly the states."""
    if not isinstance(values, Mapping):
        kind = type(values).__name__
        raise refused("model.returns", where(function), type=kind, states=tuple(states))
    if values.keys() == {*states}:
        return
    extra = [name for name in values if name not in states]
    if extra:
        raise unknown("state", extra[0], states, "the model", where(function))
    missing = [name for name in states if name not in values]
    if missing:
        raise refused("model.returns", where(function), missing=tuple(missing))


def wrong_value(name: str, value: Any, function: Any) -> GroundedError:
    """The error for a returned state that is not one real number."""
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.asarray(None)
    if array.dtype.kind == "c":
        found = f"a complex number ({value})"
    elif array.size != 1:
        found = f"an array of shape {array.shape}"
    elif array.dtype.kind == "O":
        found = f"{type(value).__name__} ({value!r})"
    else:
        found = f"{value!r}"
    return wrong(f"{where(function)}: state '{name}' that is returned", got=found, must="real")
