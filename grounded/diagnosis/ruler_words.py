"""Held-out prediction errors in words: what improves, what gets worse, what remains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from grounded.diagnosis.error_report import (
    AT_MOST,
    Remainder,
    RulerRow,
    beside_noise,
    doubt_of,
    furthest,
)
from grounded.result import listed, measured_alike, number

if TYPE_CHECKING:
    from grounded.diagnosis.parts import Agreement

NAMED = 3  # channels named in one sentence
MATTERS = 0.05  # share of the crude model's error below which a remaining error is given as a share
HALF, MORE = 0.5, 0.2  # improvements: below HALF 1 s ahead and MORE of it over whole trials
COMPARABLE = 0.2  # difference of two improvements, as shares, that hardly matters
LITTLE = 0.1  # mean share of the errors below which a claim that ties gains too little to adopt
SHOWS = 0.1  # relative change below which a channel is not named
REPEATED = "the scatter of the repeats holds what the model misses in each as well"
COUNTS = 0.03  # relative change below which a loss is not compared with gains elsewhere


def improvement(rows: Sequence[RulerRow], tracked: Sequence[str] = ()) -> str:
    """Return a sentence: `Predictions 1 s ahead miss v by 0.08 m/s instead of 0.31 m/s`.

    Whole trials are used if predictions 1 s ahead gain nothing, or whole trials gain much more.

    Args:
        rows: held-out prediction errors.
        tracked: the states that the task follows, the most important first. They are named before
            others whose errors shrink by hardly more.
    """
    row = told_row(rows)
    if row is None:
        first = telling(rows)
        return f"{_ahead(first)} hardly change." if first else ""
    told = [(name, *_told(row, name, "with_effects", "crude")) for name in _best(row, tracked)]
    parts = [f"{name} by {now} instead of {then}{noise}" for name, now, then, noise in told]
    return f"{_ahead(row)} miss {listed(parts)}.{unknown_noise(row, [n for n, *_ in told])}"


def unknown_noise(row: RulerRow, names: Sequence[str] = ()) -> str:
    """Return a sentence if these errors may be any part noise; "" if the noise is known.

    An upper bound of the noise from one-step errors says something only of an error above it.

    Args:
        row: prediction errors at one horizon.
        names: the states that were named; by default the one that is furthest off.
    """
    if not any(_within_bound(row, name) for name in names or [most_off(row)]):
        return ""
    return " How much of that is noise is not known: repeat one run to see."


def unexplained_noise(row: RulerRow) -> str:
    """Return the same sentence of a model beside which nothing is claimed, with any upper bound."""
    if row.floor_from == AT_MOST:
        return f" How much of that is noise is not known: {REPEATED}."
    return unknown_noise(row)


def _within_bound(row: RulerRow, name: str) -> bool:
    """Check that an error may be noise, as only an upper bound of that is known."""
    bound = row.noise_floor.get(name, math.nan)
    return row.floor_at_most and row.with_effects[name] <= doubt_of(0.0) * bound


def told_row(rows: Sequence[RulerRow]) -> RulerRow | None:
    """Return the row of which `improvement` gives numbers; None if predictions hardly change."""
    both = (telling(rows), _whole(rows))
    return next((row for row in both if row and _best(row)), None)


def _whole(rows: Sequence[RulerRow]) -> RulerRow | None:
    """Return the row of whole trials; None if noise alone exceeds everything measured in less."""
    if any(row.drowned for row in rows):
        return None
    return next((row for row in rows if row.whole_trial), None)


def _best(row: RulerRow, tracked: Sequence[str] = ()) -> list[str]:
    """Return the channels that improve most, best first, of those that improve enough to name.

    Tracked ones that improve nearly as much (COMPARABLE) come first.
    """
    gains = {n: gain for n, gain in _gains(row).items() if gain > SHOWS}
    close = max(gains.values(), default=0.0) - COMPARABLE
    order = {n: k for k, n in enumerate(tracked) if gains.get(n, -1.0) >= close}
    return sorted(gains, key=lambda n: (order.get(n, len(tracked)), -gains[n]))[: NAMED - 1]


def telling(rows: Sequence[RulerRow]) -> RulerRow | None:
    """Return the row to report: the longest horizon, or whole trials if the plant is slow.

    A heating process, for example, moves so little within 1 s that any model predicts it well.
    """
    ahead, whole = furthest(rows), _whole(rows)
    if ahead and whole and _most(ahead) < HALF and _most(whole) > _most(ahead) + MORE:
        return whole
    return ahead


def _gains(row: RulerRow) -> dict[str, float]:
    """Return the share of each channel's error that is gone, without diverging predictions."""
    told = {n: e for n, e in row.crude.items() if row.tells(n, "crude", "with_effects")}
    return {n: 1 - row.with_effects[n] / e for n, e in told.items() if e > 0}


def _most(row: RulerRow) -> float:
    return max((gain for gain in _gains(row).values() if gain == gain), default=0.0)


