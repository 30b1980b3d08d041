"""The rule that decides what is claimed: the smallest set of causes that predicts as well as any.

Search proposes, this rule claims. Every set of causes that was fitted is an `Option`: its evidence,
and its errors where its values were not fitted (`ruler`, by group of trials). The rule has four
steps:

    1. A set is *supported* if each of its causes is: with it the set is likelier (CLAIM nats), and
       predictions are better by more than their standard error, as much as matters (LEAST, and
       SHARE of what the best set gains). A cause that a guard refuses is not supported.
    2. The *reference* is the supported set that predicts best.
    3. Of the supported sets within WITHIN standard errors of the reference, the smallest is chosen
       (the one-standard-error rule of Breiman et al. 1984, and of projection predictive selection,
       Piironen & Vehtari 2017).
    4. Of those that are as small, the likeliest. Within CLAIM nats they tie: then a parameter comes
       before a mechanism, and that before what has no mechanism (`Option.order`).

A cause is an effect, or the calibration of the model's own parameters. `benchmarks/decide.py` draws
each number's curve.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from grounded.diagnosis.validation.gain import LEAST, Errors, Gain

CLAIM = 3.0  # nats by which a cause must make a set likelier; within which two sets tie
SCATTERS = 1.0  # standard errors by which predictions must gain by each cause
SHARE = 0.01  # of what the best set gains, below which a cause does not matter
WITHIN = 1.0  # standard errors of the reference within which a smaller set predicts as well


@dataclass(frozen=True, eq=False)
class Option:
    """A fitted set of causes.

    Args:
        causes: names of its effects, and "calibration" if the parameters are free.
        evidence: log evidence, priced and tempered [nats].
        errors: held-out errors.
        order: of its causes: 0 a parameter, 1 a mechanism, 2 without a mechanism, summed up.
        refused: causes that a guard refuses, whatever they gain.
    """

    causes: frozenset[str]
    evidence: float
    errors: Errors
    order: int = 0
    refused: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class Choice:
    """What the rule chose, the reference that it was measured by, and which sets are supported."""

    chosen: Option
    reference: Option
    supported: tuple[Option, ...]
    lost: float  # log gain of the reference over the chosen set
    standard_error: float


def choose(options: Sequence[Option], gain: Callable[[Errors, Errors], Gain]) -> Choice:
    """Choose among sets of causes.

    Args:
        options: the fitted sets, of each at most one, with the set without any cause.
        gain: compares the errors of two of them.
    """
    by_causes = {option.causes: option for option in options}
    crude = by_causes[frozenset()]

    def gained(option: Option) -> float:
        return gain(crude.errors, option.errors).mean

    most = max(map(gained, options))
    supported = [o for o in options if not unsupported(o, by_causes, gain, SHARE * most)]
    reference = max(supported, key=gained)
    near = [o for o in supported if _as_good(o, reference, gain)]
    smallest = min(len(option.causes) for option in near)
    small = [option for option in near if len(option.causes) == smallest]
    likeliest = max(option.evidence for option in small)
    tied = [option for option in small if option.evidence > likeliest - CLAIM]
    chosen = min(tied, key=lambda option: (option.order, -option.evidence))
    apart = gain(chosen.errors, reference.errors)
    return Choice(chosen, reference, tuple(supported), apart.mean, apart.scatter)


def unsupported(
    option: Option,
    known: Mapping[frozenset[str], Option],
    gain: Callable[[Errors, Errors], Gain],
    least: float,
) -> list[str]:
    """Return the causes of a set that it does not need, or that a guard refuses.

    Args:
        option: the set.
        known: all options by their causes.
        gain: compares the errors of two options.
        least: mean log gain below which a cause does not matter.
    """
    found = list(option.refused)
    for cause in sorted(option.causes - option.refused):
        less = known.get(option.causes - {cause})
        if less is None or option.evidence - less.evidence < CLAIM:
            found.append(cause)
            continue
        more = gain(less.errors, option.errors)
        if more.mean < least or not more.pays(SCATTERS):
            found.append(cause)
    return found


def _as_good(option: Option, best: Option, gain: Callable[[Errors, Errors], Gain]) -> bool:
    """Check whether a set predicts as well as the best: within standard errors, or what matters."""
    more = gain(option.errors, best.errors)
    return more.mean <= max(WITHIN * more.scatter, LEAST)
