"""The verdict of a diagnosis in words."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from grounded.accounts.finding import Finding, in_the_log
from grounded.diagnosis.cause_words import (
    GIVEN,
    OWN,
    at_middle,
    clauses,
    comparison,
    counted,
    disagreement,
    effect_of,
    ended,
    give_or_take,
    meaning,
    other_unit,
    value_called,
    wider,
)
from grounded.diagnosis.error_report import (
    AT_MOST,
    Combination,
    Credit,
    Identifiable,
    Remainder,
    RulerRow,
    furthest,
    runaway,
)
from grounded.diagnosis.likelihood.levels import SURE
from grounded.diagnosis.parts import (
    Agreement,
    Changed,
    Estimate,
    Kind,
    Likeness,
    Ranked,
    TrialValue,
    Unconfirmed,
    Verdict,
)
from grounded.diagnosis.ruler_words import (
    explained,
    floor,
    improvement,
    rest,
    unexplained_noise,
    worsened,
)
from grounded.errors import GroundedError
from grounded.model import Model
from grounded.result import begun, listed, number, percent, with_unit

if TYPE_CHECKING:  # whoever reads a verdict needs none of what makes it
    from grounded.diagnosis.validation.claims import Claims

UNEXPLAINED = "A gap remains that no known effect explains: "
BOTH = "A gap remains if both groups get the same values: "  # groups of trials that differ
MOST_EFFECTS, FURTHER = 12, 2  # most effects blamed at once; how many more the next search allows
NEARLY = 0.95  # share of a claimed effect's signal from which another makes nearly the same
NAMED = 3  # parameters, channels or leftovers named in one sentence


def verdict(
    claims: Claims,
    ranking: tuple[Ranked, ...],
    groups: tuple[tuple[str, ...], ...],
    remainder: tuple[Remainder, ...],
    rows: tuple[RulerRow, ...],
    credit: tuple[Credit, ...],
    seen: Sequence[Unconfirmed] = (),
    same: tuple[tuple[str, ...], ...] = (),
    most: int = 0,
    one_motion: bool = False,
    identified: Sequence[Identifiable] = (),
    combinations: Sequence[Combination] = (),
    per_trial: Sequence[TrialValue] = (),
    agreement: Sequence[Agreement] = (),
    changed: Sequence[Changed] | None = None,
    adopted: Collection[str] = (),
    tracked: Sequence[str] = (),
    alike: Sequence[Likeness] = (),
) -> Verdict:
    """Return the verdict (effect, several, none or unknown) with its sentences.

    Args:
        claims: the causes that are claimed.
        ranking: all effects that were compared, the claimed ones first.
        groups: effects that the data cannot tell apart.
        remainder: errors that no effect explains.
        rows: held-out prediction errors, a row per horizon.
        credit: what each cause is worth, largest first.
        seen: effects that only one trial shows.
        same: those of `groups` that are equivalent in this model.
        most: the largest number of effects that was looked for; 0 for no limit.
        one_motion: whether all trials repeat one motion.
        identified: how well the trials identify each parameter, and relative to which others.
        combinations: values that the trials show only in combination.
        per_trial: each claimed value by trial.
        agreement: whether the trials agree on each of these values.
        changed: the values that differ between two groups of trials; None for one group.
        adopted: adopted effects, whose values are parameters of the model.
        tracked: the states that the task follows, the most important first.
        alike: effects that make nearly the signal of a claimed one.
    """
    from grounded.effects import like_a_load

    once = [sentence([one.sentence()]) for one in told_of(seen)]
    left = remainder[0].sentence() if remainder else ""
    others = len(remainder) - 1
    left += also_off(others)
    unexplained = f"{BOTH if changed else UNEXPLAINED}{left}."
    first = "" if changed is None else comparison(changed, adopted)
    claimed = [row for row in ranking if row.claimed]
    row = furthest(rows)
    if claims.known.no_cause:
        why = claims.known.sentences[0]
        return replace(_said("unknown", f"No cause is named: {why}."), limit=why)
    if not claimed:
        if remainder:
            return _said("unknown", unexplained, *once, first=first)
        if above := rest(rows):
            text = f"The model explains what these trials show: {above}."
        elif row is not None and (row.floor_at_most or row.floor_from == AT_MOST):
            found = "No known effect explains what this model leaves"
            if adopted:  # in one that was just mended, that would read as an alarm
                found = "Nothing more is found beside what was adopted"
            what = f"{found}{floor(row)}.{unexplained_noise(row)}"
            return _said("none" if adopted else "unknown", what, *once, first=first)
        else:
            text = explained(rows)
        return _said("none", text, *once, first=first)
    apart = _apart(per_trial, agreement)
    open_gap = any(one.above for one in remainder)
    ties = {name for group in groups if open_gap and group not in same for name in group}
    causes = _causes(
        claims, ranking, credit, identified, apart, open_gap, adopted, combinations, ties
    )
    told = clauses(
        [one.of for one in credit],
        causes,
        credit,
        {e.name: e for e in claims.best.hypothesis.effects},
        {row.effect: row.params for row in ranking},
    )
    words = [sentence(told), improvement(rows, tracked), worsened(rows)]
    words += [runaway(rows), wider(claims.parameters()), *_unneeded(claims.parameters(), adopted)]
    words += [LOAD] * like_a_load(claims.data.model, [row.effect for row in claimed])
    words += [_combined(claims.data.model, one) for one in combinations]
    words += [f"{told_apart(group, same, [r.effect for r in claimed])}." for group in groups]
    words += _late_or_filtered(alike, [row.effect for row in claimed])
    words += [one.sentence() for one in claims.one_clock[:1]]
    words += _geared(claims.data.model, [row.effect for row in claimed])[:1]
    words += _level(claims.data.model, [row.effect for row in claimed])
    more = 0
    if remainder and len(claims.names) == most:
        more = min(most + FURTHER, MOST_EFFECTS) * any(one.above for one in remainder)
        if 0 < more <= most:
            words.append(
                f"{most} effects are named, the most in one diagnosis, and more is left:"
                f" {left}; adopt these effects and diagnose again."
            )
        else:
            looked = "effects were" if most > 1 else "effect was"
            words.append(f"A gap remains: {left}; no more than {most} {looked} looked for.")
    elif remainder:
        words.append(unexplained)
        words += [STAND_IN] * any(one.wide for one in remainder)
    elif above := rest(rows):
        words.append(sentence([above]))
    if one_motion and (remainder or seen):
        words.append(ONE_MOTION)
    words += once
    kind: Kind = "effect" if len(claimed) == 1 else "several"
    effects, off = tuple(r.effect for r in claimed), tuple(parameters_off(claims))
    said = replace(
        _said(kind, *words, first=first),
        effects=effects,
        causes=causes,
        clauses=told,
        parameters=off,
    )
    return replace(said, look_for=more if more > most else 0, again=0 < more <= most)


def told_of(seen: Sequence[Unconfirmed]) -> list[Unconfirmed]:
    """Return the unconfirmed effects that are told: one at most of those that repeat a motion."""
    return [one for one in seen if not one.repeats] + [one for one in seen if one.repeats][:1]


def interrupted(said: Verdict) -> Verdict:
    """Return the verdict of a diagnosis that was interrupted as it looked for one more effect."""
    more = "Interrupted while it looked for one more effect: diagnose again after adopting these."
    if not said.effects:
        more = "Interrupted while it looked for one more effect."
    sentences = (*said.lines, more)
    return replace(said, sentences=sentences, sentence=" ".join(sentences), again=True)


def also_off(others: int) -> str:
    """Return a clause on states that are off beside the first; "" if there are none."""
    if others < 1:
        return ""
    return f", and {others} more state{'s are' if others > 1 else ' is'} off"


def with_faults(said: Verdict, findings: Iterable[Finding]) -> Verdict:
    """Add what was left out, and the faults that the stored trials still have."""
    findings = list(findings)
    more = [f"{one.signal} {one.finding}." for one in findings if one.kind == "unresolved"]
    long = [one for one in findings if one.kind == "time step"]
    more += [f"In each step {one.signal} {one.finding}; {one.advice}." for one in long]
    if odd := in_the_log(findings):
        told = "; ".join(f"{one.signal} {one.finding}" for one in odd)
        more.append(f"Corrected here, but not in the stored trials: {told}.")
    if not more:
        return said
    sentences = (*said.lines, *more)
    return replace(said, sentences=sentences, sentence=" ".join(sentences))


LOAD = (
    "Several joints with a wrong gain suggest a load or a wrong link mass: give the model a "
    "parameter for it before you adopt them."
)
ONE_MOTION = "All trials repeat one motion, so these values may not hold for another one."


def _said(kind: Kind, *words: str, first: str = "") -> Verdict:
    said = tuple(text for text in (first, *words) if text)
    return Verdict(kind, sentence=" ".join(said), sentences=said, comparison=first)


def _causes(
    claims: Claims,
    ranking: Sequence[Ranked],
    credit: Sequence[Credit],
    identified: Sequence[Identifiable],
    apart: Mapping[str, str],
    open_gap: bool = False,
    adopted: Collection[str] = (),
    combinations: Sequence[Combination] = (),
    ties: Collection[str] = (),
) -> tuple[str, ...]:
    """Return one clause per cause, the largest first.

    Beside a gap that remains (`open_gap`), nothing is said as if sure of those with `ties`.
    """
    from grounded.diagnosis.validation.claims import has_size

    acting = claims.best.hypothesis.effects
    effects = {e.name: e for e in acting}
    given = {one.parameter: tuple(one.given) for one in identified}
    rests = {n: one.rests_on for one in combinations for n in one.values}
    lost = {one.parameter for one in identified if one.lost}
    joint = {one.parameter for one in identified if one.jointly}
    values = {row.effect: row.params for row in ranking}
    found = []
    for one in credit:
        if one.of in effects:
            text = meaning(effects[one.of], values[one.of])
            text += at_middle(effects[one.of], acting, values)
            text += other_unit(one.of, values[one.of])
            text += counted(effects[one.of], acting)
            if one.of in ties:
                text += OPEN_TIE
            else:
                text += OPEN * (open_gap and one.of.startswith("parameter:"))
            text += GIVEN.format(listed(rests.get(one.of, ()))) * (one.of in rests)
            text += UNSURE * (not has_size(effects[one.of], values[one.of], SURE))
            text += f", {apart[one.of]}" if one.of in apart else ""
        else:
            named = parameters_off(claims)[:NAMED]
            held = dict.fromkeys(other for n in named for other in given.get(n, ()))
            text = f"{_moved(claims, adopted)}{GIVEN.format(listed(held)) * bool(held)}"
            text += OPEN * open_gap + _others(claims, identified, adopted)
            vague = [n for n in named if n in lost]
            text += f"; these trials do not determine {listed(vague)}" * bool(vague)
            joined = [n for n in named if n in joint]
            are = "is" if len(joined) == 1 else "are"
            text += f" ({listed(joined)} {are} known only with the others)" * bool(joined)
        found.append(text)
    return tuple(found)


def _geared(model: Model, claimed: Sequence[str]) -> list[str]:
    """Return a sentence for each claimed scale of a sensor that a gear or linkage equals."""
    from grounded import places

    pairs = places.only_read(model) if any(n.startswith("sensor_scale:") for n in claimed) else {}
    return [
        f"A gear or linkage between {rate} and {name} that differs from the model would look the "
        f"same in any log: measure how far {name} really moves."
        for name, rate in pairs.items()
        if f"sensor_scale:{name}" in claimed
    ]


def _unneeded(known: Mapping[str, Estimate], adopted: Collection[str]) -> list[str]:
    """Return a sentence for each adopted effect whose one calibrated value may be zero.

    What an earlier diagnosis took for a drift of the speed was a thruster's weaker way astern.
    """
    from grounded.effects import param_name

    of = {name: effect_of(name, adopted) for name in known}
    owned = {one: [name for name, own in of.items() if own == one] for one in {*of.values()} - {""}}
    return [
        f"The adopted {effect} may be none beside these "
        f"({name.removeprefix(param_name(effect, ''))} = {give_or_take(known[name])}): remove it "
        "from [model] effects, then diagnose again to see whether it is missed."
        for effect, (name, *more) in sorted(owned.items())
        if not more and abs(known[name].value) < SURE * known[name].std
    ]


def _late_or_filtered(alike: Sequence[Likeness], claimed: Sequence[str]) -> list[str]:
    """Return a sentence on sensors that are called late and may as well be filtered, or reversed.

    A sensor that was 0.12 s late, with steps of 0.1 s, was told as a filter of 0.124 s, as if sure.
    """
    pairs = {(one.effect, one.like) for one in alike if one.share > NEARLY}
    found = []
    for name in claimed:
        family, _, state = name.partition(":")
        other = {"sensor_delay": "sensor_lag", "sensor_lag": "sensor_delay"}.get(family)
        if other and (name, f"{other}:{state}") in pairs:
            found.append(state)
    if not found:
        return []
    whose = f"those of {listed(found)} are" if len(found) > 1 else f"that of {found[0]} is"
    return [
        "A sensor's delay and a filter in it make nearly the same log: which of the two "
        f"{whose}, these trials hardly tell."
    ]


def _level(model: Model, claimed: Sequence[str]) -> list[str]:
    """Return a sentence on claimed biases of sensors that another level equals."""
    from grounded import places

    biased = [n for n in claimed if n.startswith("sensor_bias:")]
    names = [n for n in places.levelled(model) if f"sensor_bias:{n}" in biased] if biased else []
    if not names:
        return []
    return [
        f"A table or mount out of level, or a spring that rests elsewhere than at 0 of "
        f"{listed(names)}, looks the same in any log as a sensor's wrong zero, and is adopted in "
        "the same way: check the level before you correct the sensor."
    ]


def _combined(model: Model, one: Combination) -> str:
    """Return a sentence on values that the trials show only in combination."""
    told = listed(
        with_unit(f"{name} = {number(model.params[name].value)} +- {number(std)}", unit)
        for name, std in one.rests_on.items()
        for unit in [model.params[name].unit]
    )
    return (
        f"These trials show {listed([*one.values, *one.rests_on])} only in combination, such as "
        f"ratios: the values hold for {told}, as declared. To know each of them, measure one, or "
        f"correct {listed(one.rests_on)} in the model, and diagnose again."
    )


def _apart(per_trial: Sequence[TrialValue], agreement: Sequence[Agreement]) -> dict[str, str]:
    """Return a clause for each effect on a value of which the trials disagree."""
    found: dict[str, str] = {}
    for one in agreement:
        own = (one.effect, one.quantity)
        values = [v for v in per_trial if (v.effect, v.quantity) == own]
        if not one.agrees and len(values) > 1:
            found.setdefault(one.effect, disagreement(values, one.estimate.unit))
    return found


def parameters_off(claims: Claims) -> list[str]:
    """Return the parameters that are off, the most important first."""
    return [claims.data.model.param_names[one.index] for one in claims.moved]


def _moved(claims: Claims, adopted: Collection[str]) -> str:
    """Return which parameters are off: the model's own, and those of adopted effects.

    Own ones as `L should be 0.1662 +- 0.0011 m (+11 %)`; those of an effect by its own sentence.
    """
    from grounded.effects import param_name

    params, known = claims.data.model.params, claims.parameters()
    named, texts, again = parameters_off(claims), list[str](), dict[str, dict[str, str]]()
    beside_rivals = claims.with_rivals()
    for name in named[:NAMED]:
        old = params[name].value
        change = 100 * (known[name].value / old - 1) if old else 0.0
        beside = [f"{change:+.{0 if abs(change) >= 1 else 1}f} %"] * bool(old)
        beside += ended(known[name], old)
        if name in beside_rivals:
            claimed, rival, value = beside_rivals[name]
            then = with_unit(number(value), params[name].unit)
            beside.append(f"or {then} if {rival} is the cause instead of {claimed}")
        part = f" ({', '.join(beside)})" * bool(beside)
        if effect := effect_of(name, adopted):
            key = name.removeprefix(param_name(effect, ""))
            text = f"{key} = {give_or_take(known[name])} instead of {number(old)}{part}"
            again.setdefault(effect, {})[key] = text
        else:
            texts.append(f"{name} should be {give_or_take(known[name])}{part}")
    own = f"{OWN} are off: {', '.join(texts)}" if texts or not again else ""
    off = ", ".join(_adopted_off(claims, name, told) for name, told in again.items())
    off = f"the adopted effects have other values: {off}" if off else ""
    parts = (off, own) if named and effect_of(named[0], adopted) else (own, off)
    more = len(named) - NAMED
    return "; ".join(filter(None, parts)) + (f" and {more} more" if more > 0 else "")


def _adopted_off(claims: Claims, name: str, told: Mapping[str, str]) -> str:
    """Return an adopted effect in the words of its family, with the quantities that are off.

    An effect that can't be built on a model that has it already, or comes from another package, is
    named only.
    """
    from grounded.effects import Library, param_name

    model, values = claims.data.model, ", ".join(told.values())
    try:
        effect = Library().effect(name, model)
    except GroundedError:
        return f"{name} has {values}"
    known, now = claims.parameters(), dict[str, Estimate]()
    for q in effect.free:
        own = param_name(name, q.name)
        if own in known:
            now[q.name] = known[own]
        elif own in model.params:
            now[q.name] = Estimate(model.params[own].value, 0.0, None, q.unit)
    return f"{meaning(effect, now)} ({name}: {values})"


STAND_IN = "While that gap remains, what is named above may stand in for what is missing."
OPEN = ", unless the gap that remains is the reason"  # a value that a parameter should have
OPEN_TIE = ", unless the gap that remains or what ties with it is the reason"
UNSURE = ", but its size is uncertain: within 2 standard deviations of zero"


def _others(claims: Claims, identified: Sequence[Identifiable], adopted: Collection[str]) -> str:
    """Return a clause on the parameters that are adopted too, though they need not be off.

    They were calibrated together with those that are off, whose values are only valid with them.
    Of one that is off with an effect that ties with a claimed one, the clause says so. One whose
    value in the model the trials exclude may be off, though predictions don't need that.
    """
    params, known, off = claims.data.model.params, claims.parameters(), parameters_off(claims)
    lost = {one.parameter for one in identified if one.lost}
    old = {name: params[name].value for name in known if name not in (*off, *lost)}
    if not old:
        return ""
    it = "it" if len(off) == 1 else "them"
    by = {name: known[name].value / value - 1 for name, value in old.items() if value}
    ties, off_with = dict[str, list[str]](), claims.off_with_rivals()
    for name in old:
        if name in off_with:
            ties.setdefault(off_with[name], []).append(value_called(name, adopted))
    ends = [(value, known[name].interval) for name, value in old.items()]
    sure = any(both and not both[0] <= value <= both[1] for value, both in ends)
    doubt = "which predictions hardly need" if sure else "but need not be wrong"
    wrong = doubt + "".join(
        f"; if {tie} is the cause instead, {listed(some)} {'is' if len(some) == 1 else 'are'} off"
        for tie, some in ties.items()
    )
    if len(old) > NAMED:
        most = sorted(by, key=lambda name: -abs(by[name]))[:NAMED]
        told = [
            f"{value_called(n, adopted)} ({'-' if by[n] < 0 else '+'}{percent(abs(by[n]))})"
            for n in most
        ]
        named = f", most of all {listed(told)}" * bool(told)
        return f"; {len(old)} others are adjusted with {it}{named}, {wrong}"
    one = len(old) == 1
    much = ""
    if len(by) == len(old):
        size = percent(max(map(abs, by.values())))
        much = f" by {'' if one or size.startswith('<') else 'at most '}{size}"
    are = "is" if one else "are"
    names = listed(value_called(name, adopted) for name in old)
    return f"; {names} {are} adjusted with {it}{much}, {wrong}"


def sentence(clauses: Iterable[str]) -> str:
    """Join clauses to a sentence (`called` keeps names from being its first word)."""
    text = "; ".join(clauses)
    return f"{begun(text)}."


def told_apart(
    group: Sequence[str], same: Sequence[Sequence[str]], claimed: Collection[str] = ()
) -> str:
    """Return a clause: these data cannot tell the group apart, or no data can.

    Args:
        group: effects that tie.
        same: the groups that are equivalent in this model.
        claimed: the claimed effects. Of one in the group the clause says that adopting writes it,
            or which it is if it is a parameter, which mostly a fit writes.
    """
    own = next((name for name in group if name in claimed), "")
    writes = f"; adopting writes {own}, the claimed one" * bool(own)
    writes = f"; {own} is claimed" if own.startswith("parameter:") else writes
    if group in same:
        return f"{listed(group)} are equivalent in this model{writes}"
    either = "either" if len(group) == 2 else "each"
    return f"The data can't tell {tied(group)}: {either} explains these trials{writes}"


def tied(group: Sequence[str]) -> str:
    """Return `A from B`, `A, B and C apart`."""
    return " from ".join(group) if len(group) == 2 else f"{listed(group)} apart"
