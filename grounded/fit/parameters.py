"""fit: estimate the parameters of a model from trials, by maximum likelihood of the innovations.

The last quarter of the time is held out: the model before and after the fit predicts it, one step
and a second ahead. The final values are then fitted to all of the data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.engine import Engine, running, steady
from grounded.errors import GroundedError, type_of
from grounded.estimate import Measurement, NoiseStd, Record, of_states
from grounded.estimate.record import part, records_of
from grounded.fit.prediction import PredictionError, prediction_error
from grounded.fit.result import Fit, least_known, report, unidentified
from grounded.fit.search import ROUNDS, SearchEnd, data_of, first_search, search_parameters
from grounded.fit.unknowns import Latency, Unknowns, unknowns_of
from grounded.frozen import Array
from grounded.model import Model
from grounded.progress import Stages, interruptible
from grounded.share import Share, share_of
from grounded.task import Task
from grounded.trial import Trial


@steady()
def fit(
    model: Model | Task,
    trials: Sequence[Trial | Record],
    names: Sequence[str] | None = None,
    *,
    latency: Array | None = None,
    fit_latency: Latency = "known",
    measurement: Measurement | None = None,
    filters: Mapping[str, float] | None = None,
    hold_out: float = 0.25,
    horizon_s: float = 1.0,
    rng: np.random.Generator | None = None,
    engine: Engine | None = None,
    progress: Callable[[str], None] | None = None,
) -> Fit:
    """Estimate the parameters of a model from trials, with confidence intervals.

    Args:
        model: the model with start values and bounds of its n states and m inputs; a `Task` also
            gives the latency.
        trials: real trials, or records with separate clocks for measurements and commands.
        names: parameters to fit; None for all uncertain ones.
        latency: (m,) transport delay of each input [s], fixed or the start value; None for zero,
            or the task's.
        fit_latency: "known" (fixed), "common" (fit one value for all inputs), "each", or
            {name: inputs}: each of these, for the inputs with these indices.
        measurement: what the records measure; None for the states themselves.
        filters: time constants [s] of low-pass filters in sensors by state, as
            `Preflight.filters`.
        hold_out: share of the time that is held out to judge the fit.
        horizon_s: prediction horizon on held-out time [s].
        rng: draws the records used to estimate the noise if there are very many.
        engine: workers for the records' likelihoods; the result does not depend on them.
        progress: called with a line on the stage, the time taken and the time left.

    Returns:
        A `Fit`: values with intervals, the model with these values, and prediction errors on
        held-out time before and after.

    Raises:
        Interrupted: on Ctrl-C, with the values so far.
        GroundedError: for an unknown or constant parameter, trials that do not match the model or
            are too short, or a model with too many states.
    """
    if not isinstance(model, Model | Task):
        raise GroundedError(
            "fit(model, trials) takes a Model or a Task and a list of Trials, got "
            f"{type_of(model)} and {type_of(trials)}"
        )
    if isinstance(names, str) or not isinstance(names, Sequence | None):
        raise GroundedError(f"names must be a list of parameters, got {names!r:.60}")
    if isinstance(model, Task):
        latency = model.latency if latency is None else latency
        model = model.model
    if model.n > MOST_STATES:
        raise GroundedError(
            f"model '{model.name}' has {model.n} states; a fit filters the trials with at most "
            f"{MOST_STATES}, since a step costs their cube: fit the parameters in a model of the "
            "part that they belong to, and copy them into this one"
        )
    delay = np.zeros(model.m) if latency is None else np.asarray(latency, float)
    measurement = of_states(model) if measurement is None else measurement
    logged: Any = [trials] if isinstance(trials, Trial) else trials
    whole = isinstance(logged, Sequence) and all(isinstance(trial, Trial) for trial in logged)
    share = share_of(logged) if whole else Share(logged, "")
    records, given = records_of(model, share.trials), model
    if filters:
        from grounded.fit.filtered import behind_filters

        model, records, measurement = behind_filters(model, records, measurement, filters)
    unknowns = unknowns_of(model, names, delay, fit_latency)
    if max(r.steps for r in records) < 3:
        raise GroundedError("a fit needs a trial of at least 3 steps")
    rng = np.random.default_rng(0) if rng is None else rng
    asked, tick = unknowns, Stages(progress, _done)
    tied: dict[str, list[str]] = {}  # of what is held, those that are identified since
    before: list[str] = []
    copied = model.system.how != "differenced"
    with interruptible(lambda: tick.so_far), running(engine, copied=copied):
        while True:
            found = _fitted(model, records, measurement, unknowns, hold_out, horizon_s, rng, tick)
            if tied:
                tied[[*tied][-1]] += [n for n in before if n not in unidentified(found.params)]
            least = least_known(model, found)
            if least is None or unknowns.k == 1:
                return _of(found.beside(asked, tied).of_share(share.sentence), given)
            before = [name for name in unidentified(found.params) if name != least]
            tied[least] = []
            unknowns = unknowns.less(unknowns.names.index(least))


def _of(found: Fit, model: Model) -> Fit:
    """Return the fit for the original model, without the states added for filtered sensors."""
    if found.model.n == model.n:
        return found
    values = {name: found.model.params[name].value for name in model.param_names}
    return replace(found, model=model.with_values(values))


CLIMBS = 0.8  # share of a fit that its rounds take


def _done(stage: str, time: int) -> float:
    """Return the least share of a fit that is done when a stage begins for the k-th time."""
    return CLIMBS * min(time - 1, ROUNDS) / ROUNDS if stage.startswith("fit") else 0.0


MOST_STATES = 50  # with twice as many, 200 steps take minutes


def _fitted(
    model: Model,
    records: Sequence[Record],
    measurement: Measurement,
    unknowns: Unknowns,
    hold_out: float,
    horizon_s: float,
    rng: np.random.Generator,
    tick: Stages,
) -> Fit:
    """Search on a part of the time, judge on the rest, then fit the values to all of it."""
    train, test = split_in_time(records, hold_out, horizon_s, measurement)
    first = first_search(data_of(model, train, measurement, unknowns), rng, tick)
    before, after, last = None, None, first
    whole = data_of(model, records, measurement, unknowns)
    if first.data.steps < whole.steps and np.isfinite(first.climb.at.loglik):
        if test:
            before, after = judged(model, test, measurement, unknowns, first, horizon_s)
        last = search_parameters(whole, first.climb.at.theta, first.noise, rng, tick)
    return report(model, unknowns, last, before, after)


def split_in_time(
    records: Sequence[Record], share: float, horizon_s: float, measurement: Measurement
) -> tuple[list[Record], list[Record]]:
    """Split records into a training and a held-out part.

    Long records are split in time. Short ones, and those whose state is not fully measured, are
    kept whole, and some of them are held out.
    """
    train, test = [], []
    if any(i < 0 for i in measurement.states):
        horizon_s = np.inf
    long = [r for r in records if share * (r.times[-1] - r.times[0]) > 1.5 * horizon_s]
    if share > 0 and len(long) * 2 >= len(records):
        for record in records:
            edge = round((1 - share) * record.steps)
            train.append(part(record, 0, edge) if record in long else record)
            if record in long:
                test.append(part(record, edge, record.steps))
        return train, test
    every = round(1 / share) if share > 0 else 0
    if every and len(records) >= every:
        test = list(records[every - 1 :: every])
        return [r for r in records if r not in test], test
    return list(records), []


def judged(
    model: Model,
    test: Sequence[Record],
    measurement: Measurement,
    unknowns: Unknowns,
    found: SearchEnd,
    horizon_s: float,
) -> tuple[PredictionError, PredictionError]:
    """Return held-out prediction errors of the model before and after, each with its own noise."""

    def error(theta: Array, noise: NoiseStd) -> PredictionError:
        p, latency = unknowns.unpack(theta)
        there = model.with_values(dict(zip(model.param_names, p.tolist(), strict=True)))
        return prediction_error(
            there, test, horizon_s, latency=latency, measurement=measurement, noise=noise
        )

    return error(unknowns.start, found.start_noise), error(found.climb.at.theta, found.noise)
