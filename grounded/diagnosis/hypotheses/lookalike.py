"""Look-alikes: effects that produce nearly the same signal in these trials as a claimed one.

Evidence may come from a few moments: a dead zone and a dry friction are the same constant force
while the car rolls, and differ only where it stands. So in addition to ties (explanations within a
few nats), the look-alikes of each claimed effect are compared by their signals. The signal of an
effect is

    s = whitened (f with the effect - f without it)

with the part that the other effects can absorb projected out, at the calibrated parameters. A
candidate whose best values reproduce most of |s|^2 is named with that share, whatever its evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from grounded.diagnosis.hypotheses.leftover import filter_of
from grounded.diagnosis.hypotheses.scan import scan_candidates
from grounded.diagnosis.likelihood.delays import delays_of
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.linearise import base_columns, linearise
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.parts import Likeness
from grounded.effects import Effect, ParamFamily
from grounded.filter import kalman

NEARLY = 0.75  # share of an effect's signal from which a look-alike is named
IDENTICAL = 1e-6  # fraction of a slope's power by which two equivalent effects may differ
MOST = 3  # most look-alikes named per effect


def lookalikes(
    predictor: Predictor, fit: Fitted, candidates: Sequence[Effect]
) -> tuple[Likeness, ...]:
    """Return the look-alikes that reproduce nearly all of a claimed effect's signal, best first.

    Args:
        predictor: evaluates hypotheses on the data.
        fit: the fit with the claimed effects.
        candidates: effects that may be look-alikes.
    """
    found: list[Likeness] = []
    for effect in fit.hypothesis.effects:
        own = [c for c in candidates if related(effect, c) and c.name not in fit.hypothesis.names]
        if fit.hypothesis.spread > 0:
            own = [c for c in own if not isinstance(c.family, ParamFamily)]
        found += _likely(predictor, fit, effect, own)
    return tuple(found)


def of_parameters(
    predictor: Predictor,
    null: Fitted,
    off: Sequence[int],
    candidates: Sequence[Effect],
) -> tuple[Likeness, ...]:
    """Return the effects that act like the error of a calibrated parameter, best first.

    Each parameter is taken separately, with the others at their calibrated values. For example, a
    gain of an actuator is equivalent to the parameter that scales it.

    Args:
        predictor: evaluates hypotheses on the data.
        null: the calibrated fit without effects.
        off: indices of the parameters.
        candidates: effects that may be look-alikes.
    """
    assert null.hypothesis.shift is not None
    model, found = predictor.data.model, list[Likeness]()
    for index in off:
        name = f"parameter:{model.param_names[index]}"
        effect = next((c for c in candidates if c.name == name), None)
        if effect is None:
            continue
        others = null.hypothesis.shift.copy()
        others[index] = 0.0
        moved = dict(zip(model.param_names, model.values + others, strict=True))
        there = Predictor(replace(predictor.data, model=model.with_values(moved)))
        h = Hypothesis().plus(effect, {"d": float(null.hypothesis.shift[index])})
        own = [c for c in candidates if related(effect, c) and not c.name.startswith("parameter:")]
        found += _likely(there, replace(null, hypothesis=h), effect, own)
    return tuple(found)


def one_thing(predictor: Predictor, index: int, effect: Effect) -> bool:
    """Check whether an effect is equivalent to a parameter of the model in any trial.

    Tested at random points, every state and input drawn independently over its range: the slope of
    a step in the effect must be a multiple of its slope in the parameter.
    """
    data, rng = predictor.data, np.random.default_rng(0)
    if len(effect.free) != 1 or index not in calibrated(data):
        return False
    low, high = (f(data.filled, axis=0) for f in (np.min, np.max))
    least, most = (f(data.commands, axis=(0, 1)) for f in (np.min, np.max))
    apart = np.maximum(most - least, 1e-9)
    commands = rng.uniform(least - apart, most + apart, data.commands.shape)
    anywhere = replace(data, commands=commands)
    track = rng.uniform(low, high, (len(data.time) + 1, data.time.shape[1], data.model.n))
    h = replace(Hypothesis().plus(effect, {q.name: q.start for q in effect.free}), spread=1.0)
    columns = linearise(Predictor(anywhere), h, track)[1] / np.maximum(high - low, 1e-12)[:, None]
    own = columns[..., 1].ravel()
    other = columns[..., 2 + int(np.flatnonzero(calibrated(data) == index)[0])].ravel()
    power = float(own @ own) * float(other @ other)
    return power > 0 and float(own @ other) ** 2 > (1 - IDENTICAL) * power


def related(one: Effect, other: Effect) -> bool:
    """Check whether one of two families lists the other among its look-alikes."""
    a, b = one.family, other.family
    return b.name in a.lookalikes or a.name in b.lookalikes


def _likely(
    predictor: Predictor, fit: Fitted, effect: Effect, own: Sequence[Effect]
) -> list[Likeness]:
    """Return the candidates that reproduce more than NEARLY of an effect's signal, best first."""
    shares = _shares(predictor, fit, effect, own) if own else []
    likely = [Likeness(effect.name, c.name, s) for c, s in zip(own, shares, strict=True)]
    near = sorted((one for one in likely if one.share > NEARLY), key=lambda one: -one.share)
    return near[:MOST]


def _shares(
    predictor: Predictor, fit: Fitted, effect: Effect, own: Sequence[Effect]
) -> list[float]:
    """Return the share of an effect's signal that each candidate reproduces at its best values."""
    h, data = fit.hypothesis, predictor.data
    if h.shift is not None:
        moved = dict(zip(data.model.param_names, data.model.values + h.shift, strict=True))
        data = replace(data, model=data.model.with_values(moved))
        h = replace(h, shift=None, spread=0.0)
    predictor, without = Predictor(data), h.minus(effect.name)
    # all with the filter of the hypothesis without the effect, as its look-alikes are scanned
    gains = filter_of(predictor, replace(fit, hypothesis=without))
    delays = delays_of(without, data)
    x, model = fit.track[:-1], data.model
    bare, full = predictor.next(without, x), predictor.next(h, x)
    d = model.difference(bare, full)
    track = np.concatenate([fit.track[:1], full])
    r = np.zeros_like(track) + predictor.offset(h, track) - predictor.offset(without, track)
    r = r if delays is None else delays.aligned(r)
    signal = kalman.innovations(gains, d[..., None], r[..., None])[0][..., 0]
    other = replace(fit, hypothesis=without, white=signal)
    columns, of_log = base_columns(predictor, other)
    W = np.zeros((signal.size, columns.shape[-1]))
    if W.shape[1]:
        W = kalman.innovations(gains, columns, of_log)[0].reshape(W.shape)
    other = replace(other, gram=(W.T @ W)[None], score=np.zeros((1, W.shape[1])))
    flat = signal.reshape(-1)
    taken = W.T @ flat
    power = 0.5 * float(flat @ flat - taken @ other.covariance @ taken)
    looks = scan_candidates(predictor, other, own)
    return [float(np.clip(look.gain / max(power, 1e-12), 0.0, 1.0)) for look in looks]
