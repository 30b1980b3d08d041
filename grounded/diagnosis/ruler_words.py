"""What the ruler's rows say in words: what predictions gain and lose, what is left of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from grounded.diagnosis.error_report import RulerRow, beside_noise, doubt_of, furthest
from grounded.result import listed, measured_alike, number

if TYPE_CHECKING:
    from grounded.diagnosis.report import Agreement

NAMED = 3  # channels that a sentence names at most
MATTERS = 0.05  # of the crude model's error: a rest below it is told as its share
HALF, MORE = 0.5, 0.2  # of the error that is gone: less a second ahead, so much more by the end
SHOWS = 0.1  # of the error: a channel that improves by less is not named
COUNTS = 0.03  # likewise, where nothing else in the same row gains as much


def improvement(rows: Sequence[RulerRow]) -> str:
    """What predictions gain: `1 s ahead predictions miss v by 0.08 m/s instead of 0.31`.

    Of whole trials, where they gain nothing a second ahead, or much more.
    """
    first = telling(rows)
    shown = [row for row in rows if row is first or row.whole_trial]
    for row in sorted(shown, key=lambda row: row is not first):
        gains = _gains(row)
        best = sorted((n for n in gains if gains[n] > SHOWS), key=lambda n: -gains[n])
        told = [(name, *_told(row, name, "with_effects", "crude")) for name in best[: NAMED - 1]]
        parts = [f"{name} by {now} instead of {then}{noise}" for name, now, then, noise in told]
        if parts:
            return f"{_ahead(row)} miss {listed(parts)}."
    return f"{_ahead(first)} hardly change." if first else ""


def telling(rows: Sequence[RulerRow]) -> RulerRow | None:
    """The row that a sentence is about: the longest horizon, or whole trials of a slow plant.

    A second ahead, what heats up over an hour misses little whatever the model lacks.
    """
    ahead = furthest(rows)
    whole = next((row for row in rows if row.whole_trial), None)
    if ahead and whole and _most(ahead) < HALF and _most(whole) > _most(ahead) + MORE:
        return whole
    return ahead


def _gains(row: RulerRow) -> dict[str, float]:
    """The share of each channel's error that is gone, where predictions do not run away."""
    told = {n: e for n, e in row.crude.items() if row.tells(n, "crude", "with_effects")}
    return {n: 1 - row.with_effects[n] / e for n, e in told.items() if e > 0}


def _most(row: RulerRow) -> float:
    return max((gain for gain in _gains(row).values() if gain == gain), default=0.0)


def _ahead(row: RulerRow) -> str:
    if row.whole_trial:
        return "Whole trials"
    held = "" if row.held_out != "no" else ", not held out"
    return f"{number(row.horizon_s)} s ahead{held} predictions"


def worsened(rows: Sequence[RulerRow]) -> str:
    """What predictions lose in the channel that loses most, "" where none loses over SHOWS."""
    ratio, row, name = _lost_most(rows)
    if row is None or not (ratio > 1 + SHOWS or outweighed(rows)):
        return ""
    unit = row.unit_by_channel[name]
    now, then = measured_alike([row.with_effects[name], row.crude[name]], unit)
    text = f"{_ahead(row)} miss {name} by {now} instead of {then}: that is worse"
    if not row.tells(name, "with_effects"):  # how far says nothing
        (then,) = measured_alike([row.crude[name]], unit)
        ahead = "Predictions of whole trials" if row.whole_trial else _ahead(row)
        text = f"{ahead} run away in {name}, which the crude model misses by {then}"
    return f"{text}." if outweighed(rows) else f"{text}, though over all states they gain."


def outweighed(rows: Sequence[RulerRow]) -> bool:
    """Whether those predictions lose more in what gets worse than they gain in other states."""
    ratio, row, _ = _lost_most(rows)
    if row is None or not ratio > 1 + COUNTS:
        return False
    told = [n for n, e in row.crude.items() if e > 0 and row.tells(n, "crude", "with_effects")]
    ends = [(row.with_effects[n], row.crude[n], row.noise_floor.get(n, 0.0)) for n in told]
    least = 1e-12
    logs = [math.log(max(now, f, least) / max(then, f, least)) for now, then, f in ends]
    return sum(value for value in logs if math.isfinite(value)) > 0


