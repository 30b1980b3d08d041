"""Constants of a large effect, set by the data: over which speed a dry friction builds up.

A constant is no parameter: for a small effect any sensible one will do. Where an effect is worth
many nats, a wrong one leaves so much that further effects are blamed for it. So it is walked up and
down by shrinking factors, the rest fitted anew at each, and pays as one more number.
"""

from __future__ import annotations

from grounded.diagnosis.fitted import Fit
from grounded.diagnosis.search import LARGE_GAIN, TO_THE_TOP, Search

FIRST, COARSE, LAST = 3.0, 1.4, 1.05  # factors by which a constant is moved
ROUNDS = 12


def tune(search: Search, fits: list[Fit]) -> None:
    """Tries other constants in fits that gain much; the search keeps what is likelier."""
    floor = search.score(search.best_null()) + LARGE_GAIN
    for fit in fits:
        if search.score(fit) < floor:
            continue
        for index, effect in enumerate(fit.hypothesis.effects):
            for q in effect.quantities:
                if q.tunable:
                    fit = _walked(search, fit, index, q.name)


def _walked(search: Search, fit: Fit, index: int, name: str) -> Fit:
    """The likeliest fit along one constant: uphill by factors, then to the top of a parabola."""
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


def _tried(search: Search, fit: Fit, index: int, name: str, values: tuple[float, ...]) -> list[Fit]:
    starts = [(fit.hypothesis.tuned(index, name, v), fit.noise, fit.track) for v in values]
    return search.refined(starts, TO_THE_TOP)
