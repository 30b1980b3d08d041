"""next_step: the trial that would tell more, or why none is needed; `excitation` designs it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

from grounded.diagnosis.causes import acts_reversed, sign_only
from grounded.diagnosis.levels import HALF
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.findings import Finding, found
from grounded.model import all_at_bounds

if TYPE_CHECKING:
    from grounded.diagnosis.parts import Diagnosed
    from grounded.diagnosis.validation.claims import Claims
    from grounded.task import Task
    from grounded.trial import Trial


def next_step(
    d: Diagnosed,
    claims: Claims,
    doubt: Finding | None,
    off: str,
    task: Task | None,
    trials: Sequence[Trial],
    adopted: Collection[str] = (),
) -> Finding:
    """Return what to do next.

    Args:
        d: the diagnosis.
        claims: the causes that are claimed.
        doubt: why adopting them is unwise (`objection`).
        off: the state whose error has no known cause, or may be noise; "" for none.
        task: the task of the candidates; None for bare trials.
        trials: those that were diagnosed.
        adopted: adopted effects, whose values are parameters of the model.
    """
    from grounded.effects import ParamFamily, like_a_load

    model, names, effects = claims.data.model, claims.names, claims.best.hypothesis.effects
    if d.no_cause:
        return found("gap.next.record")
    if d.changed:
        return found("gap.next.changed")
    known = claims.parameters()
    off_bounds = {n: known[n].value for n in d.verdict.parameters}
    ended = all_at_bounds(model.params, off_bounds)
    turned = [row for row in d.ranking if row.effect in names and _to_flip(row, ended)]
    separable = [group for group in d.indistinguishable if group not in d.equivalent]
    if separable:
        first, *others = separable[0]
        return found("gap.next.apart", effect=first, others=tuple(others))
    if d.unconfirmed and not d.indistinguishable:
        one = d.unconfirmed[0]
        place = one.region.told if one.region else None
        return found(
            "gap.next.confirm",
            one.effect,
            effect=one.effect,
            place=place,
            repeats=one.repeats,
            trial=None if one.repeats else one.trial,
        )
    look = _look(d, off, task, trials, simulated(model)) if off else None
    if not names and look is not None:
        return look
    if not names and not claims.blamed:
        return found("gap.next.none", adopted=bool(adopted))
    if doubt is not None:
        return doubt
    if len(names) > 1 and like_a_load(model, names):
        return found("gap.next.load", *names)
    if turned:
        return found("gap.next.flip", input=turned[0].effect.partition(":")[2])
    if ended:
        return found("gap.next.bounds", *off_bounds)
    own = all(isinstance(effect.family, ParamFamily) for effect in effects) and not adopted
    return found("gap.next.adopt", own="yes" if own else "no", left=bool(d.leftover))


def _to_flip(row: object, ended: bool) -> bool:
    """Return whether an input's sign is to be flipped before anything is adopted.

    If parameters ended at their bounds, the strength of a reversed input is not known.
    """
    name, params = row.effect, row.params  # type: ignore[attr-defined]
    gain = name.startswith("input_gain:")
    return sign_only(name, params) or (ended and gain and acts_reversed(params))


def _look(
    d: Diagnosed, off: str, task: Task | None, trials: Sequence[Trial], step_only: bool
) -> Finding:
    """Return what to run to investigate a leftover: first a repeat, then a new motion."""
    left = d.leftover[0] if d.leftover else None
    if left is not None and left.part is not None:
        part = left.part
        return found("gap.next.look", trial=part.trial, start=part.start, end=part.end)
    runs = Counter(trial.candidate or trial.inputs.tobytes() for trial in trials)
    if max(runs.values(), default=0) > 1:
        # most one-step errors may be in a rate, whose position only sums them up
        first = d.where.channels[0] if left and not d.effects and d.where.channels else None
        state = first.name if first is not None and first.share > HALF else off
        region = left.region if left is not None else None
        there = region is not None and region.occupancy < HALF and not region.of_time
        return found(
            "gap.next.elsewhere",
            state=state,
            place=region.told if region is not None and there else None,
            elsewhere=not there,
            inputs=tuple(trials[-1].input_names) if not there else None,
            term=left is not None and not step_only,
        )
    ran = [trial for trial in trials if trial.candidate] if task else []
    best = max(ran, key=task.utility, default=None) if task else None
    known = task is not None and best is not None and not math.isinf(task.utility(best))
    name = best.candidate if known and best is not None else None
    return found("gap.next.repeat", state=off, candidate=name, log=name is None)
