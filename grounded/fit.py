"""fit: estimate the parameters of a model from trials, as a diagnosis does that has no candidates.

Its data, its likelihood, its held-out errors and its notion of what trials identify are those of
`grounded.diagnosis`. Sensor faults are corrected (`sound_data`), the parameters are shifted under
the whole of their priors, and what the trials do not identify stays as it was. A delay of inputs
that is fitted is the effect `delay`. The errors before and after are those of the `ruler`: every
group of trials is predicted with values from the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from grounded.accounts.finding import Finding as Fault
from grounded.checks import known, list_of, of_type, refused, wrong
from grounded.diagnosis.error_report import Identifiable, RulerRow
from grounded.diagnosis.hypotheses.search import (
    CRUDE,
    TO_THE_TOP,
    HypothesisSearch,
    Start,
    undefined,
)
from grounded.diagnosis.levels import NATS
from grounded.diagnosis.likelihood.data import Data, entire
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated, moved
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.intervals import FARTHEST_MOVE, level
from grounded.diagnosis.likelihood.linearise import thresholds
from grounded.diagnosis.likelihood.noise import Structure
from grounded.diagnosis.likelihood.polish import EVIDENCE_SETTLED as STILL
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.diagnosis.parts import Estimate
from grounded.diagnosis.validation.choose import Gain
from grounded.diagnosis.validation.identifiable import UNKNOWN, held, identified, values_of
from grounded.diagnosis.validation.limits import Sound, sound_data
from grounded.diagnosis.validation.ruler import Ruler
from grounded.effects import Effect, Library
from grounded.effects.actuator import delay_again
from grounded.engine import Engine, running, steady
from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.progress import Stages, interruptible
from grounded.result import Result, document
from grounded.task import Task
from grounded.trial import Trial

GRID = 21  # values of a threshold that are tried


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
        told = ", ".join(f"{name} {e.value:.4g} +- {e.std:.2g}" for name, e in self.params.items())
        return f"{self.status}: {told}"

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


@steady()
def fit(
    model: Model | Task,
    trials: Sequence[Trial],
    names: Sequence[str] | None = None,
    *,
    delays: Mapping[str, tuple[int, ...]] | None = None,
    hidden: Sequence[str] = (),
    one_message: Sequence[str] = (),
    interpolated_s: float = 0.0,
    engine: Engine | None = None,
    progress: Callable[[str], None] | None = None,
) -> Fit:
    """Estimate the parameters of a model from trials, with confidence intervals.

    Args:
        model: the model with start values, bounds and priors of its n states and m inputs; a `Task`
            also gives the latency.
        trials: real trials of one time step; a state that no sensor shows is NaN.
        names: parameters to fit; None for all uncertain ones.
        delays: {name: inputs}: transport delays to fit, each for the inputs with these indices. The
            task's latency is the start; that of the other inputs is fixed.
        hidden: states without a sensor whose start is known, such as memories of adopted effects.
        one_message: states that are logged in one message, so that all or none of them are late.
        interpolated_s: standard deviation of times [s] because the states were interpolated.
        engine: workers of the likelihood; the result does not depend on them.
        progress: called with a line on the stage and the time taken.

    Returns:
        A `Fit`: values with intervals, the model with these values, and prediction errors on
        held-out trials before and after.

    Raises:
        Interrupted: on Ctrl-C, with the values so far.
        GroundedError: for an unknown or constant parameter, trials that do not match the model, are
            too short or unusable, or a model that is not finite there or has too many states.
    """
    of_type("model", model, Model, Task)
    logged = list_of([trials] if isinstance(trials, Trial) else trials, Trial, "trials")
    if isinstance(names, str) or not isinstance(names, Sequence | None):
        raise wrong("names", names, must="names")
    given = model.model if isinstance(model, Task) else model
    delayed = dict(delays or {})
    asked = _asked(given, names, bool(delayed))
    if max((trial.known_steps for trial in logged), default=0) < 3:
        raise refused("given.short", what="fit", needs=3)

    # the data of a diagnosis; what is not asked for is constant
    tick = Stages(progress)
    tick("instruments")
    sound = sound_data(
        model,
        logged,
        what="fit",
        hidden=hidden,
        one_message=one_message,
        interpolated_s=interpolated_s,
    )
    data = sound.data
    late = data.latency.copy()
    for inputs in delayed.values():
        late[list(inputs)] = late[inputs[0]]
    kept = asked if names is not None else {n for n in asked if data.model.params[n].uncertain}
    data = replace(data, model=given.holding({*given.params} - {*kept}), latency=late)
    with (
        np.errstate(all="ignore"),
        interruptible(lambda: tick.so_far),
        running(engine, copied=not simulated(given)),
    ):
        ended = _identified(data, delayed, tick)
        tick("predict")
        return _report(given, asked, ended, sound)


def _asked(model: Model, names: Sequence[str] | None, more: bool) -> tuple[str, ...]:
    """Return the names of the parameters to fit.

    Raises:
        GroundedError: for a name that is not an uncertain parameter, or nothing to fit.
    """
    chosen = model.uncertain if names is None else tuple(names)
    known("parameter", chosen, model.params, f"model '{model.name}'")
    for name in chosen:
        if not model.params[name].uncertain:
            raise refused("given.constant", f"model '{model.name}'", name=name)
    if not chosen and not more:
        raise refused("given.constant", f"model '{model.name}'")
    return chosen


class Alone(HypothesisSearch):
    """The search of a fit: of effects it has the delays that are asked for, which cost nothing."""

    def paid(self, h: Hypothesis) -> float:
        """Return the price of all effects of a hypothesis [nats]."""
        return 0.0


@dataclass(frozen=True, eq=False)
class _Ended:
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
        told, sure = {}, self.search.sure(self.best, thresholds=True)
        for k, (one, std, half) in enumerate(zip(values_of(h, data), *sure, strict=True)):
            name, start = late[k] if one.effect else (one.quantity, 0.0)
            told[name] = start + one.value, float(std) * one.scale, float(half) * one.scale
        return told

    @cached_property
    def told(self) -> dict[str, Identifiable]:
        """How well the trials identify each parameter that was asked for."""
        params = self.search.data.model.params
        known = {n: Estimate(v, s) for n, (v, s, _) in self.unknowns.items() if n in params}
        return {one.parameter: one for one in identified(self.free, self.best, known).parameters}


def _identified(data: Data, delayed: Mapping[str, tuple[int, ...]], tick: Stages) -> _Ended:
    """Search, holding one after the other what the trials do not identify."""
    given = data.model
    while True:
        late = [_delay(data, inputs) for inputs in delayed.values()]
        search = Alone(data, late, tick)
        best = _searched(search, late, tick)
        model = held(search.predictor, best, less_noise=1.0)
        if model is not data.model:
            data = replace(data, model=model)
            continue
        search, best, crude = _with_all(search, best, tick)
        free = Predictor(replace(search.data, model=given))
        ended = _Ended(search, _centred(search, best), crude, free, delayed)
        # trials that disagree, or a model that is wrong, may show less than the information says
        lost = [n for n in ended.told if n in data.model.uncertain and not ended.told[n].known]
        if not lost:
            return ended
        params = data.model.params
        surest = min(lost, key=lambda n: params[n].spread / max(abs(params[n].value), 1e-9))
        data = replace(data, model=data.model.holding([surest]))


def _delay(data: Data, inputs: Sequence[int]) -> Effect:
    """Return the effect that changes the delay of some inputs, which is the same for all."""
    name = "delay:" + "+".join(data.model.input_names[j] for j in inputs)
    known = float(data.latency[inputs[0]])
    return delay_again(Library().effect(name, data.model, data.scales), known, known)


def _searched(search: Alone, late: Sequence[Effect], tick: Stages) -> Fitted:
    """Return the likeliest fit with all unknowns free.

    Raises:
        GroundedError: if the model is nowhere finite.
    """
    data = search.data
    many = bool(len(calibrated(data)))
    h = Hypothesis(shift=np.zeros(data.model.system.k), spread=CRUDE) if many else Hypothesis()
    for effect in late:
        h = h.plus(effect, {"d": 0.0})
    crude = search.refined([search.fresh(Hypothesis())], TO_THE_TOP)
    starts: list[Start] = [search.fresh(h), *((h, one.noise, one.track) for one in crude)]
    reached = search.refined(starts, TO_THE_TOP)
    if not reached:
        raise undefined(search.predictor)
    best = max(reached, key=search.score)

    # what is told on Ctrl-C
    shift, params = best.hypothesis.shift, data.model.params.items()
    values = data.model.values + (0.0 if shift is None else shift)
    each = zip(params, values, strict=True)
    told = [f"{n} = {value:.5g} {param.unit}" for (n, param), value in each if param.uncertain]
    tick.so_far = f"so far, not converged yet: {', '.join(told)}"
    tick(f"fit, {data.steps} steps")

    # from afar, under other noise, and to the top
    for j, grid in _far_off(search, best):
        now, which = best.hypothesis, calibrated(data)
        shifts = np.zeros(0) if now.shift is None else now.shift[which]
        at = np.concatenate([now.theta, shifts / data.model.spreads[which]])
        unit = np.arange(len(at)) == j
        tried = [(moved(data, now, unit * (value - at)), best.noise, best.track) for value in grid]
        best = max(search.refined([best, *tried], TO_THE_TOP, rivals=True), key=search.score)
    if crude:
        search.structures(search.exact_null())
    search.structures(best)
    free = [f for f in search.fits.values() if f.hypothesis.names == h.names]
    best = _supported(search, [f for f in free if f.hypothesis.spread == h.spread])
    search.settled([best])
    return search.latest(best)


def _far_off(search: Alone, fit: Fitted) -> list[tuple[int, Array]]:
    """Return the unknowns towards which the likelihood does not rise from afar, with a grid each.

    These are delays and thresholds, in the units of `moved`.
    """
    data, effects = search.data, fit.hypothesis.effects
    grids = [(k, np.array(effect.free[0].grid)) for k, effect in enumerate(effects)]
    for j in thresholds(search.predictor, fit):
        i = calibrated(data)[j - len(effects)]
        ends = np.array([*data.model.params.values()][i].reach) - data.model.values[i]
        low, high = np.clip(ends / data.model.spreads[i], -FARTHEST_MOVE, FARTHEST_MOVE).tolist()
        grids.append((j, np.linspace(low, high, GRID)))
    return grids


def _supported(search: Alone, fits: Sequence[Fitted]) -> Fitted:
    """Return the likeliest of the fits that predict held-out trials as well as any (`choose`).

    They differ in their noise. Coloured noise can absorb what a model lacks, and with it what the
    parameters should explain: it is likelier, and predicts worse.
    """
    ruler = Ruler(search.predictor)
    if not ruler.held_out or len(fits) == 1:
        return max(fits, key=search.score)
    best = max(fits, key=ruler.score)
    near = [f for f in fits if not ruler.gain(f, best).pays]
    return max(near or [best], key=search.score)


def _with_all(search: Alone, fit: Fitted, tick: Stages) -> tuple[Alone, Fitted, Fitted | None]:
    """Return the fit and that of the model as given, under its noise, on all runs."""
    few, more, own = search.data, entire(search.data), fit.noise.structure
    crude = search.fits.get((own, 0.0, ())) or search.fits.get((Structure(), 0.0, ()))
    if more is few:
        return search, fit, crude
    tick(f"fit to all {more.steps} steps")
    every = search.like(more)
    best, given = (
        every.refined([(one.hypothesis, one.noise, every.fresh(one.hypothesis)[2])], TO_THE_TOP)
        if one is not None
        else []
        for one in (fit, crude)
    )
    return (every, best[0], given[0] if given else None) if best else (search, fit, crude)


def _centred(search: Alone, fit: Fitted) -> Fitted:
    """Return a fit with each threshold amid the values that are as likely: no sample is there."""
    for j in thresholds(search.predictor, fit):
        move = sum(level(search.predictor, fit, j, STILL)) / 2
        unit = np.arange(fit.gram.shape[-1]) == j
        start = (moved(search.data, fit.hypothesis, move * unit), fit.noise, fit.track)
        (there,) = refine(search.predictor, [start], iterations=1, fixed_noise=True) or [fit]
        if there.peak > fit.peak - STILL:
            fit = replace(there, settled=fit.settled, fine=fit.fine)
    return fit


def _report(model: Model, asked: Sequence[str], ended: _Ended, sound: Sound) -> Fit:
    """Return the `Fit` of a finished search for the parameters `asked` of a model."""
    search, best, crude, data = ended.search, ended.best, ended.crude, ended.search.data
    params, fitted = dict[str, FittedValue](), ended.unknowns
    for name in asked:
        param = model.params[name]
        (low, high), start, unit = param.reach, param.value, param.unit
        if name not in fitted:
            params[name] = FittedValue(start, np.inf, low, high, unit, False, start)
            continue
        (value, e, w), given = fitted[name], (*ended.told[name].given,)
        low, high = max(low, value - w), min(high, value + w)
        params[name] = FittedValue(value, e, low, high, unit, True, start, given)
    latency = data.latency.copy()
    for effect, (name, inputs) in zip(best.hypothesis.effects, ended.delayed.items(), strict=True):
        q, start, (value, e, w) = effect.free[0], float(data.latency[inputs[0]]), fitted[name]
        if known := e <= UNKNOWN * (q.high - q.low) / np.sqrt(12):
            low, high = max(value - w, 0.0), value + w
        else:
            e, low, high = np.inf, 0.0, start + q.high
        params[name] = FittedValue(value, e, low, high, "s", known, start)
        latency[list(inputs)] = value

    # held-out errors by the ruler of the diagnosis, one step and at most a second ahead
    more: dict[str, Any] = {}
    ruler = Ruler(search.predictor)
    if crude is not None and ruler.held_out:
        ruler.beside(crude)
        more |= {"gain": ruler.gain(crude, best), "loss": ruler.gain(best, crude)}
        more["prediction_error"] = tuple(
            _errors(ruler, crude, best, k) for k in sorted({0, len(ruler.steps) - 1})
        )
    made = Fit(
        params=params,
        model=model.with_values({n: fitted[n][0] for n in model.params if n in fitted}),
        latency=latency,
        loglik=best.loglik,
        status="converged" if best.settled else "still rising",
        samples=int(data.seen[1:].sum()),
        nats=np.inf if crude is None else search.score(best) - search.score(crude),
        preflight=tuple(sound.looked.findings),
        **more,
    )
    return replace(made, findings=(*_told(made), *sound.shares))


def _errors(ruler: Ruler, before: Fitted, after: Fitted, k: int) -> RulerRow:
    """Return the held-out errors of two fits at horizon k."""
    units = {name: ruler.data.model.states[name] for name in ruler.names}
    crude, fitted = (
        dict(zip(units, ruler.errors(fit).rms[k, ruler.shown].tolist(), strict=True))
        for fit in (before, after)
    )
    horizon = ruler.steps[k] * ruler.data.dt
    return RulerRow(horizon, False, units, ruler.by, crude=crude, with_effects=fitted)


def _told(made: Fit) -> Iterator[Finding]:
    """Yield how it ended, and what is not identified or at a bound."""
    settled = "yes" if made.status == "converged" else "no"
    yield found("model.fitted", settled=settled, samples=made.samples, no_better=not made.helps)
    lost = [name for name, e in made.params.items() if not e.identified]
    tied = {one: [n for n, e in made.params.items() if one in e.only_with] for one in lost}
    if alone := [name for name in lost if not tied[name]]:
        yield found("model.not_told", *alone)
    for one, others in tied.items():
        if others:
            yield found("model.given", *others, rests=(one,))
    if made.at_bounds:
        yield found("model.at_bound", *made.at_bounds)
