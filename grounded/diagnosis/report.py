"""What a diagnosis says: one tree of frozen values, and the JSON document that it is kept as.

Command, page, pictures, recording and notebook all take a `Diagnosis`; `to_json` gives the document
of `diagnose --json` and `from_json` reads it back, an older one too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from grounded.diagnosis.error_report import (
    BRIEF,
    Credit,
    Gap,
    Region,
    Remainder,
    RulerRow,
    RunChange,
    UtilityPrediction,
    Where,
)
from grounded.diagnosis.ruler_words import contested
from grounded.errors import NextCommand
from grounded.instruments.finding import Finding, late_effects
from grounded.result import Document, number

if TYPE_CHECKING:
    from grounded.figures.figure import Figure


Kind = Literal["effect", "several", "none", "unknown"]


@dataclass(frozen=True, eq=False)
class Verdict(Document):
    """The answer: its kind, the effects that it claims, and why.

    `sentences` is a line each, `sentence` their join; the first is made of `clauses`, which tell
    many `causes` (a clause each, in the order of `Diagnosis.credit`) by kind. `parameters` are the
    model's own that it calls off, beside effects or alone. `look_for` is how many effects to look
    for before any is adopted, where as many as were looked for leave more than noise; else 0.
    """

    kind: str  # one of `Kind`
    effects: tuple[str, ...] = ()
    sentence: str = ""
    causes: tuple[str, ...] = ()
    sentences: tuple[str, ...] = ()
    clauses: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    look_for: int = 0

    @property
    def lines(self) -> tuple[str, ...]:
        """The sentences; of an older document, all of them as one."""
        return self.sentences or (self.sentence or self.kind,)


@dataclass(frozen=True, eq=False)
class Estimate(Document):
    """A value, its standard deviation, its 95 % interval (None in older documents), its unit."""

    value: float
    std: float = math.nan
    interval: tuple[float, float] | None = field(metadata=BRIEF, default=None)
    unit: str = ""
    stopped: str = field(metadata=BRIEF, default="")  # what kept it from going on (`Param`)

    def moved(self, by: float) -> Estimate:
        """The same of a quantity that is so much larger."""
        ends = None if self.interval is None else (self.interval[0] + by, self.interval[1] + by)
        return Estimate(self.value + by, self.std, ends, self.unit)


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
    no_better: bool = False  # likely by evidence, but held-out trials are predicted no better

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
class Unconfirmed(Document):
    """A likely effect that few trials show, most of all `trial` from `start` to `end` [s].

    seen: how many trials hold most of what it does, of how many; region: where it does. repeats:
    they all make one motion, or nearly one: nothing tells it from whatever else repeats with that.
    """

    effect: str
    meaning: str = ""
    params: Mapping[str, Estimate] = field(default_factory=dict)
    evidence: float = math.nan  # [nats]
    trial: str = ""
    start: float = field(metadata={"key": "from"}, default=math.nan)
    end: float = field(metadata={"key": "to"}, default=math.nan)
    seen: tuple[int, int] = (1, 1)
    region: Region | None = None
    repeats: bool = False

    def sentence(self) -> str:
        """One clause."""
        few, all_ = self.seen
        if self.repeats:
            made = f"{few} of {all_}" if few < all_ else f"all {all_}"
            rest = f"or anything else that repeats with the motion of {made} trials"
            return f"unconfirmed: {self.meaning}, {rest}"
        where = "" if self.region is None else f", mostly where {self.region.told}"
        start, end = number(self.start), number(self.end)
        when = (
            f"trial {self.trial}, {f'{start} to {end}' if start != end else f'at {end}'} s{where}"
        )
        return f"unconfirmed, seen in {few} of {all_} trials: {self.meaning} ({when})"


@dataclass(frozen=True, eq=False)
class Identifiable(Document):
    """How well the trials tell one uncertain parameter, all others free.

    left: of its prior standard deviation `prior`, 0 to 1. given: those that were held at their
    values though the trials don't tell them, by how many percent it is off for each percent that
    one of them is (1: only the ratio is known). Its `+-` holds with them as they are.
    """

    parameter: str
    verdict: str  # identifiable, weak, not identifiable
    prior: float = math.nan
    left: float = math.nan
    given: Mapping[str, float] = field(metadata=BRIEF, default_factory=dict)


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
    """A value in each of two groups of trials, and the evidence [nats] that it differs."""

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
    named: tuple[str, ...] = ()  # the trials that were asked for, where not all that there are
    compared: tuple[str, ...] = ()  # the second group
    without: tuple[str, ...] = ()  # families that were not to be blamed

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
    acting: tuple[str, ...] = ()  # the claimed effects in the order in which they act
    gap: Gap = field(default_factory=Gap)
    utility_prediction: UtilityPrediction | None = None  # where the subject was a task
    whole_run: Mapping[str, RunChange] = field(default_factory=dict)
    leftover: tuple[Remainder, ...] = ()
    unconfirmed: tuple[Unconfirmed, ...] = ()  # no named causes
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
    unchanged: tuple[Changed, ...] = field(metadata=BRIEF, default=())  # alike in both groups
    trials: int = 0
    motions: int = field(metadata=BRIEF, default=0)  # that differ, among the trials
    steps: int = 0
    candidates: int = 0
    made: Made | None = field(metadata=BRIEF | {"key": "diagnosed"}, default=None)  # in a workspace
    probe: str = field(metadata=BRIEF, default="")  # the candidate that tells what ties apart
    then: NextCommand | None = field(metadata={"key": ""}, default=None)  # what to type next

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
    def joining(self) -> dict[str, dict[str, float]]:
        """The claimed effects' quantities, in the order in which they act: for `Search.adopt`.

        Beside `known_parameters`: what is one of these is not among them.
        """
        known = self.known_parameters
        own = {n for n in self.effects if n.removeprefix("parameter:") not in known}
        return {n: self.values(n) for n in self.acting or self.effects if n in own}

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        return self.verdict.sentence

    @property
    def contested(self) -> bool:
        """Whether what it claims is better not adopted: predictions get worse with it."""
        return contested(self.prediction_error, self.agreement, self.effects)

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
        return self.late_sensors.get(effect, {}) if row is None else row.values

    def _repr_html_(self) -> str:
        from grounded.diagnosis.tables import as_html

        return as_html(self, super()._repr_html_())

    @property
    def late_sensors(self) -> dict[str, dict[str, float]]:
        """The filters and delays of sensors that were found and corrected, as effects by name.

        The physics was judged without them; what a controller feeds back comes through them.
        """
        return late_effects(self.preflight)

    @property
    def known_parameters(self) -> dict[str, Estimate]:
        """The calibrated parameters that the trials identify: what may be adopted."""
        lost = {i.parameter for i in self.identifiable if i.verdict == "not identifiable"}
        return {name: e for name, e in self.parameters.items() if name not in lost}

    def open(
        self, adopted: Iterable[Mapping[str, Any]], params: Mapping[str, float] | None = None
    ) -> tuple[str, ...]:
        """The claimed effects that the model with these adopted ones lacks as it did then.

        Args:
            adopted: effects, as [model] effects has them.
            params: the model's parameters, as [model] params has them.
        """
        made = self.made or Made()
        now, then = _numbers(adopted, params), _numbers(made.adopted, made.params)
        return tuple(name for name in self.effects if now.get(name) == then.get(name))


def _numbers(
    effects: Iterable[Mapping[str, Any]], params: Mapping[str, float] | None
) -> dict[str, Any]:
    """What a model has, by the names of effects: their own, and `parameter:NAME` of every number.

    A number of an effect is a parameter too: that of `viscous_friction:vz` is called
    `viscous_friction_vz_k`.
    """
    from grounded.effects import param_name

    found: dict[str, Any] = {f"parameter:{name}": value for name, value in (params or {}).items()}
    for effect in map(dict, effects):
        name = str(effect["name"])
        found[name] = effect
        found |= {f"parameter:{param_name(name, key)}": value for key, value in effect.items()}
    return found
