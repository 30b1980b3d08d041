"""A decision, written out as a `Diagnosis`: what each room says of it, findings, the next step."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from grounded import places
from grounded.accounts.finding import in_the_log
from grounded.diagnosis.causes import (
    effect_of,
    furthest_apart,
    meaning,
    sign_only,
    value_called,
)
from grounded.diagnosis.error_report import (
    CALIBRATION,
    TOLD,
    ChannelShare,
    Gap,
    RulerRow,
    Where,
    errors,
    excess,
    furthest,
    lost_most,
    open_noise,
)
from grounded.diagnosis.hypotheses.leftover import correction
from grounded.diagnosis.levels import SURE
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.noise import NoiseModel
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.parts import (
    Changed,
    Diagnosis,
    Estimate,
    Made,
    NoiseLevels,
    Score,
    TrialGroup,
    Unconfirmed,
    Verdict,
)
from grounded.diagnosis.validation.agreement import by_trial
from grounded.diagnosis.validation.claims import Claims
from grounded.diagnosis.validation.decide import Decision, Doubtful
from grounded.diagnosis.validation.limits import Sound
from grounded.diagnosis.validation.measured import (
    Measured,
    by_region,
    by_time,
    explained,
)
from grounded.diagnosis.validation.ruler import Ruler
from grounded.effects import Effect, acting_order, wrapping_order
from grounded.findings import Finding, Quantity, Weight, found
from grounded.model import Model
from grounded.result import number
from grounded.task import Task
from grounded.trial import Trial

MOST_EFFECTS = 12  # most effects blamed at once


def written(
    decision: Decision,
    ruler: Ruler,
    sound: Sound,
    uncertain: Predictor,
    *,
    adopted: Collection[str],
    most: int,
    task: Task | None,
    apart: tuple[Changed, ...] | None,
) -> Diagnosis:
    """Write a decision out.

    Args:
        decision: what is claimed.
        ruler: the held-out errors that it rests on.
        sound: the data, and what was found while they were made sound.
        uncertain: evaluates hypotheses with those parameters free that the search held.
        adopted: adopted effects, whose values are parameters of the model.
        most: as many effects were looked for.
        task: the task, None for a model alone.
        apart: what differs between two groups of trials, None without groups.
    """
    best, search, left = decision.fit, decision.search, decision.left
    data, states = search.data, search.data.model.state_names
    trials = [trial for trial in sound.looked.trials if trial.known_steps >= 2]
    measured = Measured(decision, ruler, trials, sound.first, sound.exact)
    credit = {one.of: one.share for one in measured.credits}
    claims = Claims(decision, credit, sound.limits, ruler, uncertain)
    rows, remainder = measured.prediction_error(), measured.remainders()
    ranking, groups = claims.ranking(measured), claims.groups()
    named = [row.effect for row in ranking if row.claimed]

    # where the gap is; without a cause or a leftover it is noise, and shares tell nothing
    gain = explained(ruler.predictor, Hypothesis(), best)
    if left:
        gain = gain.copy()
        gain[..., states.index(left[0].channel)] += left[0].improvement
    located = bool(named or remainder)
    if remainder and not named:  # what is left elsewhere is no gap
        off_too = [states.index(one.channel) for one in remainder]
        gain = np.where(np.isin(np.arange(gain.shape[-1]), off_too), gain, 0.0)
    total, region = gain.sum(axis=-1), by_region if located else lambda *_: []
    where = Where(
        channels=_channels(ruler, gain if located else np.full_like(gain, np.nan), rows),
        times=tuple(by_time(total, data)) if located else (),
        regions=tuple(region(total, ruler.predictor, best)),
        whiteness=measured.whiteness,
        tempering=search.tempering.factor,
    )
    gap = Gap(
        horizon_s=ruler.steps[-1] * data.dt,
        unit="noise-normalised rms",
        before=measured.gap(decision.crude),
        after=measured.gap(best),
        floor=1.0,
        held_out=ruler.held_out,
    )

    # log scores of the crude model, the choice and the reference
    choice, crude = decision.choice, ruler.score(decision.crude)
    chosen = crude + ruler.gain(decision.crude, best).mean
    values, agreement = by_trial(best, data, named) if named else ((), ())
    ids = [name or f"#{i + 1}" for i, name in enumerate(data.ids)]
    said = Diagnosis(
        verdict=Verdict("unknown"),
        where=where,
        ranking=ranking,
        indistinguishable=groups,
        equivalent=claims.equivalent(groups),
        gap=gap,
        leftover=remainder,
        unconfirmed=unconfirmed(claims, decision.doubtful, groups),
        correction=correction(ruler, best, left),
        noise=_noise(best.noise, ruler),
        parameters=claims.parameters(),
        identifiable=claims.identified.parameters,
        combinations=claims.identified.combinations,
        prediction_error=rows,
        credit=measured.credits,
        per_trial=values,
        agreement=agreement,
        changed=apart,
        trials=data.count,
        groups=tuple(
            TrialGroup(f"g{k}", tuple(ids[i] for i in group.trials), group.differs_in)
            for k, group in enumerate(data.groups, 1)
        ),
        held_out=ruler.by,
        score=Score(crude, chosen, chosen + choice.lost, choice.standard_error),
        steps=data.steps,
        candidates=len(search.candidates),
        preflight=sound.looked.findings,
        made=Made(nominal=dict(zip(data.model.params, data.model.values.tolist(), strict=True))),
        tracked=() if task is None else _tracked(task),
    )

    # the verdict, what is told beside it, and the next step
    limits = sound.limits
    if limits.no_cause:
        verdict = Verdict("unknown", limit=limits.findings[0].code)
    else:
        off = tuple(data.model.param_names[i] for i in claims.moved)
        full = len(claims.names) == most
        verdict = verdict_of(said, off, best.hypothesis.effects, adopted, full=full)
    said = replace(said, verdict=verdict, acting=_in_action(best.hypothesis, verdict.effects))
    more = [found("gap.more", most=most)] * verdict.again
    step = next_step(said, trials, adopted)
    told = (*limits.findings, *more, *remarks(said, data.model, adopted), step)
    return replace(said, findings=told)


def verdict_of(
    d: Diagnosis,
    off: Sequence[str],
    effects: Sequence[Effect],
    adopted: Collection[str],
    *,
    full: bool,
) -> Verdict:
    """Return the verdict where causes can be named; `full`: as many are as were looked for."""
    claimed = tuple(row.effect for row in d.ranking if row.claimed)
    if not claimed:
        row = furthest(d.prediction_error)
        bound = row is not None and row.floor_at_most
        unsure = bound and not excess(d.prediction_error) and not adopted
        return Verdict("unknown" if d.leftover or unsure else "none")
    return Verdict(
        "effect" if len(claimed) == 1 else "several",
        effects=claimed,
        causes=_causes(d, off, effects, adopted),
        parameters=tuple(off),
        again=full and any(one.above for one in d.leftover),
    )


def _causes(
    d: Diagnosis, off: Sequence[str], effects: Sequence[Effect], adopted: Collection[str]
) -> tuple[str, ...]:
    """The words of each cause, the largest first; of parameters, all that are adopted count."""
    called = [value_called(name, adopted) for name in off]
    each = [
        f"{c} = {d.parameters[n].text}, was {number(d.made.nominal[n])}"
        for c, n in zip(called, off, strict=True)
    ]
    shown = each if len(off) <= TOLD else called[:TOLD]
    rest = len({*off, *d.adoptable}) - len(shown)
    words = (*shown, *[f"{rest} more"] * (rest > 0))
    values = words if len(off) <= TOLD else None
    own = found("model.off", values=values, names=words).sentence
    by_name = {effect.name: effect for effect in effects}
    return tuple(
        meaning(by_name[one.of], row.params)
        if one.of in by_name and (row := d.ranked(one.of))
        else own
        for one in d.credit
    )


def _channels(ruler: Ruler, gain: Any, rows: Sequence[RulerRow]) -> tuple[ChannelShare, ...]:
    """Each state's part of the gap, NaN of NaN, with the ruler's errors a second ahead."""
    above = np.maximum(gain.sum(axis=(0, 1)), 0.0)
    share, ahead = above / max(float(above.sum()), 1e-12), furthest(rows) or rows[0]
    units = ruler.predictor.data.model.states
    each = (
        ChannelShare(name, float(share[i]), ahead.crude[name], units[name], ahead.noise_floor[name])
        for i, name in zip(ruler.shown, ruler.names, strict=True)
    )
    return tuple(sorted(each, key=lambda one: -np.nan_to_num(one.share)))


def _noise(noise: NoiseModel, ruler: Ruler) -> NoiseLevels:
    """The noise as it was estimated."""
    tau, shown = noise.structure.tau, [*zip(ruler.shown, ruler.names, strict=True)]
    q, r = np.exp(0.5 * noise.log_q), np.exp(0.5 * noise.log_r)
    return NoiseLevels(
        process={name: float(q[i]) for i, name in shown},
        measurement={name: float(r[i]) for i, name in shown},
        correlation_s=np.nan if tau is None else tau,
        outliers=not isinstance(noise.weight_v, float),
    )


def _tracked(task: Task) -> tuple[str, ...]:
    """Return the states that the reward weighs: those of the position, then others, rates last."""
    weighed = task.reward.state + task.reward.terminal
    followed = (weighed != 0) & np.isfinite(task.target).any(axis=0)
    names = [n for n, own in zip(task.model.state_names, followed, strict=True) if own]
    first = places.position(task.model)
    rates = {n for n in names if task.model.states[n].endswith("/s")}
    return tuple(sorted(names, key=lambda n: (n not in first, n in rates)))


def _in_action(h: Hypothesis, claimed: Sequence[str]) -> tuple[str, ...]:
    """Claimed effects in the order in which they act; parameters last."""
    families = [effect.family for effect in h.effects]
    order, whole = acting_order(families), wrapping_order(families)
    names = [h.names[i] for i in (*order, *(i for i in whole if i not in order))]
    return tuple(n for n in dict.fromkeys((*names, *claimed)) if n in claimed)


def unconfirmed(
    claims: Claims,
    doubtful: Sequence[Doubtful],
    groups: Sequence[Sequence[str]] = (),
) -> tuple[Unconfirmed, ...]:
    """Return the likeliest of the dropped effects that one group of trials shows, without ties."""
    tied = {name for group in groups for name in group}
    found = [
        Unconfirmed(
            one.name,
            claims.estimates(one.fit)[one.fit.hypothesis.names.index(one.name)],
            one.nats,
            tuple(claims.data.ids[k] or str(k + 1) for k in one.trials),
        )
        for one in doubtful
        if one.name not in tied and not claims.known.no_cause
    ]
    return tuple(found[:TOLD])


def quantity(e: Estimate) -> Quantity:
    """Return an estimate as a fact."""
    return Quantity(e.value, e.unit, e.std)


def remarks(d: Diagnosis, model: Model, adopted: Collection[str] = ()) -> Iterator[Finding]:
    """Yield what a person should know beside the verdict, the errors and the gap."""
    if d.no_cause:
        return
    yield from _of_groups(d, adopted)
    for group in d.indistinguishable:
        first, *others = group
        code = "gap.equivalent" if group in d.equivalent else "gap.tie"
        own = not first.startswith("parameter:")  # a fit writes these
        yield found(code, *group, effect=first, others=tuple(others), own=own)
    for seen in d.unconfirmed:
        yield found(
            "gap.unconfirmed",
            seen.effect,
            nats=seen.evidence,
            effect=seen.effect,
            values=", ".join(f"{name} = {e.text}" for name, e in seen.params.items()),
            seen=len(seen.trials),
            trials=d.trials,
        )
    if d.effects or d.verdict.parameters:
        yield from _of_errors(d)
        yield from _of_values(d, adopted)
        yield from _of_model(d, model)
    if len(d.groups) == 1 < d.trials and (d.leftover or d.unconfirmed):
        yield found("gap.one_motion")
    if not d.leftover and (state := open_noise(d.prediction_error)):
        yield found("gap.noise", state=state)
    if (curve := d.correction) is not None and curve.adoptable:
        state, gain = curve.channel, curve.held_out_gain
        yield found("gap.correction", state, over=curve.over, gain=gain, state=state)
    if odd := in_the_log(d.preflight):
        yield found("gap.corrected", *(one.signal for one in odd))


def _of_groups(d: Diagnosis, adopted: Collection[str]) -> Iterator[Finding]:
    """What changed between two groups of trials, or where trials disagree."""
    for one in d.changed or ():
        own = one.effect.startswith("parameter:")
        value = value_called(one.quantity, adopted) if own else f"{one.quantity} of {one.effect}"
        first, second = quantity(one.first), quantity(one.second)
        yield found(
            "gap.changed", one.effect, nats=one.evidence, value=value, first=first, second=second
        )
    if d.changed is not None and not d.changed:
        yield found("gap.changed", weight=Weight.NOTE)
    for test in d.agreement if d.changed is None else ():
        values = [v for v in d.per_trial if (v.effect, v.quantity) == (test.effect, test.quantity)]
        if test.agrees or len(values) < 2:
            continue
        low, high = furthest_apart(values)
        unit = test.estimate.unit
        yield found(
            "gap.disagree",
            test.effect,
            quantity=test.quantity,
            effect=test.effect,
            low=Quantity(low.value, unit, low.std),
            high=Quantity(high.value, unit, high.std),
            trial=low.trial,
            trial2=high.trial,
        )


def _of_errors(d: Diagnosis) -> Iterator[Finding]:
    """Errors that grow, and those that stay above the noise without a cause."""
    rows = d.prediction_error
    if lost := lost_most(rows):
        row, name = lost
        ends = errors(row, name, now="with_effects", before="crude")
        yield found("gap.worse", name, state=name, **_when(row), **ends)
    if (above := excess(rows)) and not d.leftover:
        times, name, row = above
        off = errors(row, name, error="with_effects")
        share = row.with_effects[name] / max((row.outset or row.crude)[name], 1e-300)
        yield found("gap.small", name, state=name, times=times, share=share, **_when(row), **off)


def _when(row: RulerRow) -> dict[str, Any]:
    """Return how far ahead the errors of a row are, as facts."""
    return {"whole": True} if row.whole_trial else {"ahead": row.horizon_s}


def _of_values(d: Diagnosis, adopted: Collection[str]) -> Iterator[Finding]:
    """What values rest on, stopped at, and may be zero."""
    rests: dict[tuple[str, ...], list[str]] = {}
    for name, on in d.conditions.items():
        rests.setdefault(on, []).append(value_called(name, adopted))
    for on, names in rests.items():
        yield found("model.given", *names, rests=on)
    if d.jointly:
        yield found("model.given", *(value_called(name, adopted) for name in sorted(d.jointly)))
    if stopped := [name for name, e in d.parameters.items() if e.stopped]:
        yield found("model.at_bound", *stopped)
    if lost := [name for name in d.parameters if name not in d.known_parameters]:
        yield found("model.not_told", *(value_called(name, adopted) for name in lost))
    of = {name: effect_of(name, adopted) for name in d.parameters}
    for effect in sorted({*of.values()} - {""}):
        name, *more = (name for name, own in of.items() if own == effect)
        e = d.parameters[name]
        if not more and abs(e.value) < SURE * e.std:
            yield found("model.unneeded", effect, effect=effect, value=quantity(e))
    for row in (row for row in d.ranking if row.claimed and row.effect.startswith("input_gain:")):
        if sign_only(row.effect, row.params):
            yield found("gap.sign", row.effect, input=row.effect.partition(":")[2])


def _of_model(d: Diagnosis, model: Model) -> Iterator[Finding]:
    """What the model's structure lets a claimed effect stand for."""
    names = {*d.effects}
    if any(name.startswith("sensor_scale:") for name in names):
        for state, rate in places.only_read(model).items():
            if f"sensor_scale:{state}" in names:
                yield found("model.sensor", state, rate=rate)
    if any(name.startswith("sensor_bias:") for name in names):
        level = [name for name in places.levelled(model) if f"sensor_bias:{name}" in names]
        yield from [found("model.sensor", *level)] * bool(level)


