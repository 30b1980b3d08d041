"""What a diagnosis says: one tree of frozen values, and the JSON document that it is kept as.

Command, page, pictures, recording and notebook all take a `Diagnosis`; `to_json` gives the document
of `diagnose --json` and `from_json` reads it back, an older one too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from grounded.instruments.finding import Finding
from grounded.result import Document

if TYPE_CHECKING:
    from grounded.figures.figure import Figure

BRIEF: dict[str, Any] = {"brief": True}  # a field whose key is left out where there is nothing

Kind = Literal["effect", "several", "none", "unknown"]


@dataclass(frozen=True, eq=False)
class Verdict(Document):
    """The answer: its kind, the effects that it claims, and why, in sentences."""

    kind: str  # one of `Kind`
    effects: tuple[str, ...] = ()
    sentence: str = ""


@dataclass(frozen=True, eq=False)
class ChannelShare(Document):
    """A state's part of the gap, the rms of its prediction error and of its noise alone."""

    name: str
    share: float  # 0 to 1
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

    The irreducible part comes from "repeats" of a candidate, trials "alike", or the "noise".
    """

    horizon_s: float
    whole: Parts = field(metadata={"key": "all"})
    channels: tuple[ChannelParts, ...] = ()
    irreducible_from: str = "noise"


@dataclass(frozen=True, eq=False)
class Where(Document):
    """Where the gap lies, and what is left of it: the largest shares first.

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
class Estimate(Document):
    """A value, its standard deviation, its 95 % interval (None in older documents), its unit."""

    value: float
    std: float = math.nan
    interval: tuple[float, float] | None = field(metadata=BRIEF, default=None)
    unit: str = ""


@dataclass(frozen=True, eq=False)
class Ranked(Document):
    """One explanation: its values, evidence [nats] over the model alone, the gap that it leaves."""

    effect: str
    params: Mapping[str, Estimate] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)  # quantities that are no parameters
    evidence: float = math.nan
    gap_after: float = math.nan
    shrinkage: float = math.nan  # the share of the gap that it closes
    claimed: bool = False

    @property
    def values(self) -> dict[str, float]:
        """All its quantities, as `grounded.effects.wrap` wants them."""
        return {name: e.value for name, e in self.params.items()} | dict(self.fixed)


@dataclass(frozen=True, eq=False)
class Likeness(Document):
    """A candidate that reproduces a share of a claimed effect's signal."""

    effect: str
    like: str
    share: float = math.nan


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
    calibrated: with the model's own parameters fitted; empty where none may move.
    floor_from: "repeats" of a candidate, trials whose commands are "alike", or the "short horizon",
        whose noise is carried on.
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
    per second]; error: rms of predictions `horizon_s` ahead, which noise alone leaves at `floor`.
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

    def sentence(self) -> str:
        """One clause."""
        where = "" if self.region is None else f", mostly where {self.region.when}"
        if not math.isfinite(self.error):
            return f"{self.channel} is off by {number(self.size)} {self.unit} rms{where}"
        noise = f" ({number(self.floor)} is noise)" if math.isfinite(self.floor) else ""
        unit = "" if self.error_unit == "1" else f" {self.error_unit}"
        ahead = f"{number(self.horizon_s)} s ahead"
        return f"{self.channel} is still off by {number(self.error)}{unit} {ahead}{noise}{where}"


@dataclass(frozen=True, eq=False)
class Identifiable(Document):
    """How well the trials tell one uncertain parameter, all others free.

    left: of its prior standard deviation `prior`, 0 to 1.
    """

    parameter: str
    verdict: str  # identifiable, weak, not identifiable
    prior: float = math.nan
    left: float = math.nan


@dataclass(frozen=True, eq=False)
class NoiseLevels(Document):
    """The noise as it was estimated: a standard deviation for each state."""

    process: Mapping[str, float] = field(default_factory=dict)
    measurement: Mapping[str, float] = field(default_factory=dict)
    correlation_s: float = math.nan  # of process noise; NaN where it is white
    outliers: bool = False


@dataclass(frozen=True, eq=False)
class TrialValue(Document):
    """What one trial alone says of a claimed value, all others as they are."""

    trial: str
    effect: str
    quantity: str = ""
    value: float = math.nan
    std: float = math.nan
    agrees: bool = True  # with the others


@dataclass(frozen=True, eq=False)
class Agreement(Document):
    """Whether the trials share a value: the chance of such differences if they do.

    `estimate` is the shared value; its `std` is what trials differ by beyond their own uncertainty.
    """

    effect: str
    quantity: str = ""
    agrees: bool = True
    chance: float = math.nan
    estimate: Estimate = field(default_factory=lambda: Estimate(math.nan))
    goes_with: str = ""  # "rises with the mean throttle"


@dataclass(frozen=True, eq=False)
class Changed(Document):
    """A value that differs between two groups of trials, and the evidence [nats] that it does."""

    effect: str
    quantity: str = ""
    first: Estimate = field(default_factory=lambda: Estimate(math.nan))
    second: Estimate = field(default_factory=lambda: Estimate(math.nan))
    evidence: float = math.nan
    chance: float = math.nan  # of such a difference where there is none


