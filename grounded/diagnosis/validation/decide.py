"""From the fitted hypotheses to a decision: options for the rule (`choose`), and guards.

Evidence proposes, held-out predictions decide. The likeliest hypothesis can be wrong in ways that
its evidence does not show: coloured noise or free parameters can absorb a persistent effect that
predictions a second ahead still miss, and far above the noise floor likelihoods are those of a
wrong model. So the likeliest hypotheses of every size, with and without free parameters, and every
set that one of their causes less makes, are measured by the `ruler`; `choose` picks one.

A guard refuses a cause whatever it gains:

    cut        beside it, a parameter of the model ends at a bound at which it is not without it:
               the bound decides how large the cause is
    no size    none of its values differs from zero by NO_SIZE standard deviations
    one group  it names no mechanism (`Family.loose`) and only one group of trials shows it
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.error_report import CALIBRATION
from grounded.diagnosis.hypotheses.leftover import Leftover, corrections, leftovers
from grounded.diagnosis.hypotheses.search import TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.intervals import standard_deviations
from grounded.diagnosis.likelihood.noise import Structure
from grounded.diagnosis.validation.choose import CLAIM, SHARE, Choice, Option, choose, unsupported
from grounded.diagnosis.validation.gain import Errors
from grounded.diagnosis.validation.ruler import Ruler
from grounded.effects import ParamFamily
from grounded.frozen import Array

MEASURED = 8  # likeliest sets of each size, with and without free parameters, that are measured
REFIT = 12  # iterations after a cause was removed
NO_SIZE = 2.0  # standard deviations from zero below which a value is none
LIKELY = 10.0  # nats from which an effect that is not claimed is told


@dataclass(frozen=True, eq=False)
class Doubtful:
    """A likely effect that is not claimed: predictions gain too little, or one group shows it."""

    name: str
    nats: float
    fit: Fitted  # including the effect
    one_group: int = 0  # trials of the only group that shows it


@dataclass(frozen=True, eq=False)
class Decision:
    """The claim: its fit, the crude model's fit, and the fit without each of its causes."""

    search: HypothesisSearch
    fit: Fitted
    crude: Fitted
    without: dict[str, Fitted]  # by effect, or "calibration"
    choice: Choice
    doubtful: tuple[Doubtful, ...]  # likeliest first
    left: tuple[Leftover, ...]  # structure that the claim leaves, by channel
    flexible: dict[str, tuple[Leftover, Errors]]  # of these, what improves predictions if corrected
    leader: str  # the effect that predictions need most; "" without one

    @property
    def gap(self) -> bool:
        """Whether a flexible correction predicts what the claim leaves."""
        return bool(self.flexible)

    @property
    def causes(self) -> tuple[str, ...]:
        """The effects of the fit, and calibration if its parameters are free."""
        return causes(self.fit)


def causes(fit: Fitted) -> tuple[str, ...]:
    """Return the effects of a fit, and "calibration" if its parameters are free."""
    return (*fit.hypothesis.names, *((CALIBRATION,) if fit.hypothesis.spread > 0 else ()))


def equations(fit: Fitted) -> list[str]:
    """Return the names of the effects that are not parameters."""
    return [e.name for e in fit.hypothesis.effects if not isinstance(e.family, ParamFamily)]


def decide(search: HypothesisSearch, ruler: Ruler) -> Decision:
    """Choose the hypothesis that held-out predictions support.

    Args:
        search: holds all hypotheses that were fitted; sets of fewer causes are added.
        ruler: measures predictions of the same data.
    """
    ruler.beside(search.exact_null())
    fits = complete(search, hopeful(search))
    crude = fits[frozenset()]
    options = [_option(search, ruler, fits, own) for own in fits]
    choice = choose(options, ruler.compared) if ruler.held_out else _by_evidence(options)
    fit = fits[choice.chosen.causes]
    search.settled([fit, *(fits[fit_causes(fit) - {c}] for c in causes(fit)), search.best_null()])
    without = {c: search.latest(fits[fit_causes(fit) - {c}]) for c in causes(fit)}
    open_ = _doubtful(search, ruler, fits, options, choice)
    fit = search.latest(fit)
    left = leftovers(search.predictor, fit)
    leader = min(fit.hypothesis.names, key=lambda n: ruler.gain(fit, without[n]).mean, default="")
    return Decision(
        search, fit, search.latest(crude), without, choice, open_, tuple(left),
        corrections(ruler, fit, left), leader,
    )  # fmt: skip