def _ahead(row: RulerRow) -> str:
    if row.whole_trial:
        return "Predictions of whole trials"
    held = "" if row.held_out != "no" else " (not held out)"
    return f"Predictions {number(row.horizon_s)} s ahead{held}"


def worsened(rows: Sequence[RulerRow]) -> str:
    """Return a sentence on the channels that get worse, the worst first; "" if none does by SHOWS.

    Each at the horizon at which it loses most.
    """
    ratio, row, name = _lost_most(rows)
    if row is None or not (ratio > 1 + SHOWS or outweighed(rows)):
        return ""
    others = dict[str, RulerRow]()
    for lost, at, other in sorted(_losses(rows), key=lambda loss: -loss[0]):
        if lost > 1 + SHOWS and other != name and at.tells(other, "with_effects"):
            others.setdefault(other, at)
    parts = [f"for {_instead(row, name)}"]
    for other, at in [*others.items()][: NAMED - 1]:
        parts.append(f"{'' if at is row else f'{_when(at)} '}for {_instead(at, other)}")
    text = f"{_ahead(row)} get worse {listed(parts)}"
    if not row.tells(name, "with_effects"):  # how far says nothing
        (then,) = measured_alike([row.crude[name]], row.unit_by_channel[name])
        text = f"{_ahead(row)} diverge for {name}, which the crude model misses by {then}"
    return f"{text}." if outweighed(rows) else f"{text}, but they improve over all states."


def _instead(row: RulerRow, name: str) -> str:
    """Return `y: 1.5 mm instead of 1.3 mm`."""
    errors = [row.with_effects[name], row.crude[name]]
    now, then = measured_alike(errors, row.unit_by_channel[name])
    return f"{name}: {now} instead of {then}"


def outweighed(rows: Sequence[RulerRow]) -> bool:
    """Check whether the states that get worse lose more than the other states gain."""
    ratio, row, _ = _lost_most(rows)
    return row is not None and ratio > 1 + COUNTS and _loses(row)


def _loses(row: RulerRow) -> bool:
    """Check whether the errors of a row grow, over all states."""
    told = [n for n, e in row.crude.items() if e > 0 and row.tells(n, "crude", "with_effects")]
    ends = [(row.with_effects[n], row.crude[n], row.noise_floor.get(n, 0.0)) for n in told]
    least = 1e-12
    logs = [math.log(max(now, f, least) / max(then, f, least)) for now, then, f in ends]
    return sum(value for value in logs if math.isfinite(value)) > 0


def _lost_most(rows: Sequence[RulerRow]) -> tuple[float, RulerRow | None, str]:
    """Return (factor, row, channel) of the channel whose error grows most.

    Whole trials come first if they lose over all states, as they are what a plan is made for.
    """
    last, ahead = _whole(rows), [row for row in rows if not row.whole_trial]
    whole = [last] if last else []
    found = [_losses(some) for some in (whole, ahead + whole)]
    lost, other = (max(some, key=lambda loss: loss[0], default=(0.0, None, "")) for some in found)
    return lost if lost[0] > 1 + SHOWS and lost[1] is not None and _loses(lost[1]) else other


def _losses(rows: Sequence[RulerRow]) -> list[tuple[float, RulerRow, str]]:
    """Return (factor, row, channel) by which the errors of each channel grow or shrink."""
    return [
        (row.with_effects[name] / max(error, row.noise_floor.get(name, 0.0)), row, name)
        for row in rows
        if not row.drowned
        for name, error in row.crude.items()
        if error > 0 and math.isfinite(row.with_effects[name]) and row.tells(name, "crude")
    ]


def objection(
    rows: Sequence[RulerRow],
    agreement: Sequence[Agreement],
    effects: Sequence[str],
    ties: Sequence[Sequence[str]] = (),
    left: Sequence[Remainder] = (),
) -> str:
    """Return a clause on why adopting the claimed effects is unwise; "" if it is not.

    It is if predictions lose more than they gain, or get worse somewhere while the trials disagree
    about the effects' values; also if they gain little beside a gap that remains, and all of them
    tie with others or the gap is wide: a heading that an aircraft's sideslip moves was told as an
    old log, and its roll rate as shaken.

    Args:
        rows: held-out prediction errors, a row per horizon.
        agreement: whether the trials agree on each value.
        effects: the claimed effects.
        ties: groups of effects that further trials could tell apart.
        left: the leftovers beside them.
    """
    if not effects:
        return ""
    if outweighed(rows):
        return "predictions get worse with what is claimed"
    gap, wide = any(one.above for one in left), any(one.wide for one in left)
    tied = all(any(name in group for group in ties) for name in effects)
    if gap and (wide or tied) and _gains_little(rows):
        rivals = dict.fromkeys(n for group in ties for n in group if n not in effects)
        apart = f" and can't be told from {' or '.join(rivals)}" * bool(rivals)
        gains = f"gain{'s' * (len(effects) == 1)} little"
        return f"beside the gap that remains, {listed(effects)} {gains}{apart}"
    differ = dict.fromkeys(one.effect for one in agreement if not one.agrees)
    names = [name for name in differ if name in effects]
    if not names or not worsened(rows):
        return ""
    return f"the trials disagree on {listed(names)}, and some predictions get worse"