@dataclass(frozen=True, eq=False)
class Curve(Document):
    """The shape of a leftover: a rate `value` with its `std` at places `at` of one variable."""

    effect: str  # its name for `adopt`
    over: str
    at: tuple[float, ...] = ()
    value: tuple[float, ...] = ()
    std: tuple[float, ...] = ()
    quantities: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Correction(Document):
    """A curve that predicts what no effect explains. It is no cause.

    `held_out_gain` is the share of the squared error that goes on held-out trials; `adoptable`:
    that is more than its scatter from trial to trial.
    """

    channel: str
    over: tuple[str, ...] = ()
    held_out_gain: float = math.nan
    adoptable: bool = False
    unit: str = ""
    curves: tuple[Curve, ...] = ()


@dataclass(frozen=True, eq=False)
class Made(Document):
    """What a diagnosis was made from: stored trials, and the model of that day."""

    trials: tuple[str, ...] = ()
    adopted: tuple[Mapping[str, Any], ...] = ()  # {"name": "dead_zone:throttle", "c": 0.146}
    params: Mapping[str, float] | None = field(metadata=BRIEF, default=None)  # of [model]
    nominal: Mapping[str, float] = field(default_factory=dict)  # the values of all parameters

    def __post_init__(self) -> None:
        if not all("name" in effect for effect in self.adopted):
            raise ValueError("an adopted effect has no 'name'")

    @property
    def effects(self) -> dict[str, dict[str, Any]]:
        """The adopted effects by name."""
        return {str(effect["name"]): dict(effect) for effect in self.adopted}


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Document):
    """All that a diagnosis found, as `diagnose --json` has it."""

    verdict: Verdict
    where: Where = field(default_factory=Where)
    ranking: tuple[Ranked, ...] = ()  # what is claimed first, then what lost
    indistinguishable: tuple[tuple[str, ...], ...] = ()
    equivalent: tuple[tuple[str, ...], ...] = ()  # in any trial
    lookalikes: tuple[Likeness, ...] = ()  # that hardly differ from a claimed effect
    gap: Gap = field(default_factory=Gap)
    utility_prediction: UtilityPrediction | None = None  # where the subject was a task
    whole_run: Mapping[str, RunChange] = field(default_factory=dict)
    leftover: tuple[Remainder, ...] = ()
    correction: Correction | None = None  # where something is left
    next_trial: str = ""
    unknowable: tuple[str, ...] = ()  # what the trials are too few or too quiet for
    noise: NoiseLevels = field(default_factory=NoiseLevels)
    parameters: Mapping[str, Estimate] = field(default_factory=dict)  # calibrated beside effects
    identifiable: tuple[Identifiable, ...] = ()  # each uncertain parameter
    prediction_error: tuple[RulerRow, ...] = ()  # by horizon, the whole trial last
    credit: tuple[Credit, ...] = ()  # largest first
    preflight: tuple[Finding, ...] = ()  # of the instruments, before any physics
    per_trial: tuple[TrialValue, ...] = ()
    agreement: tuple[Agreement, ...] = ()  # of the trials in each of these values
    changed: tuple[Changed, ...] | None = field(metadata=BRIEF, default=None)  # of two groups
    trials: int = 0
    steps: int = 0
    candidates: int = 0
    made: Made | None = field(metadata=BRIEF | {"key": "diagnosed"}, default=None)  # in a workspace
    probe: str = field(metadata=BRIEF, default="")  # the candidate that tells what ties apart

    def __repr__(self) -> str:
        named = ", ".join(self.effects) or "no effect"
        gap = f"{number(self.gap.before)} -> {number(self.gap.after)}"
        return f"Diagnosis({self.kind}: {named}; gap {gap}; {self.trials} trials)"

    def figures(self) -> Sequence[Figure]:
        """Predictions before and after, the credit, where the gap lies."""
        from grounded.diagnosis.pictures import gap_figures

        return gap_figures(self)

    @property
    def kind(self) -> str:
        """Of the verdict: one effect, several, none or unknown."""
        return self.verdict.kind

    @property
    def effects(self) -> tuple[str, ...]:
        """Those that the verdict claims."""
        return self.verdict.effects

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        return self.verdict.sentence

    @property
    def no_cause(self) -> bool:
        """Whether too little is known to name any cause: its figures mean nothing then."""
        return self.kind == "unknown" and any(text in self.sentence for text in self.unknowable)

    def ranked(self, effect: str) -> Ranked | None:
        """The row of an effect, None where it was not weighed."""
        return next((row for row in self.ranking if row.effect == effect), None)

    def values(self, effect: str) -> dict[str, float]:
        """An effect's quantities, fixed ones included; none where it was not weighed."""
        for curve in self.correction.curves if self.correction is not None else ():
            if effect == curve.effect:
                return dict(curve.quantities)
        row = self.ranked(effect)
        return {} if row is None else row.values

    @property
    def known_parameters(self) -> dict[str, Estimate]:
        """The calibrated parameters that the trials identify: what may be adopted."""
        lost = {i.parameter for i in self.identifiable if i.verdict == "not identifiable"}
        return {name: e for name, e in self.parameters.items() if name not in lost}

    def open(self, adopted: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
        """The claimed effects that the model with these adopted ones lacks as it did then."""
        now = {str(effect["name"]): dict(effect) for effect in adopted}
        then = self.made.effects if self.made is not None else {}
        return tuple(name for name in self.effects if now.get(name) == then.get(name))


def number(value: float) -> str:
    """Three digits."""
    return f"{value:.3g}"


def quantity(estimate: Estimate) -> str:
    """A value with its unit; pure numbers as they are."""
    unit = "" if estimate.unit == "1" else f" {estimate.unit}"
    return f"{number(estimate.value)}{unit}"
