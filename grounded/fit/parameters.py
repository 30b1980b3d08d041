"""fit: estimate the parameters of a model from trials, as a diagnosis does that has no candidates.

Sensor faults are corrected (`sound_data`), the parameters are shifted under the whole of their
priors, and what the trials do not identify stays as it was (`limits`). A delay of inputs that is
fitted is the effect `delay`, as in a diagnosis. The errors before and after are those of the
`ruler`: every group of trials is predicted with values from the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from grounded.checks import known, list_of, of_type, refused, wrong
from grounded.diagnosis.hypotheses.search import (
    CRUDE,
    TO_THE_TOP,
    HypothesisSearch,
    Start,
    undefined,
)
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
from grounded.diagnosis.validation.identifiable import held
from grounded.diagnosis.validation.limits import sound_data
from grounded.diagnosis.validation.ruler import Ruler
from grounded.effects import Effect, Library
from grounded.effects.actuator import delay_again
from grounded.engine import Engine, running, steady
from grounded.fit.result import Fit, Found, report
from grounded.frozen import Array
from grounded.model import Model
from grounded.progress import Stages, interruptible
from grounded.task import Task
from grounded.trial import Trial

GRID = 21  # values of a threshold that are tried


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
        result = _identified(data, delayed, tick)
        tick("predict")
        return report(given, asked, result, sound.looked.findings, sound.shares)


class Alone(HypothesisSearch):
    """The search of a fit: of effects it has the delays that are asked for, which cost nothing."""

    def paid(self, h: Hypothesis) -> float:
        """Return the price of all effects of a hypothesis [nats]."""
        return 0.0


def _identified(data: Data, delayed: Mapping[str, tuple[int, ...]], tick: Stages) -> Found:
    """Search, holding one after the other what the trials do not identify."""
    given = data.model
    while True:
        late = [_delay(data, inputs) for inputs in delayed.values()]
        search = Alone(data, late, tick)
        found = _searched(search, late, tick)
        if found is None:
            raise undefined(search.predictor)
        model = held(search.predictor, found, less_noise=1.0)
        if model is not data.model:
            data = replace(data, model=model)
            continue
        search, best, crude = _with_all(search, found, tick)
        free = Predictor(replace(search.data, model=given))
        done = Found(search, _centred(search, best), crude, free, delayed)
        # trials that disagree, or a model that is wrong, may show less than the information says
        lost = [n for n in done.told if n in data.model.uncertain and not done.told[n].known]
        if not lost:
            return done
        params = data.model.params
        surest = min(lost, key=lambda n: params[n].spread / max(abs(params[n].value), 1e-9))
        data = replace(data, model=data.model.holding([surest]))


def _searched(search: Alone, late: Sequence[Effect], tick: Stages) -> Fitted | None:
    """Return the likeliest fit with all unknowns free; None if the model is nowhere finite."""
    data = search.data
    many = bool(len(calibrated(data)))
    h = Hypothesis(shift=np.zeros(data.model.system.k), spread=CRUDE) if many else Hypothesis()
    for effect in late:
        h = h.plus(effect, {"d": 0.0})
    crude = search.refined([search.fresh(Hypothesis())], TO_THE_TOP)
    starts: list[Start] = [search.fresh(h), *((h, one.noise, one.track) for one in crude)]
    found = search.refined(starts, TO_THE_TOP)
    if not found:
        return None
    best = max(found, key=search.score)
    _tell(tick, best, data)
    for j, grid in _far_off(search, best):
        tried = [(_at(best, data, j, value), best.noise, best.track) for value in grid]
        best = max(search.refined([best, *tried], TO_THE_TOP, rivals=True), key=search.score)
    if crude:
        search.structures(search.exact_null())
    search.structures(best)
    free = [f for f in search.fits.values() if f.hypothesis.names == h.names]
    best = _supported(search, [f for f in free if f.hypothesis.spread == h.spread])
    search.settled([best])
    return search.latest(best)


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
    found = [
        every.refined([(one.hypothesis, one.noise, every.fresh(one.hypothesis)[2])], TO_THE_TOP)
        for one in (fit, crude)
        if one is not None
    ]
    if not found[0]:
        return search, fit, crude
    return every, found[0][0], found[1][0] if found[1:] and found[1] else None


def _far_off(search: Alone, fit: Fitted) -> list[tuple[int, Array]]:
    """Return the unknowns towards which the likelihood does not rise from afar, with a grid each.

    These are delays and thresholds, in the units of `moved`.
    """
    data, effects = search.data, fit.hypothesis.effects
    found = [(k, np.array(effect.free[0].grid)) for k, effect in enumerate(effects)]
    for j in thresholds(search.predictor, fit):
        i = calibrated(data)[j - len(effects)]
        ends = np.array([*data.model.params.values()][i].reach) - data.model.values[i]
        low, high = np.clip(ends / data.model.spreads[i], -FARTHEST_MOVE, FARTHEST_MOVE).tolist()
        found.append((j, np.linspace(low, high, GRID)))
    return found


def _at(fit: Fitted, data: Data, j: int, value: float) -> Hypothesis:
    """Return a fit's hypothesis with another value of unknown j."""
    h, which = fit.hypothesis, calibrated(data)
    shift = np.zeros(0) if h.shift is None else h.shift[which] / data.model.spreads[which]
    now = np.concatenate([h.theta, shift])
    return moved(data, h, np.where(np.arange(len(now)) == j, value - now, 0.0))


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


def _tell(tick: Stages, fit: Fitted, data: Data) -> None:
    """Report a stage, and set the text for an interruption."""
    shift = fit.hypothesis.shift
    values = data.model.values if shift is None else data.model.values + shift
    told = ", ".join(
        f"{name} = {value:.5g} {param.unit}"
        for (name, param), value in zip(data.model.params.items(), values, strict=True)
        if param.uncertain
    )
    tick.so_far = f"so far, not converged yet: {told}"
    tick(f"fit, {data.steps} steps")


def _delay(data: Data, inputs: Sequence[int]) -> Effect:
    """Return the effect that changes the delay of some inputs, which is the same for all."""
    name = "delay:" + "+".join(data.model.input_names[j] for j in inputs)
    known = float(data.latency[inputs[0]])
    return delay_again(Library().effect(name, data.model, data.scales), known, known)


def _asked(model: Model, names: Sequence[str] | None, more: bool) -> tuple[str, ...]:
    """Return the names of the parameters to fit.

    Raises:
        GroundedError: for a name that is not an uncertain parameter, or nothing to fit.
    """
    chosen = model.uncertain if names is None else tuple(names)
    for name in chosen:
        known("parameter", [name], model.params, f"model '{model.name}'")
        if not model.params[name].uncertain:
            raise refused("given.constant", f"model '{model.name}'", name=name)
    if not chosen and not more:
        raise refused("given.constant", f"model '{model.name}'")
    return chosen