def fit_causes(fit: Fitted) -> frozenset[str]:
    """Return the causes of a fit as a set."""
    return frozenset(causes(fit))


def hopeful(search: HypothesisSearch) -> list[Fitted]:
    """Return the likeliest sets of each size, with and without free parameters, likeliest first."""
    best = dict[frozenset[str], Fitted]()
    for fit in sorted(search.fits.values(), key=search.score, reverse=True):
        if np.isfinite(search.score(fit)):
            best.setdefault(fit_causes(fit), fit)
    count = dict[tuple[int, bool], int]()
    found = []
    for fit in best.values():
        kind = len(fit.hypothesis.names), fit.hypothesis.spread > 0
        count[kind] = count.get(kind, 0) + 1
        if count[kind] <= MEASURED:
            found.append(fit)
    return found


def complete(search: HypothesisSearch, fits: Iterable[Fitted]) -> dict[frozenset[str], Fitted]:
    """Return the fits by their causes, with every set that one cause less makes fitted as well.

    A set is fitted from the values and the noise of the larger one; otherwise the cause that it
    lacks would be credited with what better values of the others gain. The set that is taken is the
    likeliest under any noise: a cause gets no credit for what the rest can do under another noise.
    """
    found = {frozenset[str](): search.exact_null()}
    todo = list(fits)
    while todo:
        fit = todo.pop(0)
        own = fit_causes(fit)
        if own in found:
            continue
        found[own] = fit
        for cause in own:
            if own - {cause} not in found:
                todo += _less(search, fit, cause)
    return found


def _less(search: HypothesisSearch, fit: Fitted, cause: str) -> list[Fitted]:
    """Return the likeliest fit without one cause, fitted from that fit if its noise was not."""
    h = fit.hypothesis
    less = replace(h, shift=None, spread=0.0) if cause == CALIBRATION else h.minus(cause)
    own = frozenset(less.names), less.spread > 0

    def known() -> list[Fitted]:
        return [f for f in search.fits.values() if _kind(f) == own]

    if not any(f.noise.structure == fit.noise.structure for f in known()):
        search.refined([(less, fit.noise, fit.track)], REFIT)
    some = known()
    return [max(some, key=search.score)] if some else []


def _kind(fit: Fitted) -> tuple[frozenset[str], bool]:
    return frozenset(fit.hypothesis.names), fit.hypothesis.spread > 0


def _option(
    search: HypothesisSearch, ruler: Ruler, fits: dict[frozenset[str], Fitted], own: frozenset[str]
) -> Option:
    """Return a fit as an option, with the causes that a guard refuses."""
    fit = fits[own]
    effects = {e.name: e for e in fit.hypothesis.effects}
    order = sum(
        0 if isinstance(e.family, ParamFamily) or e.known else 1 + e.family.loose
        for e in effects.values()
    )
    refused = set(_of_no_size(search, fit))
    for name in effects:
        less = fits.get(own - {name})
        cut = less is not None and not {*stopped(search, fit)} <= {*stopped(search, less)}
        if cut or (less is not None and _one_group(search, fit, less, name)):
            refused.add(name)
    return Option(own, search.score(fit), ruler.errors(fit), order, frozenset(refused))


def stopped(search: HypothesisSearch, fit: Fitted) -> list[str]:
    """Return the model's parameters that a fit leaves at a bound."""
    model, shift = search.data.model, fit.hypothesis.shift
    values = model.values if shift is None else model.values + shift
    params = zip(model.params.items(), values, strict=True)
    return [name for (name, param), value in params if param.stopped(float(value))]