def _lost_most(rows: Sequence[RulerRow]) -> tuple[float, RulerRow | None, str]:
    """By what factor errors grow in the channel that loses most, where and in which."""
    losses = [
        (row.with_effects[name] / max(error, row.noise_floor.get(name, 0.0)), row, name)
        for row in rows
        if not row.drowned
        for name, error in row.crude.items()
        if error > 0 and math.isfinite(row.with_effects[name]) and row.tells(name, "crude")
    ]
    return max(losses, key=lambda loss: loss[0], default=(0.0, None, ""))


def contested(
    rows: Sequence[RulerRow], agreement: Sequence[Agreement], effects: Sequence[str]
) -> bool:
    """Whether what is claimed is better not adopted: predictions get worse somewhere with it.

    By more than they gain there, or while the trials differ in its values.
    """
    differ = {one.effect for one in agreement if not one.agrees} & set(effects)
    return bool(effects) and (outweighed(rows) or bool(differ and worsened(rows)))


def floor(row: RulerRow | None) -> str:
    """What predictions miss by, and noise alone, of the channel that misses most."""
    if row is None:
        return ""
    if not (name := most_off(row)):
        return ""
    error, noise = _told(row, name, "with_effects")
    return f": {_when(row)} it misses {name} by {error}{noise}"


def explained(rows: Sequence[RulerRow]) -> str:
    """That the model explains the data, and how far: down to the noise, or as far as that is known.

    For what leaves nothing above the noise (`rest`).
    """
    row = furthest(rows)
    name = "" if row is None else most_off(row)
    known = row is None or row.noise_floor.get(name, math.nan) > 0
    if doubt := in_doubt(rows):
        return f"The model explains the data as far as their noise is known: {doubt}."
    return f"The model explains the data{' down to the noise' * known}{floor(row)}."


def in_doubt(rows: Sequence[RulerRow]) -> str:
    """What is off by more than noise, but not by more than the doubt in that; "": nothing."""
    times, _, name, row = max(_ratios(rows), key=lambda one: one[0], default=(0.0, 0.0, "", None))
    if row is None or not doubt_of(0.0) < times <= doubt_of(row.floor_unsure):
        return ""
    values = [row.with_effects[name], row.noise_floor[name]]
    error, noise = measured_alike(values, row.unit_by_channel[name])
    few = f"which so few repeats tell only to a factor of {doubt_of(row.floor_unsure):.2g}"
    return f"{_when(row)} {name} is off by {error}, {times:.2g} times its noise of {noise}, {few}"


def _ratios(rows: Sequence[RulerRow]) -> list[tuple[float, float, str, RulerRow]]:
    """How many times its noise a state is off, its share of the first error, its name, where."""
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
    """The state that is off by most, beside its noise; "" where none was measured."""
    known = {n: e for n, e in row.with_effects.items() if e == e}
    off = {n: e / max(row.noise_floor.get(n, math.nan), 1e-300) for n, e in known.items()}
    return max(off, key=lambda n: off[n], default="")


def open_noise(rows: Sequence[RulerRow]) -> str:
    """The state whose error may be noise or not, for want of repeats; "" where that is known."""
    row = furthest([row for row in rows if row.floor_at_most])
    return "" if row is None or rest(rows) else most_off(row)


def rest(rows: Sequence[RulerRow]) -> str:
    """What is left above the noise where no leftover is stated, and why none is; "": nothing."""
    found = [one for one in _ratios(rows) if one[0] > doubt_of(one[3].floor_unsure)]
    if not found:
        return ""
    times, share, name, row = max(found, key=lambda one: one[:3])
    when = _when(row)
    least = "at least " * rows[0].floor_at_most
    text = f"the state {name} is still off by {least}{times:.2g} times the noise {when}"
    if share < MATTERS:
        of = f"{100 * share:.1g} % of what the crude model missed"
        return f"{text}, which is {of}: too little to look for a cause"
    beside = f"beside how far {name} moves or how much trials differ"
    return f"{text}: too little to look for a cause, {beside}"


def _when(row: RulerRow) -> str:
    return "over whole trials" if row.whole_trial else f"{number(row.horizon_s)} s ahead"


def _told(row: RulerRow, name: str, *columns: str) -> list[str]:
    """A state's errors in these columns and the noise beside the first, in one unit."""
    errors = [getattr(row, column)[name] for column in columns]
    noise, unit = row.noise_floor.get(name, math.nan), row.unit_by_channel[name]
    return beside_noise(errors, noise, unit, at_most=row.floor_at_most)
