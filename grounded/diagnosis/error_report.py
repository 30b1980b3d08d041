"""Errors in a diagnosis: where and at which horizon, the leftover, a curve that predicts it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from grounded.diagnosis.levels import ABOVE, FAR, HALF, MANY, SHOWS
from grounded.findings import Quantity
from grounded.result import Document, with_unit

CALIBRATION = "calibration"  # the cause that is the calibrated parameters, in `Credit.of`
# families of what arrives late, and the quantity that is a time [s]
TIMES = {"delay": "d", "sensor_delay": "d", "first_order_lag": "tau", "sensor_lag": "tau"}
TINY = 1e-12  # an error that stands in for none
TOLD = 2  # most of a kind in words: states, causes, parameters; tables have all
BRIEF: dict[str, Any] = {"brief": True}  # marks a field whose key is omitted if it is empty


@dataclass(frozen=True, eq=False)
class ChannelShare(Document):
    """A state's share of the gap, the rms of its prediction error and of its noise alone."""

    name: str
    share: float  # 0 to 1; NaN if the gap is no more than noise
    rms: float
    unit: str = ""
    noise: float = math.nan


@dataclass(frozen=True, eq=False)
class TimeShare(Document):
    """Share of the gap from `start` to `end` [s] of a trial."""

    start: float = field(metadata={"key": "from"})
    end: float = field(metadata={"key": "to"})
    share: float


@dataclass(frozen=True, eq=False)
class Region(Document):
    """A region (`v > 0.5`), with its share of the gap and of the time."""

    when: str
    share: float = math.nan
    occupancy: float = math.nan
    unit: str = field(metadata=BRIEF, default="")

    @property
    def told(self) -> str:
        """The region with its unit: `v > 0.5 m/s`."""
        return with_unit(self.when, self.unit)

    @property
    def of_time(self) -> bool:
        """Whether it is a part of the run's time, `t > 3.2`, to which no robot can go."""
        return self.when.startswith("t ")


@dataclass(frozen=True, eq=False)
class Where(Document):
    """Where the gap is, largest shares first.

    Without a claim or a leftover, no channel has a share and no time or region is given.

    whiteness: by state, the p-value of white innovations.
    tempering: factor on evidence, below 1 if the innovations are correlated or too large.
    """

    channels: tuple[ChannelShare, ...] = ()
    times: tuple[TimeShare, ...] = ()
    regions: tuple[Region, ...] = ()
    whiteness: Mapping[str, float] = field(default_factory=dict)
    tempering: float = 1.0


@dataclass(frozen=True, eq=False)
class Gap(Document):
    """The prediction error relative to the noise that one diagnosis estimates, before and after.

    It can't be compared between diagnoses; verdicts are based on `prediction_error` instead.
    """

    horizon_s: float = math.nan
    unit: str = ""
    before: float = math.nan
    after: float = math.nan
    floor: float = math.nan
    held_out: bool = False


