"""What a diagnosis says of errors: where the gap lies, what predictions miss, what is left."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from grounded.result import Document, measured_alike, number, with_unit

ABOVE = 1.3  # times the noise floor: what is left is stated
SURE = 3.0  # standard deviations of the floor: it is compared in each channel, at each horizon
BRIEF: dict[str, Any] = {"brief": True}  # a field whose key is left out where there is nothing


@dataclass(frozen=True, eq=False)
class ChannelShare(Document):
    """A state's part of the gap, the rms of its prediction error and of its noise alone."""

    name: str
    share: float  # 0 to 1; NaN where the gap is no more than noise
    rms: float
    unit: str = ""
    noise: float = math.nan


@dataclass(frozen=True, eq=False)
class TimeShare(Document):
    """A time's part of the gap, from `start` to `end` [s] of a trial."""

    start: float = field(metadata={"key": "from"})
    end: float = field(metadata={"key": "to"})
    share: float


@dataclass(frozen=True, eq=False)
class Region(Document):
    """A region's part of the gap (`v > 0.5`), and of the time."""

    when: str
    share: float = math.nan
    occupancy: float = math.nan
    unit: str = field(metadata=BRIEF, default="")

    @property
    def told(self) -> str:
        """With its unit: `v > 0.5 m/s`."""
        return with_unit(self.when, self.unit)


@dataclass(frozen=True, eq=False)
class Parts(Document):
    """A mean squared error in three parts that sum to 1."""

    explained: float = math.nan
    unexplained: float = math.nan
    irreducible: float = math.nan


@dataclass(frozen=True, eq=False)
class ChannelParts(Document):
    """The same of one state, and the rms error of the bare model."""

    name: str
    unit: str = ""
    rms: float = math.nan
    explained: float = math.nan
    unexplained: float = math.nan
    irreducible: float = math.nan


@dataclass(frozen=True, eq=False)
class Split(Document):
    """What the error a while ahead is made of: of all states in units of their noise, and of each.

    The irreducible part comes from "repeats" of a candidate, trials "alike", or the "noise"; of
    a noise of which only a bound is known it is "at most" so large. NaN: the noise is not known.
    `irreducible_unsure`: standard deviation of the logarithm of a noise from few repeats.
    """

    horizon_s: float
    whole: Parts = field(metadata={"key": "all"})
    channels: tuple[ChannelParts, ...] = ()
    irreducible_from: str = "noise"
    irreducible_unsure: float = field(metadata=BRIEF, default=0.0)

    def may_be_noise(self, parts: Parts | ChannelParts) -> bool:
        """Whether what is unexplained is no more than the doubt in what noise leaves."""
        left, bound = parts.unexplained + parts.irreducible, self.irreducible_from == "at most"
        return not bound and left <= doubt_of(self.irreducible_unsure) ** 2 * parts.irreducible


@dataclass(frozen=True, eq=False)
class Where(Document):
    """Where the gap lies, and what is left of it: the largest shares first.

    Where nothing is named or left, no channel has a share and no time or region is given.

    split: by horizon (one_step, horizon, whole_run).
    whiteness: by state, the chance that white noise leaves what is left of it (a p-value).
    tempering: what a nat of evidence is worth, by the correlation and the size of what is left.
    """

    channels: tuple[ChannelShare, ...] = ()
    times: tuple[TimeShare, ...] = ()
    regions: tuple[Region, ...] = ()
    split: Mapping[str, Split] = field(default_factory=dict)
    whiteness: Mapping[str, float] = field(default_factory=dict)
    tempering: float = 1.0


@dataclass(frozen=True, eq=False)
class Change(Document):
    """An error without effects and with them."""

    before: float = math.nan
    after: float = math.nan


@dataclass(frozen=True, eq=False)
class RunChange(Change):
    """The rms error of predictions from the first state to the end of each run."""

    unit: str = ""


@dataclass(frozen=True, eq=False)
class Gap(Document):
    """The prediction error in units of the noise that one diagnosis estimates, before and after.

    Figures of two diagnoses don't compare; verdicts rest on `prediction_error`, not on these.
    """

    horizon_s: float = math.nan
    unit: str = ""
    before: float = math.nan
    after: float = math.nan
    floor: float = math.nan
    held_out: bool = False
    channels: Mapping[str, Change] = field(default_factory=dict)

    @property
    def measured(self) -> bool:
        """Whether the document has a gap at all."""
        return self != Gap()


@dataclass(frozen=True, eq=False)
class UtilityPrediction(Document):
    """Rms error of predicted utilities of whole trials, without the effects and with them."""

    trials: int = 0
    unit: str = field(metadata=BRIEF, default="")
    before: float = math.nan  # NaN: the predicted run diverged
    after: float = math.nan
    spread: float = field(metadata=BRIEF, default=math.nan)  # standard deviation of the real ones
    mean: float = field(metadata=BRIEF, default=math.nan)
    feedback: bool = False  # trials had one, the predictions lack it


