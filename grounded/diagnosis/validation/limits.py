"""What the data cannot tell, said before anything is claimed.

A state that never moved, an input that never changed, a single trial, a handful of steps: an effect
there may exist and can't be known, so it is not offered and the reader is told.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.hypotheses.leftover import filter_of
from grounded.diagnosis.likelihood.data import PIECES, Data
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated
from grounded.diagnosis.likelihood.linearise import base_columns
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.diagnosis.report import Estimate, Identifiable
from grounded.effects import (
    Effect,
    InputFamily,
    LossFamily,
    MediumFamily,
    MemoryFamily,
    RateFamily,
    SensorDelayFamily,
    SensorFamily,
    SensorLagFamily,
)
from grounded.effects.actuator import backlash
from grounded.effects.places import told_by
from grounded.filter import kalman
from grounded.frozen import Array
from grounded.model import Model, Param
from grounded.trial import Trial

FEW_STEPS = 30
WEAK, UNKNOWN = 0.2, 0.6  # of its prior standard deviation: what the trials leave of it
DEPENDS = 2.0  # times its standard deviation: that of a value, all held parameters free
PART = 0.2  # of that variance, which a parameter makes that it depends on
QUIETER = 100.0  # times less noise variance: what effects may yet take out of the noise


@dataclass(frozen=True)
class Limits:
    """What can't be known: sentences, and whether they forbid to name a cause."""

    sentences: tuple[str, ...]
    no_cause: bool


def limits(data: Data, left_out: Collection[str] = ()) -> Limits:
    """What the trials are too few or too quiet for.

    Args:
        data: the trials.
        left_out: states whose sensors say no more than others do.
    """
    found, no_cause = [], False
    if data.count < 2 and len(data.valid) < PIECES:
        found.append("one trial alone confirms nothing; run a second one, or a longer one")
        no_cause = True
    if data.steps < FEW_STEPS:
        found.append(
            f"{data.steps} steps in all are too few to tell an effect from noise; record "
            f"{FEW_STEPS} or more"
        )
        no_cause = True
    still = constant_inputs(data)
    for name in still:
        found.append(f"input {name} never changed, so nothing can be said of its actuator")
    if len(still) == data.model.m:
        no_cause = True
    unmoved = still_states(data)
    for name in unmoved:
        found.append(f"state {name} never moved, so nothing can be said of what acts on it")
    if data.skipped:
        slow = simulated(data.model)
        why = "each step of a simulator takes its time" if slow else "to bound memory"
        used = f"{len(data.valid)} of {len(data.valid) + data.skipped} stretches of the trials"
        found.append(f"{used} were used, those that move most: {why}")
    names = data.model.state_names
    empty = [name for name, told in zip(names, data.told, strict=True) if not told]
    spared = {*left_out, *(names[i] for i, log in data.behind.items() if names[log] in left_out)}
    for name in (name for name in empty if name not in spared):
        found.append(f"state {name} was never measured")
    if {*unmoved, *empty, *(names[i] for i in data.hidden)} == {*names}:
        no_cause = True
    return Limits(tuple(found), no_cause)


def counted_once(trials: Sequence[Trial]) -> tuple[list[Trial], list[str]]:
    """The trials without those that are another one to the last bit, and a sentence for each.

    A copy holds no further noise: counted twice it would confirm what one run shows.
    """
    known: dict[tuple[bytes, bytes], tuple[int, Trial]] = {}
    found, said = [], []
    for k, trial in enumerate(trials):
        key = trial.states.tobytes(), trial.inputs.tobytes()
        if (one := known.setdefault(key, (k, trial)))[0] == k:
            found.append(trial)
            continue
        name, other = (t.id or f"trial {i + 1}" for i, t in ((k, trial), one))
        said.append(
            f"{name} is {other} to the last bit: a copy, or no noise at all; it counts once"
        )
    return found, said


def constant_inputs(data: Data) -> list[str]:
    """Inputs that took one value in every trial."""
    names = data.model.input_names
    return [
        name
        for j, name in enumerate(names)
        if float(
            np.ptp(np.concatenate([data.commands[i, :T, j] for i, T in enumerate(data.lengths)]))
        )
        <= 1e-9 * max(data.scales.peak(name), 1e-12)
    ]


def switches(data: Data) -> set[str]:
    """Inputs that were on or off and nothing else: how much one is on can't be off, only when."""
    found = set()
    for j, name in enumerate(data.model.input_names):
        sent = [data.commands[i, :T, j] for i, T in enumerate(data.lengths)]
        levels = np.unique(np.concatenate(sent))
        if levels.size == 2 and 0.0 in levels:
            found.add(name)
    return found


def still_states(data: Data) -> list[str]:
    """States that had one value in every trial: to the last digit, so no sensor of them lives."""
    found = []
    for i, name in enumerate(data.model.state_names):
        if i in data.hidden:
            continue
        values = data.states[np.isfinite(data.states[:, i]), i]
        if values.size and float(np.ptp(values)) <= 1e-9 * max(data.scales.peak(name), 1e-12):
            found.append(name)
    return found