def next_step(d: Diagnosis, trials: Sequence[Trial], adopted: Collection[str] = ()) -> Finding:
    """Return what to do next."""
    if d.no_cause:
        return found("gap.next.record")
    if d.changed:
        return found("gap.next.changed")
    turned = [row.effect for row in d.ranking if row.claimed and sign_only(row.effect, row.params)]
    if d.separable:
        first, *others = d.separable[0]
        return found("gap.next.apart", effect=first, others=tuple(others))
    if d.unconfirmed:
        effect = d.unconfirmed[0].effect
        return found("gap.next.confirm", effect, effect=effect)
    # the state whose error has no known cause, or may be noise
    off = d.leftover[0].channel if d.leftover else open_noise(d.prediction_error)
    if off and not any(one.of != CALIBRATION for one in d.credit):
        return _look(d, off, trials)
    if not d.effects:
        return found("gap.next.none", adopted=bool(adopted))
    if (doubt := d.doubt) is not None:
        return doubt
    if turned:
        return found("gap.next.flip", input=turned[0].partition(":")[2])
    return found("gap.next.adopt", left=bool(d.leftover))


def _look(d: Diagnosis, off: str, trials: Sequence[Trial]) -> Finding:
    """Return what to run to investigate a leftover: first a repeat, then a new motion."""
    left = d.leftover[0] if d.leftover else None
    if left is not None and left.part is not None:
        part = left.part
        return found("gap.next.look", trial=part.trial, start=part.start, end=part.end)
    runs = Counter(trial.candidate or trial.inputs.tobytes() for trial in trials)
    if max(runs.values(), default=0) > 1:
        region = left.region if left is not None else None
        place = None if region is None or region.of_time else region.told
        inputs = None if place else trials[-1].input_names
        return found("gap.next.elsewhere", state=off, place=place, inputs=inputs)
    name = trials[-1].candidate or None
    return found("gap.next.repeat", state=off, candidate=name, log=name is None)
