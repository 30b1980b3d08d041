"""Effects that are likely but unconfirmed: too few trials show them to test them on held-out data.

The same holds for an effect that shows in one repeated motion only. They are
never claimed. Each is reported with the trial, the time and the region that show it, which is
where a further trial should go. An effect that is likely in most trials and yet improves no
held-out prediction points to a flaw of the likelihood: it is marked in the table, so that its
evidence is not taken for a cause.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from grounded import places
from grounded.diagnosis.cause_words import meaning
from grounded.diagnosis.error_report import Part, RulerRow
from grounded.diagnosis.hypotheses.explored import no_limits
from grounded.diagnosis.likelihood.levels import NATS, SURE
from grounded.diagnosis.next_trial import LOG, LOST
from grounded.diagnosis.parts import Ranked, Unconfirmed
from grounded.diagnosis.validation.acting import acting
from grounded.diagnosis.validation.claims import Claims
from grounded.diagnosis.validation.decide import Doubtful
from grounded.diagnosis.validation.prediction_error import by_region
from grounded.effects import Effect, RateFamily
from grounded.frozen import Array
from grounded.result import listed, number, with_unit
from grounded.task import Task
from grounded.trial import Trial

MENTIONED = 2
FAR_OFF = 2.0  # times the range of the target and the best run: a run beyond it has failed
TRIFLE = 0.1  # of a prediction error: an effect that changes states by less shows in none


def unconfirmed(
    claims: Claims,
    doubtful: Sequence[Doubtful],
    groups: Sequence[Sequence[str]] = (),
    row: RulerRow | None = None,
) -> tuple[Unconfirmed, ...]:
    """Return the likeliest effects that were dropped and that few trials show, without ties.

    Args:
        claims: the causes that are claimed.
        doubtful: the likely effects that were dropped.
        groups: effects that the data cannot tell apart.
        row: prediction errors; effects that are trifles beside these are not returned.
    """
    if claims.known.no_cause:
        return ()
    tied = {name for group in groups for name in group}
    left = [one for one in doubtful if one.name not in tied]
    left = [one for one in left if one.name not in no_limits(claims.data, one.fit.hypothesis)]
    found = [_seen(claims, one) for one in left if row is None or not _trifling(claims, one, row)]
    return tuple([one for one in found if one is not None][:MENTIONED])


def _trifling(claims: Claims, one: Doubtful, row: RulerRow) -> bool:
    """Return whether an effect hardly changes any state beside the errors of predictions.

    Nobody needs to drive for a rate that is shown 0.05 % too large.
    """
    data, h, x = claims.data, one.fit.hypothesis, one.fit.track
    less = h.minus(one.name)
    both = [claims.predictor.next(each, x[:-1]) for each in (less, h)]
    moved = np.where(data.valid.T[..., None], data.model.difference(*both), 0.0)
    total = np.concatenate([np.zeros_like(moved[:1]), np.cumsum(moved, axis=0)])
    steps = min(max(1, round(row.horizon_s / data.dt)), len(moved))
    shown = np.zeros_like(x) + claims.predictor.offset(h, x) - claims.predictor.offset(less, x)
    size = np.abs(total[steps:] - total[:-steps]).max(axis=(0, 1), initial=0.0)
    size += np.abs(shown).max(axis=(0, 1), initial=0.0)
    errors = [row.with_effects.get(name, 0.0) for name in data.model.state_names]
    return bool((size <= TRIFLE * np.nan_to_num(errors)).all())


def _seen(claims: Claims, one: Doubtful) -> Unconfirmed | None:
    if not (few := one.one_group):
        return None
    data, acts = claims.data, acting(claims.predictor, one.fit, one.name)
    trial = int(np.bincount(data.trial_of, acts.sum(axis=0), data.count).argmax())
    own = np.flatnonzero(data.trial_of == trial)
    run = int(own[acts[:, own].sum(axis=0).argmax()])
    start, end = (t * data.dt for t in _stretch(acts[:, run] - acts.mean()))
    i = one.fit.hypothesis.names.index(one.name)
    anywhere = _anywhere(one.fit.hypothesis.effects[i])
    regions = by_region(acts, claims.predictor, one.fit, 1, but=anywhere)
    by = np.bincount(data.trial_of, acts.sum(axis=0), data.count)
    params, begin = claims.estimates(one.fit)[i], data.time[0, run]
    if not any(abs(e.value) > SURE * e.std for e in params.values()):
        return None  # its size is unknown
    return Unconfirmed(
        one.name,
        meaning(one.fit.hypothesis.effects[i], params),
        params,
        one.nats,
        data.ids[trial] or str(trial + 1),
        float(begin + start),
        float(begin + end),
        (few, data.count),
        regions[0] if regions else None,
        few > 1,
        tuple(data.ids[k] or str(k + 1) for k in np.argsort(-by)[:few]),
    )


def _anywhere(effect: Effect) -> Sequence[str]:
    """Return the coordinates on the ground if an effect acts alike at all places.

    A motor's delay showed "where y < -3.95 m": only the drive by hand went there.
    """
    where = places.position(effect.site.model)
    return () if len(where) < 2 or isinstance(effect.family, RateFamily) else where


def marked(ranking: Sequence[Ranked], likely: Collection[str]) -> tuple[Ranked, ...]:
    """Mark effects that are likely and yet do not improve held-out predictions."""
    return tuple(
        replace(r, no_better=r.effect in likely and not r.claimed and not r.evidence < NATS)
        for r in ranking
    )


def unrepeatable(task: Task, trials: Sequence[Trial]) -> dict[str, str]:
    """Return the trials that cannot or should not be repeated, with the reason.

    Only the run of a candidate can be repeated, and only if it did not fail. A run has failed if
    it ended early, left [safety], or strayed from the target by more than FAR_OFF times the range
    of the target and the best run.
    """
    assert task.safety_low is not None and task.safety_high is not None
    ran = [trial for trial in trials if trial.candidate]
    best = max(ran, key=task.utility, default=None)
    found = {trial.id: LOG for trial in trials if not trial.candidate}
    for trial in ran:
        states = trial.states[: task.horizon + 1]
        outside = (states < task.safety_low) | (states > task.safety_high)
        lost = math.isinf(task.utility(trial)) or outside.any() or _far(task, trial, best)
        if trial is not best and lost:
            found[trial.id] = LOST
    return found


def another_look(
    task: Task | None,
    trials: Sequence[Trial],
    left: str,
    when: str = "",
    *,
    noise: bool = False,
    begins: str = "",
    part: Part | None = None,
) -> str:
    """Return what to run to investigate a leftover: first a repeat, then a new motion.

    Args:
        task: the task of the candidates; None for bare trials.
        trials: the trials that were diagnosed.
        left: the channel whose error has no known cause.
        when: where most of it is, as `Region.phrase`; "" if that is no place.
        noise: whether all of that error may be noise, so that it is not called a gap.
        begins: the channel in which most of the one-step errors are; "" for `left` itself.
        part: the short part of a trial in which most of it is.
    """
    if part is not None:
        then = another_look(task, trials, left, when, noise=noise, begins=begins)
        return (
            f"Look at {part.when} in its recording: was the robot held, pushed or in contact with "
            f"something then? If so, discard {part.trial or 'it'} and ingest its log without that "
            f"part; if not, {then[:1].lower()}{then[1:]}"
        )
    what = f"how much of what is left in {left} is noise" if noise else f"the gap in {left}"
    runs = Counter(trial.candidate or trial.inputs.tobytes() for trial in trials)
    if max(runs.values(), default=0) > 1:
        where = f"spends more time {when}" if when else f"moves {begins or left} in another way"
        if begins not in ("", left):
            what += f" (most of the one-step errors are in {begins})"
        how = "" if when else f": {_another_way(task, trials)}"
        return f"Run a trial that {where}, to investigate {what}{how}."
    why = f"to see {what}" if noise else f"to see whether {what} repeats"
    ran = [trial for trial in trials if trial.candidate] if task else []
    best = max(ran, key=task.utility, default=None) if task else None
    if task is None or best is None or math.isinf(task.utility(best)):
        return (
            "Record one run three times, sending the same inputs each time (if the robot needs "
            f"feedback: the same setpoints, from the same start), {why}."
        )
    return f"Run {best.candidate} twice more, {why}."


def _another_way(task: Task | None, trials: Sequence[Trial]) -> str:
    """Say how to move a robot as no trial did: by which commands, within which limits, by whom."""
    last, names = trials[-1], [*trials[-1].input_names]
    few = len(names) <= MENTIONED
    limits = []
    if few and task is not None:
        for (name, unit), low, high in zip(
            task.model.inputs.items(), task.low, task.high, strict=True
        ):
            if np.isfinite([low, high]).all():
                ends = f"{number(low)} to {number(high)}"
                limits.append(with_unit(f"{name} from {ends}", unit))
    inside = f", inside [limits] ({'; '.join(limits)})" if limits else ", inside its limits"
    by_hand = next((trial.id for trial in reversed(trials) if not trial.candidate), "")
    who = f"drive it by hand, as in {by_hand}," if by_hand else "drive it by hand"
    other = "; or draw another manoeuvre and run its candidates" if last.candidate else ""
    return (
        f"{who} with short steps of {listed(names) if few else 'every input'} of different sizes, "
        f"both ways by turns, then with slow sweeps{inside}{other}"
    )


def _far(task: Task, trial: Trial, best: Trial | None) -> bool:
    if best is None:
        return False
    both = np.concatenate([best.states[: len(task.target)], task.target])
    room = FAR_OFF * (np.nanmax(both, axis=0) - np.nanmin(both, axis=0))
    steps = min(len(trial.states), len(task.target))  # an older task may have been longer
    off = task.model.difference(trial.states[:steps], task.target[:steps])
    return bool((np.abs(off) > room).any())


def _stretch(more: Array) -> Any:
    """Return the interval of steps with the largest sum (Kadane's algorithm)."""
    total = np.concatenate([[0.0], np.cumsum(more)])
    least = np.minimum.accumulate(total)
    end = int((total - least).argmax())
    return int(total[: end + 1].argmin()), end