def _gains_little(rows: Sequence[RulerRow]) -> bool:
    """Check whether the errors of the furthest horizon shrink by less than LITTLE on average."""
    row = furthest(rows)
    gains = [] if row is None else [gain for gain in _gains(row).values() if math.isfinite(gain)]
    return bool(gains) and sum(gains) < LITTLE * len(gains)


def floor(row: RulerRow | None) -> str:
    """Return `: 1 s ahead it misses v by 0.1 m/s (noise: 0.05 m/s)` for the worst channel."""
    if row is None:
        return ""
    if not (name := most_off(row)):
        return ""
    error, noise = _told(row, name, "with_effects")
    return f": {_when(row)} it misses {name} by {error}{noise}"


def explained(rows: Sequence[RulerRow]) -> str:
    """Return a sentence that the model explains the data, down to the noise if that is known.

    To be used if `rest` finds nothing above the noise.
    """
    row = furthest(rows)
    name = "" if row is None else most_off(row)
    known = row is None or row.noise_floor.get(name, math.nan) > 0
    if doubt := in_doubt(rows):
        return f"The model explains the data as far as the noise is known: {doubt}."
    return f"The model explains the data{' down to the noise' * known}{floor(row)}."


def in_doubt(rows: Sequence[RulerRow]) -> str:
    """Return a clause on an error above the noise but within the noise's uncertainty; or ""."""
    times, _, name, row = max(_ratios(rows), key=lambda one: one[0], default=(0.0, 0.0, "", None))
    if row is None or not doubt_of(0.0) < times <= doubt_of(row.floor_unsure):
        return ""
    values = [row.with_effects[name], row.noise_floor[name]]
    error, noise = measured_alike(values, row.unit_by_channel[name])
    times_off = f"{doubt_of(row.floor_unsure):.2g}"
    few = f"which so few repeats tell only to a factor of {times_off}"
    noise = f"{'at most ' * row.floor_bound}{noise}"
    return f"{_when(row)} {name} is off by {error}, {times:.2g} times its noise of {noise}, {few}"


def _ratios(rows: Sequence[RulerRow]) -> list[tuple[float, float, str, RulerRow]]:
    """Return (error / noise, error / crude error, state, row) of every state and horizon."""
    return [
        (
            row.with_effects[name] / noise,
            row.with_effects[name] / max((row.outset or row.crude)[name], 1e-300),
            name,
            row,
        )
        for row in rows
        if not row.drowned
        for name, noise in row.noise_floor.items()
        if noise > 0 and math.isfinite(row.with_effects.get(name, math.nan))
        if row.tells(name, "with_effects")
    ]


def most_off(row: RulerRow) -> str:
    """Return the state with the largest error relative to its noise; "" if none was measured."""
    known = {n: e for n, e in row.with_effects.items() if e == e}
    off = {n: e / max(row.noise_floor.get(n, math.nan), 1e-300) for n, e in known.items()}
    return max(off, key=lambda n: off[n], default="")


def open_noise(rows: Sequence[RulerRow]) -> str:
    """Return the state whose error may be noise, for lack of repeats; "" if that is known."""
    row = furthest([row for row in rows if row.floor_at_most])
    return "" if row is None or rest(rows) else most_off(row)


def rest(rows: Sequence[RulerRow]) -> str:
    """Return a clause on an error above the noise that is too small to explain; or ""."""
    found = [one for one in _ratios(rows) if one[0] > doubt_of(one[3].floor_unsure)]
    if not found:
        return ""
    times, share, name, row = max(found, key=lambda one: one[:3])
    when = _when(row)
    noise = "the most that can be noise" if row.floor_bound else "the noise"
    still, noise = f"the state {name} is still off by", f"{float(f'{times:.2g}'):,g} times {noise}"
    if share < MATTERS:
        of = f"{100 * share:.1g} % of the crude model's error"
        return f"{still} {of} {when}: too little to look for a cause, though {noise}"
    text = f"{still} {noise} {when}"
    small = f"too little compared with how far {name} moves"
    return f"{text}; no cause is looked for, as that is {small}, or differs too much by trial"


def _when(row: RulerRow) -> str:
    return "over whole trials" if row.whole_trial else f"{number(row.horizon_s)} s ahead"


def _told(row: RulerRow, name: str, *columns: str) -> list[str]:
    """Return a state's errors in these columns, then the noise as text, in one unit."""
    errors = [getattr(row, column)[name] for column in columns]
    noise, unit = row.noise_floor.get(name, math.nan), row.unit_by_channel[name]
    if _within_bound(row, name):  # as a figure beside the error, it reads as if nothing was left
        noise = math.nan
    return beside_noise(errors, noise, unit, at_most=row.floor_bound)
