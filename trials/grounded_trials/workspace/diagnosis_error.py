"""What reports/diagnosis.json says of the error itself: its parts, its noise, the utility, doubles.

The newer keys of the document (`where.split`, `where.whiteness`, `utility_prediction`,
`lookalikes`), read with the same care as the others: what is missing is left empty.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

WHITE = 0.01  # p-value below which what is left is no longer taken for white noise
HORIZONS = {"one_step": "one step", "horizon": "{}", "whole_run": "whole run ({})"}


@dataclass(frozen=True)
class Parts:
    """A mean squared error in three parts that sum to 1; `channel` is "" for all of them."""

    channel: str
    explained: float
    unexplained: float
    irreducible: float


@dataclass(frozen=True)
class Split:
    """The error a while ahead: of all channels, each in units of its noise, and of each."""

    key: str  # one_step, horizon, whole_run
    ahead: str  # "one step", "1 s", "whole run (3 s)"
    whole: Parts
    channels: tuple[Parts, ...]
    from_repeats: bool  # the irreducible part was measured on repeated trials


@dataclass(frozen=True)
class UtilityPrediction:
    """Rms error of predicted utilities of whole trials, without and with the effects."""

    trials: int
    before: float  # NaN: the predicted run diverged
    after: float
    spread: float  # standard deviation of the real utilities


@dataclass(frozen=True)
class Likeness:
    """Another effect that makes most of a claimed effect's signal."""

    effect: str
    like: str
    share: float


def splits(table: Mapping[str, Any] | None) -> tuple[Split, ...]:
    """The horizons of `where.split`, nearest first."""
    found = []
    for key, words in HORIZONS.items():
        entry = (table or {}).get(key)
        if not entry:
            continue
        found.append(
            Split(
                key,
                words.format(f"{number(entry.get('horizon_s')):.3g} s"),
                _parts("", entry["all"]),
                tuple(_parts(str(c["name"]), c) for c in entry.get("channels") or ()),
                entry.get("irreducible_from") == "repeats",
            )
        )
    return tuple(found)


def _parts(name: str, entry: Mapping[str, Any]) -> Parts:
    keys = ("explained", "unexplained", "irreducible")
    return Parts(name, *(number(entry.get(key)) for key in keys))


def white(table: Mapping[str, Any] | None) -> tuple[tuple[str, float], ...]:
    """p-values of `where.whiteness` by channel."""
    return tuple((str(name), number(p)) for name, p in (table or {}).items())


def coloured(whiteness: tuple[tuple[str, float], ...]) -> list[str]:
    """Channels whose rest is no white noise, the clearest first."""
    clear = sorted((p, name) for name, p in whiteness if p < WHITE)
    return [name for _, name in clear]


def utility(entry: Mapping[str, Any] | None) -> UtilityPrediction | None:
    """`utility_prediction`; None where no whole trial was there to predict."""
    if not entry or not entry.get("trials"):
        return None
    values = (number(entry.get(key)) for key in ("before", "after", "spread"))
    return UtilityPrediction(int(entry["trials"]), *values)


def likenesses(entries: Any) -> tuple[Likeness, ...]:
    """`lookalikes`."""
    return tuple(
        Likeness(str(one["effect"]), str(one["like"]), number(one.get("share")))
        for one in entries or ()
    )


def number(value: Any) -> float:
    """A number, or NaN for null."""
    return math.nan if value is None else float(value)
