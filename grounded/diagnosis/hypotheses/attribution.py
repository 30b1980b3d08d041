"""Which effect: hypotheses compared by evidence, confirmed on trials that were left out.

The search: fit the model without effects under plain noise, coloured noise, heavy tails, and with
its parameters calibrated; scan every candidate beside the likely ones of these; refine a shortlist;
scan again with the noise that the best hypothesis leaves; add a second effect where it pays, swap
and drop what another explains better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from grounded.diagnosis.hypotheses.explored import CLAIM
from grounded.diagnosis.hypotheses.joint_model import joint_model
from grounded.diagnosis.hypotheses.search import (
    LARGE,
    LARGE_GAIN,
    SHORTLIST,
    TO_THE_TOP,
    HypothesisSearch,
    sweep,
    tune,
)
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.noise import Structure
from grounded.diagnosis.likelihood.refine import clean, refine
from grounded.diagnosis.validation.ruler import Ruler
from grounded.effects import Effect
from grounded.progress import interruptible
from grounded.result import listed

USUAL_EFFECTS = 3  # that are looked for at first
HOPEFUL = 4  # larger sets that are fitted to the end
TUNED = 2  # sets whose constants are set by the data
FORETOLD = (2.0, 0.05)  # scatters, and least gain, from which what predicts better is grown too
AT_FIRST = 8  # iterations of a further effect that is tried
HALVES = 2  # single effects that are also grown where another hypothesis is likelier
RESTARTED = 3  # large effects that are also fitted from a start of their own


def attribute(
    data: Data,
    candidates: Sequence[Effect],
    *,
    max_effects: int | None = None,
    tick: Callable[[str], None] | None = None,
    joints: Sequence[Effect] = (),
) -> tuple[HypothesisSearch, Fitted]:
    """Searches for the effects that make the gap; returns the search and its best fit.

    Args:
        data: from `prepare`.
        candidates: the effects that may be blamed.
        max_effects: at most so many at once; None: `USUAL_EFFECTS`, more where joints share an
            inertia and each of them is off.
        tick: called with what is being done, for a progress display.
        joints: plain frictions that stand beside richer ones, whether they are candidates or not.
    """
    search, most = HypothesisSearch(data, candidates, tick, joints), max_effects or USUAL_EFFECTS
    with (
        np.errstate(all="ignore"),  # a hypothesis that diverges scores minus infinity
        interruptible(lambda: so_far(search, most)),
    ):
        search, best = _searched(search, any_number=max_effects is None)
        return search, grown(search, best, max(most, len(best.hypothesis.effects)))


def so_far(search: HypothesisSearch, most: int, decided: Sequence[str] | None = None) -> str:
    """The best hypothesis that was fitted, and what it predicts, for someone who can't wait.

    decided: the effects that stood when one more was looked for; None before that.
    """
    if not search.of_size(0):
        return "no hypothesis was fitted yet"
    with np.errstate(all="ignore"):
        ruler, best, crude = Ruler(search.predictor), search.chosen(most), search.of_size(0)[0]
        crude = search.fits.get((Structure(), 0.0, ()), crude)
        at = len(ruler.steps) - 1
        before, after = (ruler.errors(fit).rms[at] for fit in (crude, best))
    model, seconds = search.data.model, ruler.steps[at] * search.data.dt
    rows = ", ".join(
        f"{name} by {after[i]:.3g} instead of {before[i]:.3g} {model.states[name]}"
        for i, name in zip(ruler.shown, ruler.names, strict=True)
    )
    causes = [*best.hypothesis.names, *["calibrated parameters"] * (best.hypothesis.spread > 0)]
    told = f"of {len(search.fits)} hypotheses the likeliest has {listed(causes) or 'no cause'}"
    more = "nothing has confirmed it"
    if decided is not None:
        more = f"{listed(decided) or 'no cause'} stood when one more was looked for"
    return (
        f"so far, {told}; {more}; no diagnosis is stored. {seconds:.2g} s ahead predictions miss "
        f"{rows}"
    )


def _searched(search: HypothesisSearch, *, any_number: bool) -> tuple[HypothesisSearch, Fitted]:
    """Where to grow from, the likeliest; with outliers in the data, the best with their weights."""
    search.nulls()
    best = _explore(search, any_number=any_number)
    if outliers(best):
        search = search.with_weights(clean(search.predictor, best))
        best = _explore(search, any_number=any_number)
    return search, best


def _explore(search: HypothesisSearch, *, any_number: bool) -> Fitted:
    """The best hypothesis of one effect, or without when there is none to try.

    Where any number may be blamed, and none alone is nearly as likely as what all joints do
    together, that.
    """
    null = search.best_null()
    plain = search.fits.get((Structure(), 0.0, ()), null)
    for context in [null] if plain is null else [null, plain]:
        search.extended(context)
    singles = search.of_size(1)
    if not singles:
        return null
    # a large effect has a long way from its first look
    search.finished(singles[:SHORTLIST], 8, rivals=True)
    if any_number and (whole := joint_model(search)) is not None:
        more = search.score(whole) - search.score(search.of_size(1)[0])
        if more > LARGE_GAIN:
            return whole
    search.again(search.of_size(1)[: RESTARTED if search.data.model.n <= LARGE else 2])
    sweep(search)
    search.beside_parameters()
    best = search.of_size(1)[0]
    for _ in range(3):  # with the noise that the best one leaves, others may look better
        search.extended(search.without(best, best.hypothesis.names[-1]))
        search.structures(best)
        search.calibrated(best)
        again = search.of_size(1)[0]
        same = _kind(again) == _kind(best)
        best = again
        if same:
            break
    search.finished(search.of_size(1)[:HOPEFUL], TO_THE_TOP)
    tune(search, search.of_size(1)[:TUNED])
    best = search.of_size(1)[0]
    search.fair(best)
    return max([best, search.best_null()], key=search.score)


def _kind(fit: Fitted) -> tuple[object, ...]:
    """What rivals have to be given too: the effects beside, the noise's structure, the prior."""
    h = fit.hypothesis
    return h.names, fit.noise.structure, h.spread


