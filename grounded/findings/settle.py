"""settle: which findings are told, and in which order."""

from __future__ import annotations

import math
from collections.abc import Iterable
from fnmatch import fnmatchcase

from grounded.findings.catalogue import entry_of
from grounded.findings.finding import Finding, Weight

ORDER = list(Weight)  # the heaviest first


def settle(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings to tell, the heaviest first, then those with most evidence.

    One that is only a consequence of another, as that one's entry says (`hides`), is left out if
    both are about the same signal or trial, or one of them is about none. What stands there twice
    is told once, with its heaviest weight.
    """
    once = dict[tuple[str, tuple[str, ...]], Finding]()
    for one in findings:
        known = once.setdefault((one.code, one.about), one)
        if ORDER.index(one.weight) < ORDER.index(known.weight):
            once[one.code, one.about] = one
    kept = [
        one
        for one in once.values()
        if not any(_hides(other, one) for other in once.values() if other is not one)
    ]
    return tuple(sorted(kept, key=_rank))


def _rank(one: Finding) -> tuple[int, float]:
    return ORDER.index(one.weight), -one.nats if math.isfinite(one.nats) else 0.0


def _hides(one: Finding, other: Finding) -> bool:
    """Return whether a finding is told by another already."""
    shared = not one.about or not other.about or bool({*one.about} & {*other.about})
    return shared and any(fnmatchcase(other.code, code) for code in entry_of(one.code).hides)
