"""Which held-out prediction errors are told: the horizon, the states, whether they are noise."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from grounded.diagnosis.error_report import AT_MOST, Remainder, RulerRow, doubt_of, furthest
from grounded.findings import Finding, Quantity, found

if TYPE_CHECKING:
    from grounded.diagnosis.parts import Agreement

HALF, MORE = 0.5, 0.2  # improvements: below HALF 1 s ahead and MORE of it over whole trials
LITTLE = 0.1  # mean share of the errors below which a claim that ties gains too little to adopt
SHOWS = 0.1  # relative change below which a channel is not named
COUNTS = 0.03  # relative change below which a loss is not compared with gains elsewhere
STATES = 2  # whose errors are told


def telling(rows: Sequence[RulerRow]) -> RulerRow | None:
    """Return the row to report: the longest horizon, or whole trials if the plant is slow.

    A heating process, for example, moves so little within 1 s that any model predicts it well.
    """
    ahead, whole = furthest(rows), _whole(rows)
    if ahead and whole and _most(ahead) < HALF and _most(whole) > _most(ahead) + MORE:
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


def gains_of(row: RulerRow) -> dict[str, float]:
    """Return the share of each channel's error that is gone, without diverging predictions."""
    told = {n: e for n, e in row.crude.items() if row.tells(n, "crude", "with_effects")}
    return {n: 1 - row.with_effects[n] / e for n, e in told.items() if e > 0}


def lost_most(rows: Sequence[RulerRow]) -> tuple[float, RulerRow | None, str]:
    """Return (factor, row, channel) of the channel whose error grows most.

    Whole trials come first if they lose over all states, as they are what a plan is made for.
    """
    last, ahead = _whole(rows), [row for row in rows if not row.whole_trial]
    whole = [last] if last else []
    losses = [_losses(some) for some in (whole, ahead + whole)]
    lost, other = (max(some, key=lambda loss: loss[0], default=(0.0, None, "")) for some in losses)
    return lost if lost[0] > 1 + SHOWS and lost[1] is not None and _loses(lost[1]) else other


def worse_states(rows: Sequence[RulerRow]) -> bool:
    """Check whether predictions of some state get clearly worse, or of all states together."""
    return lost_most(rows)[0] > 1 + SHOWS or outweighed(rows)


def outweighed(rows: Sequence[RulerRow]) -> bool:
    """Check whether the states that get worse lose more than the other states gain."""
    ratio, row, _ = lost_most(rows)
    return row is not None and ratio > 1 + COUNTS and _loses(row)


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
    if not differ or not worse_states(rows):
        return None
    return found("gap.next.doubt", *(name for name in effects if name in differ), why="disagree")


def excess(rows: Sequence[RulerRow]) -> tuple[float, str, RulerRow] | None:
    """Return (error / noise, state, row) of the error furthest above the noise; None if none is."""
    above = [one for one in _ratios(rows) if one[0] > doubt_of(one[2].floor_unsure)]
    return max(above, key=lambda one: one[0], default=None)


def open_noise(rows: Sequence[RulerRow]) -> str:
    """Return the state whose error may be noise, for lack of repeats; "" if that is known."""
    row = furthest([row for row in rows if row.floor_at_most])
    return "" if row is None or excess(rows) else most_off(row)


def noise_unknown(row: RulerRow, names: Sequence[str]) -> bool:
    """Check whether only an upper bound of the noise is known, and errors may be within it."""
    if row.floor_from == AT_MOST:
        return True
    bounds = (doubt_of(0.0) * row.noise_floor.get(name, math.nan) for name in names)
    errors = (row.with_effects[name] for name in names)
    return row.floor_at_most and any(e <= b for e, b in zip(errors, bounds, strict=True))


def most_off(row: RulerRow) -> str:
    """Return the state with the largest error relative to its noise; "" if none was measured."""
    known = {n: e for n, e in row.with_effects.items() if e == e}
    off = {n: e / max(row.noise_floor.get(n, math.nan), 1e-300) for n, e in known.items()}
    return max(off, key=lambda n: off[n], default="")


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
    return max((gain for gain in gains_of(row).values() if gain == gain), default=0.0)


def _loses(row: RulerRow) -> bool:
    """Check whether the errors of a row grow, over all states."""
    told = [n for n, e in row.crude.items() if e > 0 and row.tells(n, "crude", "with_effects")]
    ends = [(row.with_effects[n], row.crude[n], row.noise_floor.get(n, 0.0)) for n in told]
    least = 1e-12
    logs = [math.log(max(now, f, least) / max(then, f, least)) for now, then, f in ends]
    return sum(value for value in logs if math.isfinite(value)) > 0


def _losses(rows: Sequence[RulerRow]) -> list[tuple[float, RulerRow | None, str]]:
    """Return (factor, row, channel) by which the errors of each channel grow or shrink."""
    return [
        (row.with_effects[name] / max(error, row.noise_floor.get(name, 0.0)), row, name)
        for row in rows
        if not row.drowned
        for name, error in row.crude.items()
        if error > 0 and math.isfinite(row.with_effects[name]) and row.tells(name, "crude")
    ]


def _gains_little(rows: Sequence[RulerRow]) -> bool:
    """Check whether the errors of the furthest horizon shrink by less than LITTLE on average."""
    row = furthest(rows)
    gains = [] if row is None else [gain for gain in gains_of(row).values() if math.isfinite(gain)]
    return bool(gains) and sum(gains) < LITTLE * len(gains)


def _ratios(rows: Sequence[RulerRow]) -> Iterator[tuple[float, str, RulerRow]]:
    """Yield (error / noise, state, row) of every state and horizon."""
    for row in (row for row in rows if not row.drowned):
        for name, noise in row.noise_floor.items():
            error = row.with_effects.get(name, math.nan)
            if noise > 0 and math.isfinite(error) and row.tells(name, "with_effects"):
                yield error / noise, name, row
