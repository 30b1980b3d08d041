"""What a diagnosis says: a tree of frozen values, which is also its JSON document.

`to_json` gives the document of `diagnose --json`; `from_json` reads it back, including older
versions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any, Self

from grounded.accounts.finding import Finding as Fault
from grounded.accounts.finding import late_effects
from grounded.checks import known
from grounded.diagnosis.error_report import (
    BRIEF,
    Combination,
    Correction,
    Credit,
    Gap,
    Identifiable,
    Remainder,
    RulerRow,
    Where,
    furthest,
    lost_most,
)
from grounded.diagnosis.levels import SHOWS
from grounded.diagnosis.telling import LINES, NEXT, accuracy_figure, instrument_lines, told
from grounded.errors import NextCommand
from grounded.figures import Figure
from grounded.findings import Finding, found
from grounded.result import Document, figure, html_table, number, or_zero, seen, spread, with_unit

POWERS_FROM, MOST_DIGITS = 1e3, 6  # a value; significant digits of one
UNKNOWABLE = (  # codes of what the trials can't show
    *("model.few", "model.still", "model.unmeasured", "model.share", "model.copy"),
)
UNKNOWN = 1e4  # times a value, at least of 1: standard deviation from which it is unknown


@dataclass(frozen=True, eq=False)
class Verdict(Document):
    """The verdict: its kind, and the effects that it claims.

    `causes` has the words of each entry of `Diagnosis.credit`. `parameters` are off. `again`:
    whether as many effects are named as were looked for and more is left, so that one may diagnose
    again once these are adopted. `limit`: the code of the finding for which no cause is named.
    """

    kind: str  # "effect", "several", "none" or "unknown"
    effects: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    again: bool = field(metadata=BRIEF, default=False)
    limit: str = field(metadata=BRIEF, default="")


@dataclass(frozen=True, eq=False)
class Estimate(Document):
    """A value, its standard deviation, its 95 % interval (None in older documents), its unit."""

    value: float
    std: float = math.nan
    interval: tuple[float, float] | None = field(metadata=BRIEF, default=None)
    unit: str = ""
    stopped: str = field(metadata=BRIEF, default="")  # the bound that it reached (`Param`)

    @property
    def text(self) -> str:
        """The value with as many digits as its +- supports: `1.5763 +- 0.0012 N/V`."""
        value, std = self.value, self.std
        if not (0 < std < math.inf and math.isfinite(value)) or or_zero(std, value) == 0:
            return with_unit(number(value), self.unit)
        value = seen(value, std)
        places = math.floor(math.log10(max(abs(value), std))) - math.floor(math.log10(std)) + 2
        digits = min(max(places, 3), MOST_DIGITS)
        large = abs(value) >= POWERS_FROM  # a few digits would give it a power of ten
        shown = figure(value, digits) if large else f"{value:#.{digits}g}".rstrip(".")
        return with_unit(f"{shown if value else 0} +- {spread(std)}", self.unit)

    @property
    def known(self) -> bool:
        """Whether its standard deviation is not so large that the value means nothing."""
        return not self.std > UNKNOWN * max(abs(self.value), 1.0)

    def moved(self, by: float) -> Estimate:
        """Return the estimate shifted by a constant."""
        ends = None if self.interval is None else (self.interval[0] + by, self.interval[1] + by)
        return Estimate(self.value + by, self.std, ends, self.unit)


@dataclass(frozen=True, eq=False)
class Ranked(Document):
    """One explanation: its values, evidence [nats] over the model alone, the gap that it leaves."""

    effect: str
    params: Mapping[str, Estimate] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)  # constants, which are not fitted
    evidence: float = math.nan
    gap_after: float = math.nan
    shrinkage: float = math.nan  # share of the gap that it closes
    claimed: bool = False

    @property
    def values(self) -> dict[str, float]:
        """All its quantities, as `grounded.effects.wrap` takes them."""
        return {name: e.value for name, e in self.params.items()} | dict(self.fixed)


@dataclass(frozen=True, eq=False)
class Unconfirmed(Document):
    """A likely effect that only one group of trials shows: these."""

    effect: str
    params: Mapping[str, Estimate] = field(default_factory=dict)
    evidence: float = math.nan  # [nats]
    trials: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class NoiseLevels(Document):
    """The estimated noise: standard deviations by state."""

    process: Mapping[str, float] = field(default_factory=dict)
    measurement: Mapping[str, float] = field(default_factory=dict)
    correlation_s: float = math.nan  # of process noise; NaN if it is white
    outliers: bool = False


@dataclass(frozen=True, eq=False)
class TrialValue(Document):
    """A claimed value as estimated from one trial alone, all other values held."""

    trial: str
    effect: str
    quantity: str = ""
    value: float = math.nan
    std: float = math.nan
    agrees: bool = True  # with the others


@dataclass(frozen=True, eq=False)
class Agreement(Document):
    """Whether the trials agree on a value; `chance` is the p-value of their differences.

    `estimate` is the common value; its `std` is the scatter of the trials beyond their own
    uncertainty.
    """

    effect: str
    quantity: str = ""
    agrees: bool = True
    chance: float = math.nan
    estimate: Estimate = field(default_factory=lambda: Estimate(math.nan))


@dataclass(frozen=True, eq=False)
class Changed(Document):
    """A value in each of two groups of trials, and the evidence that it differs [nats]."""

    effect: str
    quantity: str = ""
    first: Estimate = field(default_factory=lambda: Estimate(math.nan))
    second: Estimate = field(default_factory=lambda: Estimate(math.nan))
    evidence: float = math.nan
    chance: float = math.nan  # p-value of the difference


@dataclass(frozen=True, eq=False)
class Made(Document):
    """What a diagnosis was made from: stored trials, and the model at that time."""

    trials: tuple[str, ...] = ()
    adopted: tuple[Mapping[str, Any], ...] = ()  # {"name": "dead_zone:throttle", "c": 0.146}
    params: Mapping[str, float] | None = field(metadata=BRIEF, default=None)  # [model] params
    nominal: Mapping[str, float] = field(default_factory=dict)  # values of all parameters
    named: tuple[str, ...] = ()  # trials named by the user, if not all were used
    compared: tuple[str, ...] = ()  # the second group
    without: tuple[str, ...] = ()  # families that were excluded
    model: str = field(metadata=BRIEF, default="")  # fingerprint of the model and its limits
    rows_s: float = field(metadata=BRIEF, default=0.0)  # see `Gridded.row_s`; 0: of no such table
    interpolated_s: float = field(metadata=BRIEF, default=0.0)  # see `Gridded.interpolated_s`

    def __post_init__(self) -> None:
        if not all("name" in effect for effect in self.adopted):
            raise ValueError("an adopted effect has no 'name'")

    @property
    def effects(self) -> dict[str, dict[str, Any]]:
        """The adopted effects by name."""
        return {str(effect["name"]): dict(effect) for effect in self.adopted}


@dataclass(frozen=True, eq=False)
class TrialGroup(Document):
    """Trials of one motion in one condition, and the signals whose levels set them apart."""

    id: str
    trials: tuple[str, ...] = ()
    differs_in: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Score(Document):
    """Held-out log scores of open-loop predictions, of which the rule chooses.

    A score is minus the mean logarithm of the rms errors, over states and horizons, in units of
    each state's spread. The standard error is that of the reference's lead over the choice.
    """

    crude: float = math.nan
    chosen: float = math.nan
    reference: float = math.nan
    standard_error: float = math.nan


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Document):
    """The result of a diagnosis, as in `diagnose --json`."""

    verdict: Verdict
    where: Where = field(default_factory=Where)
    ranking: tuple[Ranked, ...] = ()  # claimed effects first, then rejected ones
    indistinguishable: tuple[tuple[str, ...], ...] = ()  # groups that these trials can't separate
    equivalent: tuple[tuple[str, ...], ...] = ()  # groups that no trial can separate
    acting: tuple[str, ...] = ()  # the claimed effects in the order in which they act
    gap: Gap = field(default_factory=Gap)
    leftover: tuple[Remainder, ...] = ()
    unconfirmed: tuple[Unconfirmed, ...] = ()  # likely, but shown by one group of trials
    correction: Correction | None = None  # if there is a leftover
    noise: NoiseLevels = field(default_factory=NoiseLevels)
    parameters: Mapping[str, Estimate] = field(default_factory=dict)  # calibrated beside effects
    identifiable: tuple[Identifiable, ...] = ()  # each uncertain parameter
    combinations: tuple[Combination, ...] = ()  # values that show only in combination
    prediction_error: tuple[RulerRow, ...] = ()  # by horizon, the whole trial last
    credit: tuple[Credit, ...] = ()  # largest first
    preflight: tuple[Fault, ...] = ()  # of the sensors, before any physics
    per_trial: tuple[TrialValue, ...] = ()
    agreement: tuple[Agreement, ...] = ()  # of the trials in each of these values
    changed: tuple[Changed, ...] | None = field(metadata=BRIEF, default=None)  # between two groups
    trials: int = 0
    groups: tuple[TrialGroup, ...] = ()  # trials that differ in motion or condition
    held_out: str = "no"  # what values were not fitted on: groups, trials, pieces of a log, no
    score: Score = field(default_factory=Score)
    steps: int = 0
    candidates: int = 0
    made: Made = field(metadata={"key": "diagnosed"}, default_factory=Made)
    tracked: tuple[str, ...] = ()  # states that the task follows, the most important first
    findings: tuple[Finding, ...] = ()  # what is told of it, and the next trial
    probe: str = field(metadata=BRIEF, default="")  # candidate that separates tied explanations
    then: NextCommand | None = field(metadata={"key": ""}, default=None)  # next command

    def __repr__(self) -> str:
        named = ", ".join(self.effects) or "no effect"
        gap = f"{number(self.gap.before)} -> {number(self.gap.after)}"
        return f"Diagnosis({self.kind}: {named}; gap {gap}; {self.trials} trials)"

    @property
    def kind(self) -> str:
        """Kind of the verdict: "effect", "several", "none" or "unknown"."""
        return self.verdict.kind

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the claimed effects."""
        return self.verdict.effects

    @property
    def joining(self) -> dict[str, dict[str, float]]:
        """Quantities of the claimed effects, in the order in which they act, for `Search.adopt`.

        Parameters in `known_parameters` are not repeated here.
        """
        known = self.known_parameters
        own = {n for n in self.effects if n.removeprefix("parameter:") not in known}
        return {n: self.values(n) for n in self.acting or self.effects if n in own}

    @property
    def separable(self) -> list[tuple[str, ...]]:
        """The groups of indistinguishable effects that another trial may tell apart."""
        return [group for group in self.indistinguishable if group not in self.equivalent]

    @property
    def doubt(self) -> Finding | None:
        """Why adopting the claimed effects is unwise; None if it is not.

        It is if predictions lose more than they gain, or get worse somewhere while the trials
        disagree about the effects' values; also if they gain little beside a gap that remains, and
        all of them tie with others or the gap is wide.
        """
        effects, why = self.effects, ""
        if not effects:
            return None
        lost, row = lost_most(self.prediction_error), furthest(self.prediction_error)
        gap, wide = any(one.above for one in self.leftover), any(one.wide for one in self.leftover)
        tied = all(any(name in group for group in self.separable) for name in effects)
        gains = [] if row is None else [*row.gains.values()]
        differ = {one.effect for one in self.agreement if not one.agrees} & {*effects}
        if lost is not None and lost[0].loses:
            why = "worse"
        elif gap and (wide or tied) and gains and sum(gains) < SHOWS * len(gains):
            why = "little"
        elif differ and lost is not None:
            why, effects = "disagree", tuple(name for name in effects if name in differ)
        return found("gap.next.doubt", *effects, why=why) if why else None

    @property
    def next_trial(self) -> str:
        """What to run next, in words; "" in a document of an older version."""
        return next((one.sentence for one in self.findings if one.code.startswith(NEXT)), "")

    def asking(self, step: Finding, probe: str = "") -> Self:
        """Return the diagnosis with another next step, and the candidate that it runs."""
        kept = (one for one in self.findings if not one.code.startswith(NEXT))
        return replace(self, findings=(*kept, step), probe=probe)

    @property
    def no_cause(self) -> bool:
        """Whether the data are insufficient to name any cause; figures mean nothing then."""
        return bool(self.verdict.limit)

    def ranked(self, effect: str) -> Ranked | None:
        """Return the row of an effect, or None if it is not in the ranking."""
        return next((row for row in self.ranking if row.effect == effect), None)

    def values(self, effect: str) -> dict[str, float]:
        """Return an effect's quantities, constants included, each in the model's unit.

        Args:
            effect: a name in `quantities`; the claimed ones are `effects`.

        Raises:
            GroundedError: if the diagnosis has no values of this effect.
        """
        each = self.quantities
        known("value of the effect", [effect], each, "this diagnosis")
        return each[effect]

    @property
    def quantities(self) -> dict[str, dict[str, float]]:
        """Quantities by effect: of ranked effects, late sensors and the correction's curves."""
        curves = self.correction.curves if self.correction is not None else ()
        ranked = {row.effect: row.values for row in reversed(self.ranking)}
        drawn = {curve.effect: dict(curve.quantities) for curve in curves}
        return self.late_sensors | ranked | drawn

    @property
    def late_sensors(self) -> dict[str, dict[str, float]]:
        """Filters and delays of sensors that were found and corrected, as effects by name.

        The diagnosis is made without them, but a controller's feedback passes through them.
        """
        return late_effects(self.preflight)

    @property
    def known_parameters(self) -> dict[str, Estimate]:
        """The calibrated parameters that the trials identify, which may be adopted."""
        lost = {one.parameter for one in self.identifiable if one.lost}
        return {name: e for name, e in self.parameters.items() if name not in lost}

    @property
    def adoptable(self) -> dict[str, Estimate]:
        """The calibrated parameters that are adopted with the effects: the trials identify them.

        One that changed by less than its error is none if a bound cut it, or if it was 0.
        """
        nominal = self.made.nominal

        def tells(e: Estimate, was: float) -> bool:
            return abs(e.value - was) > e.std or not (e.stopped or was == 0)

        known = self.known_parameters.items()
        return {name: e for name, e in known if tells(e, nominal.get(name, math.inf))}

    @property
    def combined(self) -> set[str]:
        """The effects and parameters that the trials show only in combination."""
        return {name for one in self.combinations for name in one.values}

    @property
    def conditions(self) -> dict[str, tuple[str, ...]]:
        """Parameters by what holds only if they are right: a calibrated parameter or an effect."""
        rests = {one.parameter: tuple(one.given) for one in self.identifiable if one.given}
        for one in self.combinations:
            if one.rests_on:
                rests |= dict.fromkeys(one.values, tuple(one.rests_on))
        return rests

    @property
    def jointly(self) -> set[str]:
        """The calibrated parameters that the trials identify only together with the others."""
        return {one.parameter for one in self.identifiable if one.jointly}

    def open(
        self, adopted: Iterable[Mapping[str, Any]], params: Mapping[str, float] | None = None
    ) -> tuple[str, ...]:
        """Return the claimed effects that have not been adopted or changed since the diagnosis.

        Args:
            adopted: effects, as in [model] effects.
            params: the model's parameters, as in [model] params.
        """
        now, then = _numbers(adopted, params), _numbers(self.made.adopted, self.made.params)
        return tuple(name for name in self.effects if now.get(name) == then.get(name))

    @classmethod
    def from_json(cls, document: Any) -> Self:
        """Read what `to_json` wrote; findings of other versions are left out."""
        read = super().from_json(document)
        kept = (one for one in read.findings if one.printable and one.code not in LINES)
        return replace(read, findings=tuple(kept))

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        return " ".join(told(self).texts(None))

    def to_json(self) -> dict[str, Any]:
        """Return the document of `diagnose --json`, with what its findings say in words."""
        document, told_now = super().to_json(), (*told(self).lines, *self.findings)
        document["verdict"]["sentence"] = self.sentence
        document["findings"] = [one.to_json() for one in told_now]
        document["next_trial"] = self.next_trial
        document["unknowable"] = [one.sentence for one in told_now if one.code in UNKNOWABLE]
        return document

    def figures(self) -> Sequence[Figure]:
        """Return the figure of predictions before and after, if there is one."""
        drawn = accuracy_figure(self)
        return [] if drawn is None else [drawn]

    def _repr_html_(self) -> str:
        """Return what is told, with the sensors' faults and the table; the rest is folded."""
        said = told(self)
        parts = [f"<b>{escape(self.kind)}</b>", *(f"<p>{escape(t)}</p>" for t in said.texts())]
        if sensors := instrument_lines(self.preflight):
            items = "".join(f"<li>{escape(line)}</li>" for line in sensors)
            parts.append(f"<b>Sensors</b><ul>{items}</ul>")
        if said.rows:
            parts.append(html_table(said.rows, said.header))
        if said.next:
            parts.append(f"<p><b>Next trial</b>: {escape(said.next)}</p>")
        everything = super()._repr_html_()
        parts.append(f"<details><summary>The whole document</summary>{everything}</details>")
        return "".join(parts)


def _numbers(
    effects: Iterable[Mapping[str, Any]], params: Mapping[str, float] | None
) -> dict[str, Any]:
    """Return all numbers of a model: effects by name, and every number as `parameter:NAME`.

    Numbers of an effect are parameters, too: that of `viscous_friction:vz` is called
    `viscous_friction_vz_k`.
    """
    from grounded.effects import param_name

    found: dict[str, Any] = {f"parameter:{name}": value for name, value in (params or {}).items()}
    for effect in map(dict, effects):
        name = str(effect["name"])
        found[name] = effect
        found |= {f"parameter:{param_name(name, key)}": value for key, value in effect.items()}
    return found
