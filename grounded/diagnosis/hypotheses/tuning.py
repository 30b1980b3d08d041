"""Set the constants of effects, which are not parameters of the fits: `sweep`, then `tune`."""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.hypotheses.search import LARGE_GAIN, TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.refine import refine

FIRST, COARSE, LAST = 3.0, 1.4, 1.05  # factors by which a constant is changed
ROUNDS = 12
WIDEST, TRIED = 100.0, 7  # sweep of a constant: its range as a factor, number of values tried


def tune(search: HypothesisSearch, fits: list[Fitted]) -> None:
    """Optimise constants of large effects (such as the speed over which dry friction builds up).

    A constant is not fitted with the other values: for a small effect, any sensible one will do. If
    an effect gains many nats, a wrong constant leaves so much that further effects are blamed for
    it. So it is varied by shrinking factors, with the rest fitted again each time, and counts as
    one more parameter.
    """
    floor = search.score(search.best_null()) + LARGE_GAIN
    for fit in fits:
        if search.score(fit) < floor:
            continue
        for index, effect in enumerate(fit.hypothesis.effects):
            for q in effect.quantities:
                if q.tunable:
                    fit = _walked(search, fit, index, q.name)


def sweep(search: HypothesisSearch) -> None:
    """Try constants over their whole range for every effect, before effects are compared.

    Otherwise a dry friction that builds up slowly would lose to a dead zone because of its constant
    alone. Fits with large gains are kept, and further effects are scanned with their constants.
    """
    null = search.score(search.best_null())
    starts = [
        (fit.hypothesis.tuned(0, q.name, float(value)), fit.noise, fit.track)
        for fit in search.of_size(1)
        if search.score(fit) > null
        for q in fit.hypothesis.effects[0].quantities
        if q.tunable
        for value in np.geomspace(max(q.low, q.high / WIDEST), q.high, TRIED)
    ]
    swept = refine(search.predictor, starts, iterations=TO_THE_TOP, worth=search.score)
    large = [fit for fit in swept if search.score(fit) > null + LARGE_GAIN]
    search.keep(large)
    names = {fit.hypothesis.names for fit in large}
    best = [f.hypothesis for f in search.of_size(1) if f.hypothesis.names in names]
    known = {h.names[0]: h.effects[0] for h in best}
    search.candidates = tuple(known.get(e.name, e) for e in search.candidates)


def _walked(search: HypothesisSearch, fit: Fitted, index: int, name: str) -> Fitted:
    """Maximise over one constant: uphill by factors, then to the top of a parabola."""
    factor = FIRST
    for _ in range(ROUNDS):
        at = fit.hypothesis.values[index][name]
        tried = _tried(search, fit, index, name, (at / factor, at * factor))
        best = max([fit, *tried], key=search.score)
        if best is fit and factor < COARSE and len(tried) == 2:
            down, up = (search.score(f) - search.score(fit) for f in tried)
            part = 0.5 * (down - up) / min(down + up, -1e-9)
            tried = _tried(search, fit, index, name, (at * factor ** float(part),))
            best = max([fit, *tried], key=search.score)
        factor = factor**0.5 if best is fit or factor < COARSE else factor
        fit = best
        if factor < LAST:
            break
    return fit


def _tried(
    search: HypothesisSearch, fit: Fitted, index: int, name: str, values: tuple[float, ...]
) -> list[Fitted]:
    (q,) = (q for q in fit.hypothesis.effects[index].quantities if q.name == name)
    inside = dict.fromkeys(float(np.clip(v, q.low, q.high)) for v in values)
    starts = [(fit.hypothesis.tuned(index, name, v), fit.noise, fit.track) for v in inside]
    return search.refined(starts, TO_THE_TOP)
