"""The search for effects: forward selection by evidence, with variations and removals.

The model without effects is fitted under white noise, coloured noise and heavy tails, and with its
parameters calibrated. Every candidate is scanned beside the likely ones of these fits, and a
shortlist is refined. The scan is repeated with the noise of the best hypothesis. Further effects
are added while the evidence rises, and each set is varied (`variations`). Confirmation on held-out
trials follows later (`validation`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from grounded.diagnosis.hypotheses.joint_model import joint_model
from grounded.diagnosis.hypotheses.search import (
    LARGE_GAIN,
    SHORTLIST,
    TO_THE_TOP,
    HypothesisSearch,
)
from grounded.diagnosis.hypotheses.variations import HOPEFUL, varied
from grounded.diagnosis.levels import NATS
from grounded.diagnosis.likelihood.data import Data, fewer
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.noise import Structure
from grounded.diagnosis.likelihood.refine import clean
from grounded.effects import Effect
from grounded.progress import interruptible
from grounded.result import listed

USUAL_EFFECTS = 3  # most effects searched for at first
SOME = 8  # effects that are tried beside others
RIVALS, BEHIND = 3, 25.0  # single effects that are extended, at most so many nats behind the best
TOP = 2  # best larger sets that are fitted to convergence, and with parameters free
ROUNDS = 2  # most rounds of convergence, since others may become the likeliest


def attribute(
    data: Data,
    candidates: Sequence[Effect],
    *,
    max_effects: int | None = None,
    tick: Callable[[str], None] | None = None,
    joints: Sequence[Effect] = (),
    alone: Sequence[Fitted] = (),
) -> tuple[HypothesisSearch, Fitted]:
    """Search for the effects that cause the gap.

    Args:
        data: from `prepare`.
        candidates: the effects that may be blamed.
        max_effects: the largest number of effects at once; None: any. At most `USUAL_EFFECTS` are
            searched for, or more if joints share an inertia and each of them is off.
        tick: called with the current activity, for a progress display.
        joints: plain dry frictions of joints, tried in place of richer ones even if they are not
            candidates.
        alone: a fit of the model alone with exact parameters, if there is one already.

    Returns:
        The search and its best fit.
    """
    few = fewer(data)
    search = HypothesisSearch(few, candidates, tick, joints)
    most = min(max_effects or USUAL_EFFECTS, USUAL_EFFECTS)
    with (
        np.errstate(all="ignore"),  # a hypothesis that diverges scores minus infinity
        interruptible(lambda: so_far(search, most)),
    ):
        search, best = _searched(search, alone if few is data else (), max_effects)
        most = max(most, len(best.hypothesis.effects))
        best = grown(search, best, most)
        return (search, best) if few is data else _confirmed(search, data, most)


def _confirmed(search: HypothesisSearch, data: Data, most: int) -> tuple[HypothesisSearch, Fitted]:
    """Return a search on all data with the likeliest sets of another one, and its best fit."""
    other = search.like(data)
    likely = {f.hypothesis.names for k in range(most + 1) for f in search.of_size(k)[:HOPEFUL]}
    fits = [fit for fit in search.fits.values() if fit.hypothesis.names in likely]
    starts = [(f.hypothesis, f.noise.plain, other.fresh(f.hypothesis)[2]) for f in fits]
    other.refined(starts, TO_THE_TOP)
    settle(other, most)
    return other, other.chosen(most)


def so_far(search: HypothesisSearch, most: int, decided: Sequence[str] | None = None) -> str:
    """Return the causes so far, told when a diagnosis is interrupted and not stored.

    decided: the effects confirmed before a further one was sought; None before that.
    """
    if decided is not None:
        return f"confirmed: {listed(decided) or '-'}"
    best = search.chosen(most).hypothesis.names if search.of_size(0) else ()
    return f"unconfirmed: {listed(best) or '-'}"


def _searched(
    search: HypothesisSearch, alone: Sequence[Fitted], limit: int | None
) -> tuple[HypothesisSearch, Fitted]:
    """Return the search and its best single effect; with outliers, those under their weights."""
    search.nulls(alone)
    best = _explore(search, limit)
    if outliers(best):
        search = search.with_weights(clean(search.predictor, best))
        best = _explore(search, limit)
    return search, best


def _explore(search: HypothesisSearch, limit: int | None) -> Fitted:
    """Return the best hypothesis of at most one effect.

    If all joints of an arm together are far likelier than any single effect, and need no more than
    `limit` effects (None: any number), return that hypothesis.
    """
    null = search.best_null()
    plain = search.fits.get((Structure(), 0.0, ()), null)
    for context in [null] if plain is null else [null, plain]:
        search.extended(context)
    singles = search.of_size(1)
    if not singles:
        return null
    # a large effect starts far from its optimum after the scan
    search.refined(singles[:SHORTLIST], 8, rivals=True)
    many = limit is None or limit > USUAL_EFFECTS
    if many and (whole := joint_model(search)) is not None:
        more = search.score(whole) - search.score(search.of_size(1)[0])
        if more > LARGE_GAIN and (limit is None or len(whole.hypothesis.effects) <= limit):
            return whole
    search.beside_parameters()
    best = search.of_size(1)[0]
    search.structures(best)
    search.calibrated(best)
    search.refined(search.of_size(1)[:HOPEFUL], TO_THE_TOP)
    return max([search.of_size(1)[0], search.best_null()], key=search.score)


def outliers(fit: Fitted) -> bool:
    """Check whether whitened innovations beyond 4 are far more frequent than for normal noise."""
    count = float((np.abs(fit.white) > 4.0).sum())
    expected = 6.3e-5 * fit.white.size
    return count > 4 + 3 * expected


def grown(search: HypothesisSearch, best: Fitted, most: int) -> Fitted:
    """Return the likeliest of up to `most` effects: extend the likeliest by one, repeat."""
    size = len(best.hypothesis.effects)
    while 1 <= size < most:
        best = varied(search, best)
        floor = search.score(best) - BEHIND
        others = search.of_size(size)[: RIVALS if size == 1 else 1]
        near = [f for f in others if f is not best and search.score(f) > floor]
        calibrates = best.hypothesis.spread > 0
        for start in (best, *near, *(search.exact(best) if calibrates else ())):
            search.extended(start, SOME)
        size += 1
        for exact in (False, True) if calibrates else (False,):
            search.refined(search.of_size(size, exact=exact)[:HOPEFUL], 10)
            search.refined(search.of_size(size, exact=exact)[:TOP], TO_THE_TOP)
            search.shrunk(search.of_size(size, exact=exact)[:TOP])
        for fit in search.of_size(size)[:TOP]:
            search.calibrated(fit)
        larger = search.of_size(size)
        if not larger or search.score(larger[0]) < search.score(best) + NATS:
            break
        best = larger[0]
    # it is asked last whether a sensor is late
    chosen = search.chosen(most)
    size = len(chosen.hypothesis.effects)
    if size < most and (late := search.late_sensors(chosen)):
        search.settled(search.refined(late, TO_THE_TOP))
        if len(search.chosen(most).hypothesis.effects) > size:
            return grown(search, search.chosen(most), most)
    settle(search, most)
    varied(search, search.chosen(most))  # the rule may prefer what blames less
    return search.chosen(most)


def regrown(search: HypothesisSearch, leader: str, most: int) -> None:
    """Search again as if one effect did not exist; all fits are added to the search.

    A set that grew one effect at a time never leaves the one that it began with, however much is
    left: each further effect fits what that one leaves.
    """
    other = search.lacking(leader)
    if singles := other.of_size(1):
        grown(other, singles[0], most)
        search.keep(list(other.fits.values()))


def settle(search: HypothesisSearch, most: int) -> None:
    """Continue the fits that decide until they converge: the likeliest of each size.

    A fit that stops early is some point of its climb, and which one depends on the last bit of a
    computation. Without effects, noise and parameters explain the gap in several ways, each a
    maximum of its own: every likely fit is tried from the best of these.
    """
    for _ in range(ROUNDS):
        near, claimed = list[Fitted](), len(search.chosen(most).hypothesis.names)
        for size in range(most + 1):
            fits = [f for f in search.fits.values() if len(f.hypothesis.names) == size]
            top = max(map(search.score, fits), default=0.0)
            least = top - NATS if size in (0, claimed) else top  # of others, the likeliest
            near += [f for f in fits if not f.fine and search.score(f) >= least]
        if not near:
            return
        search.settled(near)