def knowable(data: Data, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The effects that these data could show at all."""
    still, unmoved, on_off = set(constant_inputs(data)), set(still_states(data)), switches(data)
    dead = {n for i, n in enumerate(data.model.state_names) if not data.seen[..., i].any()}
    memory = {data.model.state_names[i] for i in data.hidden}
    kept = []
    for effect in effects:
        targets = {part for t in effect.site.targets for part in t.split("<-")}
        family = effect.family
        if targets & memory:
            continue
        if isinstance(family, InputFamily | MemoryFamily) and targets & still:
            continue
        if targets & on_off and (isinstance(family, InputFamily) or family is backlash):
            continue
        if isinstance(family, RateFamily | LossFamily | MediumFamily) and targets & unmoved:
            continue
        sensors = SensorFamily | SensorDelayFamily | SensorLagFamily
        if isinstance(family, sensors) and targets & (dead | unmoved):
            continue
        late = isinstance(family, SensorDelayFamily) and len(targets) > 1
        if late and not told_by(data.model, effect.site.targets) - dead - unmoved - memory:
            continue
        kept.append(effect)
    return tuple(kept)


def identifiable(
    predictor: Predictor, fit: Fitted, known: Mapping[str, Estimate] | None = None
) -> list[Identifiable]:
    """How well the trials tell each uncertain parameter, all others free, under a fit's noise.

    The sensitivities of the predictions, whitened, are the information that the data add to the
    priors; what is left of each prior's standard deviation is the verdict, or what a calibrated
    value's own standard deviation is of it, where that is more.

    Args:
        predictor: of the data, all uncertain parameters free.
        fit: beside which hypothesis.
        known: those that were calibrated, the others held at their values.
    """
    information, known = _information(predictor, fit), known or {}
    cov = np.linalg.inv(information + np.eye(len(information)))
    model, found = predictor.data.model, []
    names = [model.param_names[i] for i in calibrated(predictor.data)]
    priors = np.array([model.params[name].spread for name in names])
    held_ = [i for i, name in enumerate(names) if known and name not in known]
    for i, name in enumerate(names):
        std = known[name].std if name in known else 0.0
        share = max(float(np.sqrt(cov[i, i])), min(std / priors[i], 1.0))
        given = {}
        if name in known and known[name].value and share > DEPENDS * std / priors[i]:
            per = cov[i, held_] @ np.linalg.pinv(cov[np.ix_(held_, held_)], hermitian=True)
            for slope, j in zip(per, held_, strict=True):
                if slope**2 * cov[j, j] > PART * cov[i, i]:
                    size = model.params[names[j]].value / known[name].value
                    given[names[j]] = float(slope * priors[i] / priors[j] * size)
        found.append(Identifiable(name, _verdict(share), float(priors[i]), share, given))
    return found


def held(predictor: Predictor, fit: Fitted) -> Model:
    """The model with those parameters as constants that even little noise would leave unknown.

    Of several of which only a combination is known (a mass and a gain) the one stays free that its
    user is least sure of.
    """
    model = predictor.data.model
    H = _information(predictor, fit) * QUIETER
    names = [model.param_names[i] for i in calibrated(predictor.data)]
    sure = np.array([model.params[n].spread / max(abs(model.params[n].value), 1e-9) for n in names])
    free = list(range(len(names)))
    while free:
        left = _left(H[np.ix_(free, free)])
        lost = [i for i, share in zip(free, left, strict=True) if share > UNKNOWN]
        if not lost:
            break
        free.remove(min(lost, key=lambda i: sure[i]))
    fixed = {names[i] for i in range(len(names)) if i not in free}
    params = {n: Param(p.value, p.unit) if n in fixed else p for n, p in model.params.items()}
    return replace(model, params=params) if fixed else model


def _information(predictor: Predictor, fit: Fitted) -> Array:
    """Of the uncertain parameters in units of their priors, the effects' values known, (K, K)."""
    h, k = fit.hypothesis, len(fit.hypothesis.theta)
    columns, of_log = base_columns(predictor, replace(fit, hypothesis=replace(h, spread=1.0)))
    if columns.shape[-1] == k:
        return np.zeros((0, 0))
    white = kalman.innovations(filter_of(predictor, fit), columns, of_log)[0]
    W = white.reshape(-1, columns.shape[-1])
    G = np.nan_to_num(W.T @ W)
    across = G[k:, :k]
    return np.asarray(G[k:, k:] - across @ np.linalg.pinv(G[:k, :k], hermitian=True) @ across.T)


def _left(information: Array) -> Array:
    """Standard deviations with unit priors, (K,)."""
    return np.sqrt(np.diag(np.linalg.inv(information + np.eye(len(information)))))


def _verdict(left: float) -> str:
    if left > UNKNOWN:
        return "not identifiable"
    return "weak" if left > WEAK else "identifiable"
