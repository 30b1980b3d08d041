"""Checks of what a user gives: a number, a name, a shape, a type.

Each returns quietly or raises a `GroundedError` with a finding `given.value` or `given.name`: what
was found, what was expected, and the nearest name. The messages stand in the catalogue.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np

from grounded.frozen import readonly
from grounded.refusals import near as near
from grounded.refusals import refused as refused
from grounded.refusals import unknown as unknown
from grounded.refusals import wrong as wrong

T = TypeVar("T")


def known(
    kind: str, names: Iterable[str], valid: Iterable[str], of: str = "", where: str = ""
) -> None:
    """Check that names are among those that exist."""
    there = list(valid)
    for name in names:
        if name not in there:
            raise unknown(kind, name, there, of, where)


def of_type(name: str, value: T, *types: type) -> T:
    """Return a value that is of one of the types."""
    if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
        wants = " or ".join(one.__name__ for one in types)
        raise wrong(name, got=f"a {type(value).__name__}", type=wants)
    return value


def list_of(values: Iterable[Any], kind: type | tuple[type, ...], name: str) -> list[Any]:
    """Return a collection as a list, whose elements must all be of a type."""
    given, kinds = f"a {type(values).__name__}", kind if isinstance(kind, tuple) else (kind,)
    if isinstance(values, Iterable) and not isinstance(values, str):
        items = list(values)
        other = [type(one).__name__ for one in items if not isinstance(one, kinds)]
        if not other:
            return items
        given = f"{given} of {other[0]}"
    raise wrong(name, got=given, type=f"list of {kinds[0].__name__}s")


def positive(name: str, value: Any) -> None:
    """Check that a value is a positive, finite number."""
    if not isinstance(value, int | float | np.number) or not (np.isfinite(value) and value > 0):
        raise wrong(name, value, must="positive")


def whole_number(name: str, value: Any, low: int, high: int) -> None:
    """Check that a value is a whole number from `low` to `high`."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not low <= value <= high:
        raise wrong(name, value, must="whole", low=low, high=high)


def one_of(name: str, value: object, valid: Iterable[str]) -> None:
    """Check that a value is one of the choices."""
    choices = [*valid]
    if value not in choices:
        raise wrong(name, value, **near(str(value), choices))


def numbers(values: Any, name: str) -> Any:
    """Return an array of numbers as a read-only array of floats."""
    try:
        return readonly(values)
    except (TypeError, ValueError):
        raise wrong(name, values, must="numbers") from None


def of_shape(name: str, array: Any, shape: tuple[int, ...], **facts: Any) -> None:
    """Check the shape of an array."""
    if np.shape(array) != shape:
        raise wrong(name, np.shape(array), shape=str(shape), **facts)


def same_names(name: str, what: str, given: Iterable[str], own: Iterable[str]) -> None:
    """Check that a trial has the states or inputs of the model, in its order."""
    theirs, ours = tuple(given), tuple(own)
    if theirs != ours:
        order = int(sorted(theirs) == sorted(ours)) or None
        facts: dict[str, Any] = {"what": what, "theirs": theirs, "own": ours, "order": order}
        raise refused("given.fit", name, **facts)


def same_dt(name: str, given: float, own: float) -> None:
    """Check that a trial has the time step [s] of the task, or of the other trials."""
    if abs(given - own) > 1e-9 * own:
        facts = {"what": "dt", "theirs": f"{given:g} s", "own": f"{own:g} s"}
        raise refused("given.fit", name, **facts)


def finite(name: str, values: Any) -> None:
    """Check that all numbers are finite."""
    if not np.isfinite(values).all():
        raise wrong(name, np.asarray(values).tolist(), must="finite")