def outliers(fit: Fitted) -> bool:
    """Whether whitened innovations beyond 4 are far more frequent than a normal law has them."""
    count = float((np.abs(fit.white) > 4.0).sum())
    expected = 6.3e-5 * fit.white.size
    return count > 4 + 3 * expected


def _starts(search: HypothesisSearch, size: int, best: Fitted) -> list[Fitted]:
    """What a further effect is sought beside: the likeliest, the same under plain noise, one more.

    What the further effect does may so far have passed for coloured noise or for parameters; and
    one that predicts clearly better may need it to be likelier.
    """
    likely = [
        f
        for f in search.of_size(size)[: 3 if size == 1 else 1]
        if search.score(f) > search.score(best) - 25
    ]
    found = list(likely)
    for fit in likely[:2]:
        plain = search.fits.get((Structure(), 0.0, tuple(sorted(fit.hypothesis.names))))
        if plain is not None and plain is not fit:
            found.append(plain)
    foretold = _foretold(search, size, best)
    return found if foretold in found else [*found, foretold]


def _foretold(search: HypothesisSearch, size: int, best: Fitted) -> Fitted:
    """What predicts best of the likely sets: far from the noise, evidence favours what acts often.

    (A friction that grows with the load predicts a second ahead what a constant one, hundreds of
    nats likelier step by step, does not.)
    """
    ruler, floor = Ruler(search.predictor), search.score(search.best_null()) + LARGE_GAIN
    rivals = [fit for fit in search.of_size(size)[:HOPEFUL] if search.score(fit) > floor]
    if not rivals or not ruler.held_out:
        return best
    ruler.beside(search.exact_null())
    found = best
    for fit in rivals:
        if fit is not best and ruler.gain(found, fit).beyond(*FORETOLD):
            found = fit
    return found


def _halves(search: HypothesisSearch, starts: Sequence[Fitted]) -> list[Fitted]:
    """The likeliest effects with exact parameters under white noise that nothing grows from yet.

    What two make together passes for a third with more numbers: a bias and a trend for a slow wave.
    (Not where calibration alone is likelier: two effects can do what two wrong parameters do.)
    """
    null, score = search.fits.get((Structure(), 0.0, ())), search.score
    plain = [
        fit
        for (structure, spread, names), fit in search.fits.items()
        if len(names) == 1 and structure == Structure() and not spread
    ]
    likely = sorted(plain, key=lambda fit: -score(fit))[:HALVES]
    if null is None:
        return []
    return [f for f in likely if f not in starts and score(f) > score(null) + LARGE_GAIN]


def promised(search: HypothesisSearch, fit: Fitted) -> float:
    """By how much the likeliest of one effect more is likelier than a fit, at a first fit [nats].

    A scan alone can't tell: coloured noise or parameters, fitted without an effect, hide it, and
    make way only as it grows. Nothing of this is remembered.
    """
    starts = search.one_more(fit, search.most)
    fits = refine(search.predictor, [fit, *starts], iterations=AT_FIRST, worth=search.score)
    more = [search.score(f) for f in fits if len(f.hypothesis.names) > len(fit.hypothesis.names)]
    as_many = [search.score(f) for f in (fit, *fits) if f.hypothesis.names == fit.hypothesis.names]
    return max(more, default=-np.inf) - max(as_many)


def grown(search: HypothesisSearch, best: Fitted, most: int) -> Fitted:
    """The likeliest of up to `most` effects: add one, then swap each for what goes better."""
    size = len(best.hypothesis.effects)
    while 1 <= size < most:
        starts = _starts(search, size, best)
        halves = _halves(search, starts) if size == 1 else []
        grown = [search.extended(start, AT_FIRST) for start in starts]
        grown += [search.extended(half, 4) for half in halves]
        firsts = [max(fits, key=search.score) for fits in grown if fits]  # each has its own noise
        search.finished(list(dict.fromkeys([*search.of_size(size + 1)[:HOPEFUL], *firsts])), 10)
        search.again(search.of_size(size + 1)[:2])
        search.finished(search.of_size(size + 1)[:TUNED], TO_THE_TOP)
        tune(search, search.of_size(size + 1)[:TUNED])
        for fit in search.of_size(size + 1)[:TUNED]:
            search.structures(fit)
            search.calibrated(fit)
        larger = search.of_size(size + 1)
        if not larger or search.score(larger[0]) < search.score(best) + CLAIM:
            break
        best = larger[0]
        for name in best.hypothesis.names:  # what goes better with the others?
            search.extended(search.without(best, name), 6)
        best = search.of_size(size + 1)[0]
        size += 1
    return search.chosen(most)
