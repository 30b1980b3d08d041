"""The result of a fit: values with intervals, and how it ended as findings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from grounded.accounts.finding import Finding as Fault
from grounded.diagnosis.error_report import Identifiable, RulerRow
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.levels import NATS
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.parts import Estimate
from grounded.diagnosis.validation.choose import Gain
from grounded.diagnosis.validation.identifiable import UNKNOWN, identified, values_of
from grounded.diagnosis.validation.ruler import Ruler
from grounded.findings import Finding
from grounded.findings import found as finding
from grounded.frozen import Array
from grounded.model import Model
from grounded.result import Result, document


@dataclass(frozen=True, eq=False)
class FittedValue:
    """A fitted quantity with its 95 % interval; `std` is infinite if it is not identified.

    `only_with` names what was held because the data tell only combinations of it with this one: the
    interval holds if those values are right.
    """

    value: float
    std: float
    low: float
    high: float
    unit: str
    identified: bool
    start: float
    only_with: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Result):
    """The result of a fit.

    `params` holds the model's parameters and the fitted `delays` [s].
    """

    params: Mapping[str, FittedValue]
    model: Model  # the model with the fitted values
    latency: Array  # (m,) [s]
    loglik: float
    status: str  # converged or still rising
    samples: int
    nats: float = 0.0  # log evidence over the values as given
    # one step and at most a second ahead, as given (`crude`) and fitted; () if none was held out
    prediction_error: tuple[RulerRow, ...] = ()
    gain: Gain | None = None  # of the held-out errors, and the same the other way round
    loss: Gain | None = None
    preflight: tuple[Fault, ...] = ()  # findings about the sensors
    findings: tuple[Finding, ...] = ()  # how it ended, and what the values rest on

    def __post_init__(self) -> None:
        object.__setattr__(self, "params", MappingProxyType(dict(self.params)))

    @property
    def sentence(self) -> str:
        """The findings in words."""
        return "; ".join(one.sentence for one in self.findings)

    @property
    def helps(self) -> bool:
        """Whether the values are likelier and predict held-out trials better (`choose`)."""
        better = self.gain is None or (self.gain.pays and not self.gain.ruins)
        return self.nats >= NATS and better

    @property
    def worse(self) -> bool:
        """Whether held-out trials are predicted worse than before, by as much as matters."""
        if self.gain is None or self.loss is None:
            return False
        return self.loss.clear or self.gain.ruins

    @property
    def at_bounds(self) -> tuple[str, ...]:
        """Names of the identified parameters that ended at a bound.

        Their intervals are cut there, and those of the others hold only with them there.
        """
        known = {n: e for n, e in self.params.items() if e.identified and n in self.model.params}
        return tuple(n for n, e in known.items() if self.model.params[n].at_bound(e.value))

    def summary(self) -> str:
        """Return the status and the values with their standard deviations."""
        found = ", ".join(f"{name} {e.value:.4g} +- {e.std:.2g}" for name, e in self.params.items())
        return f"{self.status}: {found}"

    def to_json(self) -> dict[str, Any]:
        """Return the document of `grounded fit --json`; the command sets "applied"."""
        return document(
            params={name: vars(e) for name, e in self.params.items()},
            status=self.status,
            sentence=self.sentence,
            findings=[one.to_json() for one in self.findings],
            samples=self.samples,
            at_bounds=list(self.at_bounds),
            applied=False,
            prediction_error=[row.to_json() for row in self.prediction_error],
        )


@dataclass(frozen=True, eq=False)
class Found:
    """What a search found, with the parameters held that the trials do not identify."""

    search: HypothesisSearch
    best: Fitted
    crude: Fitted | None  # with the values as given; None if it is not finite
    free: Predictor  # with all parameters free that were asked for
    delayed: Mapping[str, tuple[int, ...]]  # the inputs of each fitted delay

    @cached_property
    def unknowns(self) -> dict[str, tuple[float, float, float]]:
        """Each fitted delay [s] and parameter: value, standard deviation, half of its interval."""
        data, h = self.search.data, self.best.hypothesis
        late = [(name, float(data.latency[inputs[0]])) for name, inputs in self.delayed.items()]
        found, sure = {}, self.search.sure(self.best)
        for k, (one, std, half) in enumerate(zip(values_of(h, data), *sure, strict=True)):
            name, start = late[k] if one.effect else (one.quantity, 0.0)
            std, half = float(std) * one.scale, float(half) * one.scale
            found[name] = start + one.value, std, half
        return found

    @cached_property
    def told(self) -> dict[str, Identifiable]:
        """How well the trials identify each parameter that was asked for."""
        params = self.search.data.model.params
        known = {n: Estimate(v, s) for n, (v, s, _) in self.unknowns.items() if n in params}
        return {one.parameter: one for one in identified(self.free, self.best, known).parameters}


def errors_of(ruler: Ruler, before: Fitted, after: Fitted) -> tuple[RulerRow, ...]:
    """Return the held-out errors of two fits one step and, at most, a second ahead."""
    units = {name: ruler.data.model.states[name] for name in ruler.names}

    def row(k: int) -> RulerRow:
        crude, fitted = (
            dict(zip(units, ruler.errors(fit).rms[k, ruler.shown].tolist(), strict=True))
            for fit in (before, after)
        )
        horizon = ruler.steps[k] * ruler.data.dt
        return RulerRow(horizon, False, units, ruler.by, crude=crude, with_effects=fitted)

    return tuple(map(row, sorted({0, len(ruler.steps) - 1})))


def report(
    model: Model,
    asked: Sequence[str],
    found: Found,
    findings: Sequence[Fault] = (),
    shares: Sequence[Finding] = (),
) -> Fit:
    """Build the `Fit` of a finished search.

    Args:
        model: the model with start values.
        asked: the parameters that were to be fitted.
        found: the end of the search.
        findings: what the sensors show by themselves.
        shares: which parts of the trials were used, if not all.
    """
    search, best, data = found.search, found.best, found.search.data
    params, fitted = dict[str, FittedValue](), found.unknowns
    for name in asked:
        param = model.params[name]
        (low, high), start, unit = param.reach, param.value, param.unit
        if name not in fitted:
            params[name] = FittedValue(start, np.inf, low, high, unit, False, start)
            continue
        (value, e, w), given = fitted[name], (*found.told[name].given,)
        low, high = max(low, value - w), min(high, value + w)
        params[name] = FittedValue(value, e, low, high, unit, True, start, given)
    latency = data.latency.copy()
    for effect, (name, inputs) in zip(best.hypothesis.effects, found.delayed.items(), strict=True):
        q, start, (value, e, w) = effect.free[0], float(data.latency[inputs[0]]), fitted[name]
        known = e <= UNKNOWN * (q.high - q.low) / np.sqrt(12)
        e, ends = (
            (e, (max(value - w, 0.0), value + w)) if known else (np.inf, (0.0, start + q.high))
        )
        params[name] = FittedValue(value, e, *ends, "s", known, start)
        latency[list(inputs)] = value
    # held-out errors by the ruler of the diagnosis
    more: dict[str, Any] = {}
    ruler = Ruler(search.predictor)
    if found.crude is not None and ruler.held_out:
        ruler.beside(found.crude)
        more |= {"prediction_error": errors_of(ruler, found.crude, best)}
        more |= {"gain": ruler.gain(found.crude, best), "loss": ruler.gain(best, found.crude)}
    status = "converged" if best.settled else "still rising"
    made = Fit(
        params=params,
        model=model.with_values({n: fitted[n][0] for n in model.params if n in fitted}),
        latency=latency,
        loglik=best.loglik,
        status=status,
        samples=int(data.seen[1:].sum()),
        nats=np.inf if found.crude is None else search.score(best) - search.score(found.crude),
        preflight=tuple(findings),
        **more,
    )
    return replace(made, findings=(*_said(made), *shares))


def _said(found: Fit) -> Iterator[Finding]:
    """Yield how it ended, and what is not identified or at a bound."""
    yield finding(
        "model.fitted",
        settled="yes" if found.status == "converged" else "no",
        samples=found.samples,
        no_better=not found.helps,
    )
    lost = [name for name, e in found.params.items() if not e.identified]
    tied = {one: [n for n, e in found.params.items() if one in e.only_with] for one in lost}
    if alone := [name for name in lost if not tied[name]]:
        yield finding("model.not_told", *alone)
    for one, others in tied.items():
        if others:
            yield finding("model.given", *others, rests=(one,))
    if found.at_bounds:
        yield finding("model.at_bound", *found.at_bounds)