def _of_no_size(search: HypothesisSearch, fit: Fitted) -> list[str]:
    """Return the effects of a fit of which no coefficient is known to differ from zero.

    Parameters are exempt, since they have priors.
    """
    at, sizes = 0, dict[str, list[int]]()
    for effect in fit.hypothesis.effects:
        own = [at + k for k, q in enumerate(effect.free) if not q.grid]
        if own and not isinstance(effect.family, ParamFamily):
            sizes[effect.name] = own
        at += len(effect.free)
    if not sizes:
        return []
    theta = fit.hypothesis.theta
    std: Array = standard_deviations(search.predictor, fit, search.data.folds)[0]
    return [n for n, k in sizes.items() if (np.abs(theta[k]) < NO_SIZE * std[k]).all()]


def _one_group(search: HypothesisSearch, fit: Fitted, less: Fitted, name: str) -> int:
    """Return the number of trials of the only group that shows an effect without a mechanism.

    0 if several groups show it, or if it names a mechanism.

    Along one motion, any error of the model is the same function of time, and of every state; each
    repeat raises the evidence of an effect that fits it, and none confirms it. So the group with
    the most evidence is not counted. (Of a single long log, its pieces are the groups.)
    """
    data, h = search.data, fit.hypothesis
    if not h.effects[h.names.index(name)].family.loose:
        return 0
    lost = 0.5 * (less.rss + less.logdet - fit.rss - fit.logdet)
    group = data.folds if data.count == 1 else data.group_of[data.trial_of]
    nats = search.tempering.factor * np.bincount(group, lost)
    most = int(nats.argmax())
    alone = nats.sum() - nats.max() < CLAIM
    return len(np.unique(data.trial_of[group == most])) if alone else 0


def _by_evidence(options: Sequence[Option]) -> Choice:
    """Return the likeliest set of which each cause is likely, where nothing can be held out."""
    known = {option.causes: option for option in options}

    def likely(option: Option) -> bool:
        less = [known.get(option.causes - {cause}) for cause in option.causes]
        rest = all(o is not None and option.evidence - o.evidence > CLAIM for o in less)
        return rest and not option.refused

    supported = tuple(filter(likely, options))
    chosen = max(supported, key=lambda option: option.evidence)
    return Choice(chosen, chosen, supported, 0.0, 0.0)


def _doubtful(
    search: HypothesisSearch,
    ruler: Ruler,
    fits: dict[frozenset[str], Fitted],
    options: Sequence[Option],
    choice: Choice,
) -> tuple[Doubtful, ...]:
    """Return the effects that are likely beside the choice but not supported, likeliest first."""
    found, known = dict[str, Doubtful](), {option.causes: option for option in options}
    for option in options if ruler.held_out else ():
        (name, *more) = option.causes - choice.chosen.causes or ("",)
        nats = option.evidence - choice.chosen.evidence
        if more or not choice.chosen.causes < option.causes or nats < LIKELY:
            continue
        fit = fits[option.causes]
        if name in equations(fit) and unsupported(option, known, ruler.compared, SHARE):
            alone = _one_group(search, fit, fits[choice.chosen.causes], name)
            found[name] = Doubtful(name, nats, fit, alone)
    return tuple(sorted(found.values(), key=lambda one: -one.nats))


def plain(search: HypothesisSearch, fit: Fitted) -> Fitted:
    """Return the same hypothesis under white noise."""
    h = fit.hypothesis
    if fit.noise.structure == Structure():
        return fit
    known = search.fits.get((Structure(), h.spread, tuple(sorted(h.names))))
    noise = fit.noise.allowing(Structure(), search.data.dt)
    found = [known] if known else search.refined([(h, noise, fit.track)], TO_THE_TOP)
    return found[0] if found else fit
