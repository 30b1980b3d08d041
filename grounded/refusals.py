"""Errors about what a user gives, as findings; without NumPy, for what must start fast.

`checks` has the checks that raise them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from grounded.errors import COMPARED, GroundedError, alike
from grounded.findings import Weight, found

MOST_NAMES = 12  # most names listed in a message; of more the nearest ones


def refused(code: str, *about: object, then: Any = None, **facts: Any) -> GroundedError:
    """Return the error of a finding; facts that are None are left out."""
    names = [str(one) for one in about]
    return GroundedError(found(code, *names, then=then, weight=Weight.REFUSE, **facts))


def wrong(
    name: str, given: object = None, got: str | None = None, **expected: Any
) -> GroundedError:
    """Return an error about a value that was given.

    Args:
        name: the argument or key.
        given: the value that was found, None if there is none.
        got: what was found instead of that, in words.
        **expected: facts of the entry `given.value`: `must` (a word of it), `type`, `shape`, `low`,
            `high`, `choices`, `like` (an example), `of` (the object that it belongs to).
    """
    text = got or (None if given is None else f"{given!r:.60}")
    expected = {"form": expected["like"]} if [*expected] == ["like"] else expected
    facts = {key: _text(value) for key, value in expected.items()}
    return refused("given.value", name, given=text, **facts)


def _text(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value) if isinstance(value, int) else value


def unknown(
    kind: str, name: object, valid: Iterable[str], of: str = "", where: str = ""
) -> GroundedError:
    """Return an error about a name that is not among those that exist.

    `kind` is what it should name, such as "state", `of` what has those, such as "model 'car'".
    """
    place = {"where": where} if where else {}
    return refused("given.name", name, kind=kind, of=of, **place, **near(str(name), valid))


def near(name: str, valid: Iterable[str]) -> dict[str, Any]:
    """Return the nearest valid name as the fact `near`, or all, or the nearest, as `known`."""
    names = [str(one) for one in valid]
    if close := alike(name, names):
        return {"near": close}
    if len(names) <= MOST_NAMES:
        return {"known": tuple(names)}
    from difflib import get_close_matches

    some = get_close_matches(name, names[:COMPARED], n=MOST_NAMES // 3, cutoff=0.0)
    return {"known": (*some, f"{len(names) - len(some)} more")}