@dataclass(frozen=True, eq=False)
class RulerRow(Document):
    """Rms errors of held-out open-loop predictions over one horizon, by channel in its unit.

    held_out: by "trials", by "pieces" of one long log, or "no" where there is too little.
    outset: of the model before anything was adopted; empty where nothing was.
    calibrated: with the model's own parameters fitted; empty where none may move.
    floor_from: "repeats" of a candidate, trials whose commands are "alike", or the "short horizon",
        whose noise is carried on.
    floor_at_most: the noise is no more than `noise_floor` and may be far less: nothing was
        repeated, and what one step leaves isn't white, so part of it is the model's error.
    runs_away: by column ("crude" ...), the channels whose prediction leaves all that was measured
        far behind, as open-loop ones of an unstable plant do: how far says nothing.
    floor_unsure: standard deviation of the logarithm of the scatter of few or short repeats.
    drowned: noise alone takes a state beyond all that was measured of it by then: of no channel is
        anything to be told so far ahead, open loop.
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
        """Whether the errors of a channel in these columns mean something: none runs away."""
        return not any(name in self.runs_away.get(column, ()) for column in columns)


def gain(rows: Sequence[RulerRow], before: str, after: str) -> float:
    """What the errors of one column are less than another's, over channels and horizons.

    Args:
        rows: of the ruler.
        before: "outset", "crude", "calibrated" or "with_effects".
        after: likewise.

    Returns:
        The sum of the logarithms; 0 where nothing can be told.
    """
    ratios = [
        math.log(was / now)
        for row in rows
        for name, now in getattr(row, after).items()
        if now > 0 and (was := getattr(row, before).get(name, 0)) > 0
        if row.tells(name, before, after)
    ]
    return sum(ratios)


def furthest(rows: Sequence[RulerRow]) -> RulerRow | None:
    """The longest horizon at which noise leaves something to be told, or else the shortest."""
    ahead = [row for row in rows if not row.whole_trial]
    return next((row for row in reversed(ahead) if not row.drowned), ahead[0] if ahead else None)


def runaway(rows: Sequence[RulerRow]) -> str:
    """Of whole trials, whose predictions run away whatever is claimed; "" where none does."""
    whole = next((row for row in rows if row.whole_trial), None)
    names = () if whole is None else whole.runs_away.get("with_effects", ())
    if not names:
        return ""
    return f"Open-loop predictions of whole trials diverge for {', '.join(names)}."


@dataclass(frozen=True, eq=False)
class Credit(Document):
    """What an effect, or the "calibration", is worth: what predictions lose without it.

    share: of what predictions gain in all, by the logarithm of their errors, over channels and
    horizons; without_it: rms by channel, 1 s ahead, all the rest fitted again.
    """

    of: str
    share: float = math.nan
    without_it: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Remainder(Document):
    """A leftover that no known effect explains.

    size: rms of the rate that a state lacks, where a flexible model finds one [unit of the state
    per second]; error: rms of predictions `horizon_s` ahead, which noise alone leaves at `floor`,
    or at less (`floor_at_most`).
    """

    channel: str
    size: float = math.nan
    unit: str = ""
    evidence: float = math.nan  # [nats]
    region: Region | None = None  # that holds most of it
    error: float = math.nan
    floor: float = math.nan
    horizon_s: float = math.nan
    error_unit: str = ""
    floor_at_most: bool = False

    @property
    def above(self) -> bool:
        """Whether it is more than noise may be: a mere bound tells nothing below it."""
        return not (self.floor > 0 and self.error <= ABOVE * self.floor)

    def sentence(self) -> str:
        """One clause."""
        where = "" if self.region is None else f", mostly where {self.region.told}"
        if not math.isfinite(self.error):
            return f"{self.channel} is off by {number(self.size)} {self.unit} rms{where}"
        ahead, name = f"{number(self.horizon_s)} s ahead", self.channel
        errors, unit = [self.error], self.error_unit
        if not self.above and math.isfinite(self.size):
            [off, _] = beside_noise(errors, self.floor, unit, at_most=self.floor_at_most)
            return (
                f"the rate of {name} lacks {number(self.size)} {self.unit} rms{where}; it lasts, "
                f"although the {off} that {name} is off {ahead} may be noise alone"
            )
        [off, noise] = beside_noise(errors, self.floor, unit, at_most=self.floor_at_most)
        return f"{name} is still off by {off} {ahead}{noise}{where}"


def doubt_of(unsure: float) -> float:
    """The factor within which noise is known: by how much an error exceeds it without a cause.

    Args:
        unsure: standard deviation of its logarithm, `RulerRow.floor_unsure`.
    """
    return max(ABOVE, math.exp(SURE * unsure))


def beside_noise(errors: Sequence[float], floor: float, unit: str, *, at_most: bool) -> list[str]:
    """Errors as text in one unit, then `" (noise: 0.1 rad)"`; a mere bound is told as one.

    Args:
        errors: the first is the one that noise is told beside.
        floor: what noise alone leaves; none is told of what is not known.
        unit: of all of them.
        at_most: `floor` is a bound.
    """
    if not 0 < floor < math.inf:
        return [*measured_alike(errors, unit), ""]
    if at_most and errors[0] <= ABOVE * floor:
        bound = " (noise: at most that; only repeated trials can show)"
        return [*measured_alike(errors, unit), bound]
    *told, noise = measured_alike([*errors, floor], unit)
    return [*told, f" (noise: {'at most ' * at_most}{noise})"]