@dataclass(frozen=True, eq=False)
class RulerRow(Document):
    """Rms errors of held-out open-loop predictions over one horizon, by channel in its unit.

    held_out: by "trials", by "pieces" of one long log, or "no" if there are too few data.
    outset: errors of the model before anything was adopted; empty if nothing was.
    calibrated: errors with the model's own parameters fitted; empty if all are constants.
    floor_from: "repeats" of a manoeuvre, or the "short horizon", whose noise is propagated by the
        model.
    floor_at_most: `noise_floor` is an upper bound and the noise may be far less: beside a leftover
        repeats scatter by what the model misses in each of them, too. Without repeats, part of the
        innovations is the model's error if they are not white.
    runs_away: by column ("crude" ...), the channels whose prediction diverges far beyond the
        measured range, as in open loop for an unstable plant. Its error is meaningless.
    floor_unsure: standard deviation of the logarithm of a floor from few or short repeats.
    drowned: noise alone takes some state beyond its measured range within this horizon, so
        open-loop errors are meaningless in all channels.
    """

    horizon_s: float
    whole_trial: bool = False
    unit_by_channel: Mapping[str, str] = field(default_factory=dict)
    held_out: str = "trials"
    crude: Mapping[str, float] = field(default_factory=dict)
    calibrated: Mapping[str, float] = field(default_factory=dict)
    with_effects: Mapping[str, float] = field(default_factory=dict)
    noise_floor: Mapping[str, float] = field(default_factory=dict)
    floor_from: str = ""
    floor_at_most: bool = False
    floor_unsure: float = field(metadata=BRIEF, default=0.0)
    outset: Mapping[str, float] = field(metadata=BRIEF, default_factory=dict)
    runs_away: Mapping[str, tuple[str, ...]] = field(metadata=BRIEF, default_factory=dict)
    drowned: bool = field(metadata=BRIEF, default=False)

    def tells(self, name: str, *columns: str) -> bool:
        """Check that the errors of a channel are meaningful: none of these columns runs away."""
        return not any(name in self.runs_away.get(column, ()) for column in columns)

    @property
    def changes(self) -> dict[str, float]:
        """By how much the logarithm of each state's error grows; within the noise it does not.

        States without an error are left out, as are those whose prediction diverged before.
        """
        found = {}
        for name, before in self.crude.items():
            now, floor = self.with_effects.get(name, math.nan), self.noise_floor.get(name, 0.0)
            if before > 0 and math.isfinite(now) and self.tells(name, "crude"):
                found[name] = math.log(max(now, floor, TINY) / max(before, floor, TINY))
        return found

    @property
    def gains(self) -> dict[str, float]:
        """The share of each state's error that is gone, negative if it grew."""
        return {name: 1 - math.exp(change) for name, change in self.changes.items()}

    @property
    def above(self) -> dict[str, float]:
        """Each state's error relative to its noise; infinite if that is not known."""
        known = {n: e for n, e in self.with_effects.items() if math.isfinite(e)}
        floors = {n: self.noise_floor.get(n, 0.0) for n in known if self.tells(n, "with_effects")}
        return {n: known[n] / floor if floor > 0 else math.inf for n, floor in floors.items()}

    @property
    def most_off(self) -> str:
        """The state with the largest error relative to its noise; "" if none was measured."""
        off = self.above
        return max(off, key=lambda name: (off[name], self.with_effects[name]), default="")

    @property
    def loses(self) -> bool:
        """Whether its errors grow, over all states."""
        return sum(self.changes.values()) > 0


def furthest(rows: Sequence[RulerRow]) -> RulerRow | None:
    """Return the longest horizon that is not drowned in noise, or else the shortest."""
    ahead = [row for row in rows if not row.whole_trial]
    return next((row for row in reversed(ahead) if not row.drowned), ahead[0] if ahead else None)


@dataclass(frozen=True, eq=False)
class Identifiable(Document):
    """How well the trials identify one uncertain parameter, with all others free.

    left: remaining fraction of its prior standard deviation `prior`, 0 to 1. jointly: not alone,
    but together with other values as they are stated. given: {parameter: slope} for parameters that
    were held though the trials don't identify them: how many per cent this one is off per per cent
    of error of the other (1: only the ratio is known). Its `+-` assumes them exact.
    """

    parameter: str
    verdict: str  # identifiable, weak, not identifiable
    prior: float = math.nan
    left: float = math.nan
    given: Mapping[str, float] = field(metadata=BRIEF, default_factory=dict)
    jointly: bool = field(metadata=BRIEF, default=False)

    @property
    def known(self) -> bool:
        """Whether the trials identify it, if only weakly."""
        return self.verdict != "not identifiable"

    @property
    def lost(self) -> bool:
        """Whether its calibrated value is not known, not even together with the others."""
        return self.verdict == "not identifiable" and not self.jointly


@dataclass(frozen=True, eq=False)
class Combination(Document):
    """Values that the trials show only in combination, such as their ratios.

    values: the claimed effects and calibrated parameters in it. rests_on: {parameter: standard
    deviation of its prior} for those whose declared values and priors alone set each of them.
    """

    values: tuple[str, ...]
    rests_on: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Credit(Document):
    """Credit of an effect, or of "calibration": the loss of prediction accuracy without it.

    share: of the total gain in log error, over channels and horizons; without_it: rms error by
    channel, 1 s ahead, with all the rest fitted again.
    """

    of: str
    share: float = math.nan
    without_it: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Part(Document):
    """A short part of a trial, from `start` to `end` [s], that holds a share of an error."""

    trial: str
    start: float = field(metadata={"key": "from"})
    end: float = field(metadata={"key": "to"})
    share: float


