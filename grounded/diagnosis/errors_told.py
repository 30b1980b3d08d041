"""Which held-out prediction errors are told: the horizon, the states, whether they are noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from grounded.diagnosis.error_report import AT_MOST, Remainder, RulerRow, doubt_of, furthest
from grounded.diagnosis.levels import HALF, SHOWS
from grounded.findings import Finding, Quantity, found

if TYPE_CHECKING:
    from grounded.diagnosis.parts import Agreement

STATES = 2  # whose errors are told
TINY = 1e-12  # an error that stands in for none


def telling(rows: Sequence[RulerRow]) -> RulerRow | None:
    """Return the row to report: the longest horizon, or whole trials if the plant is slow.

    A heating process, for example, moves so little within 1 s that any model predicts it well.
    """
    ahead, whole = furthest(rows), _whole(rows)
    if ahead and whole and _most(ahead) < HALF < _most(whole):
        return whole
    return ahead


def states_told(row: RulerRow, tracked: Sequence[str] = ()) -> list[str]:
    """Return the states whose errors are told, best first.

    They are those that improve enough to show, tracked ones first. If none does, it is the one that
    is furthest off for its noise.

    Args:
        row: the errors.
        tracked: the states that the task follows, the most important first.
    """
    gains = {name: gain for name, gain in gains_of(row).items() if gain > SHOWS}
    order = {name: k for k, name in enumerate(tracked)}
    best = sorted(gains, key=lambda n: (order.get(n, len(tracked)), -gains[n]))[:STATES]
    return best or [name for name in [most_off(row)] if name]


def changes(row: RulerRow) -> dict[str, float]:
    """Return by how much the logarithm of each state's error grows; within the noise it does not.

    States without an error are left out, as are those whose prediction diverged before.
    """
    found = {}
    for name, before in row.crude.items():
        now, floor = row.with_effects.get(name, math.nan), row.noise_floor.get(name, 0.0)
        if before > 0 and math.isfinite(now) and row.tells(name, "crude"):
            found[name] = math.log(max(now, floor, TINY) / max(before, floor, TINY))
    return found


def gains_of(row: RulerRow) -> dict[str, float]:
    """Return the share of each state's error that is gone, negative if it grew."""
    return {name: 1 - math.exp(change) for name, change in changes(row).items()}


def lost_most(rows: Sequence[RulerRow]) -> tuple[RulerRow, str] | None:
    """Return the row and the state whose error grows most; None if none grows so that it shows.

    Whole trials come first if they lose over all states, as they are what a plan is made for.
    """
    rows = [row for row in rows if not row.drowned]
    for some in ([row for row in rows if row.whole_trial and _loses(row)], rows):
        losses = [(change, row, name) for row in some for name, change in changes(row).items()]
        most, row, name = max(losses, key=lambda loss: loss[0], default=(0.0, None, ""))
        if row is not None and most > math.log(1 + SHOWS):
            return row, name
    return None


def outweighed(rows: Sequence[RulerRow]) -> bool:
    """Check whether the states that get worse lose more than the other states gain."""
    lost = lost_most(rows)
    return lost is not None and _loses(lost[0])


def objection(
    rows: Sequence[RulerRow],
    agreement: Sequence[Agreement],
    effects: Sequence[str],
    ties: Sequence[Sequence[str]] = (),
    left: Sequence[Remainder] = (),
) -> Finding | None:
    """Return why adopting the claimed effects is unwise; None if it is not.

    It is if predictions lose more than they gain, or get worse somewhere while the trials disagree
    about the effects' values; also if they gain little beside a gap that remains, and all of them
    tie with others or the gap is wide.

    Args:
        rows: held-out prediction errors, a row per horizon.
        agreement: whether the trials agree on each value.
        effects: the claimed effects.
        ties: groups of effects that further trials could tell apart.
        left: the leftovers beside them.
    """
    if not effects:
        return None
    if outweighed(rows):
        return found("gap.next.doubt", *effects, why="worse")
    gap, wide = any(one.above for one in left), any(one.wide for one in left)
    tied = all(any(name in group for group in ties) for name in effects)
    if gap and (wide or tied) and _gains_little(rows):
        return found("gap.next.doubt", *effects, why="little")
    differ = {one.effect for one in agreement if not one.agrees} & {*effects}
    if not differ or lost_most(rows) is None:
        return None
    return found("gap.next.doubt", *(name for name in effects if name in differ), why="disagree")


def excess(rows: Sequence[RulerRow]) -> tuple[float, str, RulerRow] | None:
    """Return (error / noise, state, row) of the error furthest above the noise; None if none is."""
    each = [(o, name, row) for row in rows if not row.drowned for name, o in above(row).items()]
    clear = [one for one in each if doubt_of(one[2].floor_unsure) < one[0] < math.inf]
    return max(clear, key=lambda one: one[0], default=None)


def above(row: RulerRow) -> dict[str, float]:
    """Return each state's error relative to its noise; infinite if that is not known."""
    known = {n: e for n, e in row.with_effects.items() if math.isfinite(e)}
    floors = {n: row.noise_floor.get(n, 0.0) for n in known if row.tells(n, "with_effects")}
    return {n: known[n] / floor if floor > 0 else math.inf for n, floor in floors.items()}


def most_off(row: RulerRow) -> str:
    """Return the state with the largest error relative to its noise; "" if none was measured."""
    off = above(row)
    return max(off, key=lambda name: (off[name], row.with_effects[name]), default="")


def open_noise(rows: Sequence[RulerRow]) -> str:
    """Return the state whose error may be noise, for lack of repeats; "" if that is known."""
    row = furthest([row for row in rows if row.floor_at_most])
    return "" if row is None or excess(rows) else most_off(row)


def noise_unknown(row: RulerRow, names: Sequence[str]) -> bool:
    """Check whether only an upper bound of the noise is known, and errors may be within it."""
    if row.floor_from == AT_MOST:
        return True
    off = above(row)
    return row.floor_at_most and any(off.get(name, 0.0) <= doubt_of(0.0) for name in names)


def errors(row: RulerRow, name: str, **columns: str) -> dict[str, Any]:
    """Return the errors of a state as facts, by slot: columns of the row, such as now="crude"."""
    unit = row.unit_by_channel.get(name, "")
    values = {slot: getattr(row, column).get(name, math.nan) for slot, column in columns.items()}
    return {slot: Quantity(value, unit) for slot, value in values.items() if math.isfinite(value)}


def _whole(rows: Sequence[RulerRow]) -> RulerRow | None:
    """Return the row of whole trials; None if noise alone exceeds everything measured in less."""
    if any(row.drowned for row in rows):
        return None
    return next((row for row in rows if row.whole_trial), None)


def _most(row: RulerRow) -> float:
    return max(gains_of(row).values(), default=0.0)


def _loses(row: RulerRow) -> bool:
    """Check whether the errors of a row grow, over all states."""
    return sum(changes(row).values()) > 0


def _gains_little(rows: Sequence[RulerRow]) -> bool:
    """Check whether the mean share of the error that is gone a horizon ahead does not show."""
    row = furthest(rows)
    gains = [] if row is None else [*gains_of(row).values()]
    return bool(gains) and sum(gains) < SHOWS * len(gains)
