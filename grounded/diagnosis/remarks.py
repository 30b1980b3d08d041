"""remarks: what is found beside the lines of a diagnosis; words are in the catalogue."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from typing import Any

from grounded import places
from grounded.accounts.finding import in_the_log
from grounded.diagnosis.causes import (
    effect_of,
    furthest_apart,
    sign_only,
    value_called,
)
from grounded.diagnosis.error_report import RulerRow, errors, excess, lost_most, open_noise
from grounded.diagnosis.levels import SURE
from grounded.diagnosis.parts import Diagnosis, Estimate
from grounded.diagnosis.validation.claims import Claims
from grounded.findings import Finding, Quantity, Weight, found
from grounded.model import Model
from grounded.trial import Trial


def quantity(e: Estimate) -> Quantity:
    """Return an estimate as a fact."""
    return Quantity(e.value, e.unit, e.std)


def remarks(d: Diagnosis, model: Model, adopted: Collection[str] = ()) -> Iterator[Finding]:
    """Yield what a person should know beside the verdict, the errors and the gap.

    Args:
        d: the diagnosis.
        model: the model that was diagnosed.
        adopted: adopted effects, whose values are parameters of the model.
    """
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
    if d.motions == 1 < d.trials and (d.leftover or d.unconfirmed):
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


def next_step(
    d: Diagnosis,
    claims: Claims,
    doubt: Finding | None,
    off: str,
    trials: Sequence[Trial],
    adopted: Collection[str] = (),
) -> Finding:
    """Return what to do next.

    Args:
        d: the diagnosis.
        claims: the causes that are claimed.
        doubt: why adopting them is unwise (`objection`).
        off: the state whose error has no known cause, or may be noise; "" for none.
        trials: those that were diagnosed.
        adopted: adopted effects, whose values are parameters of the model.
    """
    names = claims.names
    if d.no_cause:
        return found("gap.next.record")
    if d.changed:
        return found("gap.next.changed")
    turned = [row.effect for row in d.ranking if row.claimed and sign_only(row.effect, row.params)]
    separable = [group for group in d.indistinguishable if group not in d.equivalent]
    if separable:
        first, *others = separable[0]
        return found("gap.next.apart", effect=first, others=tuple(others))
    if d.unconfirmed:
        effect = d.unconfirmed[0].effect
        return found("gap.next.confirm", effect, effect=effect)
    look = _look(d, off, trials) if off else None
    if not names and look is not None:
        return look
    if not names and not claims.blamed:
        return found("gap.next.none", adopted=bool(adopted))
    if doubt is not None:
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