@dataclass(frozen=True, eq=False)
class Remainder(Document):
    """A leftover that no known effect explains.

    size: rms of the rate that the model of a state lacks, if a flexible regression finds one [unit
    of the state per second]; error: rms error of predictions `horizon_s` ahead; floor: the same
    from noise alone, or an upper bound of it (`floor_at_most`). If most of the squared error above
    the noise is in one short part of a trial, `part` is that: something was different there.
    """

    channel: str
    size: float = math.nan
    unit: str = ""
    evidence: float = math.nan  # [nats]
    region: Region | None = None  # the region with most of it
    error: float = math.nan
    floor: float = math.nan
    horizon_s: float = math.nan
    error_unit: str = ""
    floor_at_most: bool = False
    part: Part | None = field(metadata=BRIEF, default=None)

    @property
    def above(self) -> bool:
        """Whether the error is clearly above the floor."""
        return not (self.floor > 0 and self.error <= ABOVE * self.floor)

    @property
    def wide(self) -> bool:
        """Whether the error is so far above the floor that what is claimed may stand in for it."""
        return self.error > FAR * self.floor > 0


@dataclass(frozen=True, eq=False)
class Curve(Document):
    """The shape of a leftover: a rate `value` with its `std` at points `at` of one variable."""

    effect: str  # its name for `adopt`
    over: str
    at: tuple[float, ...] = ()
    value: tuple[float, ...] = ()
    std: tuple[float, ...] = ()
    quantities: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Correction(Document):
    """A curve that predicts what no effect explains. It does not count as a cause.

    `held_out_gain` is the share of the squared error that it removes on held-out trials;
    `adoptable`: whether that exceeds its scatter from trial to trial.
    """

    channel: str
    over: tuple[str, ...] = ()
    held_out_gain: float = math.nan
    adoptable: bool = False
    unit: str = ""
    curves: tuple[Curve, ...] = ()


def telling(rows: Sequence[RulerRow]) -> RulerRow | None:
    """Return the row to report: the longest horizon, or whole trials if the plant is slow.

    A heating process, for example, moves so little within 1 s that any model predicts it well.
    """
    ahead, drowned = furthest(rows), any(row.drowned for row in rows)
    whole = next((row for row in rows if row.whole_trial and not drowned), None)
    if ahead and whole:
        least, most = (max(row.gains.values(), default=0.0) for row in (ahead, whole))
        return whole if least < HALF < most else ahead
    return ahead


def states_told(row: RulerRow, tracked: Sequence[str] = ()) -> list[str]:
    """Return the states whose errors are told, best first.

    They are those that improve enough to show, tracked ones first (the most important is first
    among these). If none does, it is the one that is furthest off for its noise.
    """
    gains = {name: gain for name, gain in row.gains.items() if gain > SHOWS}
    order = {name: k for k, name in enumerate(tracked)}
    best = sorted(gains, key=lambda n: (order.get(n, len(tracked)), -gains[n]))[:TOLD]
    return best or [name for name in [row.most_off] if name]


def lost_most(rows: Sequence[RulerRow]) -> tuple[RulerRow, str] | None:
    """Return the row and the state whose error grows most; None if none grows so that it shows.

    Whole trials come first if they lose over all states, as they are what a plan is made for.
    """
    rows = [row for row in rows if not row.drowned]
    for some in ([row for row in rows if row.whole_trial and row.loses], rows):
        losses = [(change, row, name) for row in some for name, change in row.changes.items()]
        most, row, name = max(losses, key=lambda loss: loss[0], default=(0.0, None, ""))
        if row is not None and most > math.log(1 + SHOWS):
            return row, name
    return None


def excess(rows: Sequence[RulerRow]) -> tuple[float, str, RulerRow] | None:
    """Return (error / noise, state, row) of the error furthest above the noise; None if none is.

    Errors may exceed a floor from few repeats by more, and still be noise.
    """
    each = [(o, name, row) for row in rows if not row.drowned for name, o in row.above.items()]
    doubt = {id(row): max(ABOVE, math.exp(MANY * row.floor_unsure)) for row in rows}
    clear = [one for one in each if doubt[id(one[2])] < one[0] < math.inf]
    return max(clear, key=lambda one: one[0], default=None)


def open_noise(rows: Sequence[RulerRow]) -> str:
    """Return the state whose error may be noise, for lack of repeats; "" if that is known."""
    row = furthest([row for row in rows if row.floor_at_most])
    return "" if row is None or excess(rows) else row.most_off


def errors(row: RulerRow, name: str, **columns: str) -> dict[str, Any]:
    """Return the errors of a state as facts, by slot: columns of the row, such as now="crude"."""
    unit = row.unit_by_channel.get(name, "")
    values = {slot: getattr(row, column).get(name, math.nan) for slot, column in columns.items()}
    return {slot: Quantity(value, unit) for slot, value in values.items() if math.isfinite(value)}
