"""The verdict of a diagnosis in words, and what to run next."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from grounded.diagnosis.cause_words import clauses, disagreement, give_or_take, meaning
from grounded.diagnosis.error_report import (
    Credit,
    Identifiable,
    Remainder,
    RulerRow,
    furthest,
    runaway,
)
from grounded.diagnosis.report import (
    Agreement,
    Kind,
    Ranked,
    TrialValue,
    Unconfirmed,
    Verdict,
)
from grounded.diagnosis.ruler_words import explained, floor, improvement, rest, worsened
from grounded.diagnosis.stopped import AT_BOUNDS, ENDED, wider
from grounded.instruments.finding import Finding, in_the_log
from grounded.model import all_at_bounds
from grounded.result import listed, percent

if TYPE_CHECKING:  # whoever reads a verdict needs none of what makes it
    from grounded.diagnosis.validation.claims import Claims

UNEXPLAINED = "A gap remains that no known effect explains: "
LOG, LOST = "is a log that no candidate made", "failed"  # why a trial can't be repeated
MOST_EFFECTS, FURTHER = 6, 2  # most effects blamed at once; how many more the next search allows
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
    per_trial: Sequence[TrialValue] = (),
    agreement: Sequence[Agreement] = (),
) -> Verdict:
    """Return the verdict (effect, several, none or unknown) with its sentences.

    Args:
        claims: the causes that are claimed.
        ranking: all effects that were compared, the claimed ones first.
        groups: effects that the data cannot tell apart.
        remainder: errors that no effect explains.
        rows: held-out prediction errors, a row per horizon.
        credit: the share of the improvement due to each cause, largest first.
        seen: effects that only one trial shows.
        same: those of `groups` that are equivalent in this model.
        most: the largest number of effects that was looked for; 0 for no limit.
        one_motion: whether all trials repeat one motion.
        identified: how well the trials identify each parameter, and relative to which others.
        per_trial: each claimed value by trial.
        agreement: whether the trials agree on each of these values.
    """
    from grounded.effects import like_a_load

    rare = [one for one in seen if not one.repeats] + [one for one in seen if one.repeats][:1]
    once = [sentence([one.sentence()]) for one in rare]
    left = remainder[0].sentence() if remainder else ""
    others = len(remainder) - 1
    left += f"; {others} more state{'s' * (others > 1)}" if others > 0 else ""
    claimed = [row for row in ranking if row.claimed]
    row = furthest(rows)
    if claims.known.no_cause:
        why = claims.known.sentences[0]
        return replace(_said("unknown", f"No cause is named: {why}."), limit=why)
    if not claimed:
        if remainder:
            return _said("unknown", f"{UNEXPLAINED}{left}.", *once)
        if above := rest(rows):
            text = f"The model explains what these trials show: {above}."
        elif row is not None and row.floor_at_most:
            what = "No known effect explains the rest, which may be noise that is not white"
            return _said("unknown", f"{what}{floor(row)}.", *once)
        else:
            text = explained(rows)
        return _said("none", text, *once)
    apart = _apart(per_trial, agreement)
    causes = _causes(claims, ranking, credit, identified, apart)
    told = clauses(
        [one.of for one in credit],
        causes,
        [one.share for one in credit],
        {e.name: e for e in claims.best.hypothesis.effects},
        {row.effect: row.params for row in ranking},
    )
    words = [sentence(told), improvement(rows), worsened(rows)]
    words += [runaway(rows), wider(claims.parameters())]
    words += [LOAD] * like_a_load(claims.data.model, [row.effect for row in claimed])
    words += [f"{told_apart(group, same)}." for group in groups]
    words += [one.sentence() for one in claims.one_clock[:1]]
    more = 0
    if remainder and len(claims.names) == most:
        words.append(f"A gap remains: {left}; no more than {most} effects were looked for.")
        more = min(most + FURTHER, MOST_EFFECTS) * any(one.above for one in remainder)
    elif remainder:
        words.append(f"{UNEXPLAINED}{left}.")
    elif above := rest(rows):
        words.append(sentence([above]))
    if one_motion and (remainder or seen):
        words.append(ONE_MOTION)
    words += once
    kind: Kind = "effect" if len(claimed) == 1 else "several"
    effects, off = tuple(r.effect for r in claimed), tuple(_off(claims))
    said = replace(
        _said(kind, *words), effects=effects, causes=causes, clauses=told, parameters=off
    )
    return replace(said, look_for=more if more > most else 0)


def with_faults(said: Verdict, findings: Iterable[Finding]) -> Verdict:
    """Add the faults of the log that this diagnosis corrected, but the stored trials still have."""
    odd = in_the_log(findings)
    if not odd:
        return said
    told = "; ".join(f"{one.signal} {one.finding}" for one in odd)
    sentences = (*said.lines, f"Corrected here, but not in the stored trials: {told}.")
    return replace(said, sentences=sentences, sentence=" ".join(sentences))


LOAD = (
    "Several joints with a wrong gain suggest a load or a wrong link mass: give the model a "
    "parameter for it before you adopt them."
)
ONE_MOTION = "All trials repeat one motion, so these values may not hold for another one."


def _said(kind: Kind, *words: str) -> Verdict:
    said = tuple(text for text in words if text)
    return Verdict(kind, sentence=" ".join(said), sentences=said)


def _causes(
    claims: Claims,
    ranking: Sequence[Ranked],
    credit: Sequence[Credit],
    identified: Sequence[Identifiable],
    apart: Mapping[str, str],
) -> tuple[str, ...]:
    """Return one clause per cause, the largest first."""
    from grounded.diagnosis.validation.claims import has_size
    from grounded.diagnosis.validation.motions import KNOWN

    effects = {e.name: e for e in claims.best.hypothesis.effects}
    given = {one.parameter: tuple(one.given) for one in identified}
    lost = {one.parameter for one in identified if one.lost}
    joint = {one.parameter for one in identified if one.jointly}
    values = {row.effect: row.params for row in ranking}
    found = []
    for one in credit:
        if one.of in effects:
            text = meaning(effects[one.of], values[one.of])
            text += UNSURE * (not has_size(effects[one.of], values[one.of], KNOWN))
            text += f", {apart[one.of]}" if one.of in apart else ""
        else:
            text = f"the model's own parameters are off: {_moved(claims)}"
            text += _others(claims, identified)
            held = dict.fromkeys(other for n in _off(claims)[:NAMED] for other in given.get(n, ()))
            text += f", given {listed(held)} as in the model" * bool(held)
            vague = [n for n in _off(claims)[:NAMED] if n in lost]
            text += f", but these trials do not determine {listed(vague)}" * bool(vague)
            joined = [n for n in _off(claims)[:NAMED] if n in joint]
            are = "is" if len(joined) == 1 else "are"
            text += f" ({listed(joined)} {are} known only with the others)" * bool(joined)
        found.append(text)
    return tuple(found)


def _apart(per_trial: Sequence[TrialValue], agreement: Sequence[Agreement]) -> dict[str, str]:
    """Return a clause for each effect on a value of which the trials disagree."""
    found: dict[str, str] = {}
    for one in agreement:
        own = (one.effect, one.quantity)
        values = [v for v in per_trial if (v.effect, v.quantity) == own]
        if not one.agrees and len(values) > 1:
            found.setdefault(one.effect, disagreement(values, one.estimate.unit))
    return found


def _off(claims: Claims) -> list[str]:
    """Return the parameters that are off, the most important first."""
    return [claims.data.model.param_names[one.index] for one in claims.moved]


def at_bounds(claims: Claims) -> bool:
    """Check whether parameters are off and all of them stopped at a bound."""
    known = claims.parameters()
    return all_at_bounds(claims.data.model.params, {n: known[n].value for n in _off(claims)})


def _moved(claims: Claims) -> str:
    """Return `L should be 0.1662 +- 0.0011 m (+11 %)` for the parameters that are off."""
    params, known = claims.data.model.params, claims.parameters()
    named, texts = _off(claims), []
    for name in named[:NAMED]:
        old = params[name].value
        change = 100 * (known[name].value - old) / abs(old) if old else 0.0
        beside = [f"{change:+.{0 if abs(change) >= 1 else 1}f} %"] * bool(old)
        beside += ENDED[known[name].stopped]
        part = f" ({', '.join(beside)})" * bool(beside)
        texts.append(f"{name} should be {give_or_take(known[name])}{part}")
    more = len(named) - NAMED
    return ", ".join(texts) + (f" and {more} more" if more > 0 else "")


UNSURE = ", but its size is uncertain: within 2 standard deviations of zero"


def _others(claims: Claims, identified: Sequence[Identifiable]) -> str:
    """Return a clause on the parameters that are adopted too, though they need not be off.

    They were calibrated together with those that are off, whose values are only valid with them.
    """
    params, known, off = claims.data.model.params, claims.parameters(), _off(claims)
    lost = {one.parameter for one in identified if one.lost}
    old = {name: params[name].value for name in known if name not in (*off, *lost)}
    if not old:
        return ""
    one = len(old) == 1
    by = ""
    if all(old.values()):
        most = max(abs(known[name].value / value - 1) for name, value in old.items())
        by = f" by {'' if one else 'at most '}{percent(most)}"
    others = f"{len(old)} others" if len(old) > NAMED else listed(old)
    return f"; {others}, changed with {'it' if len(off) == 1 else 'them'}{by}, may be right"


def next_trial(
    claims: Claims,
    look: str,
    groups: tuple[tuple[str, ...], ...],
    seen: Sequence[Unconfirmed] = (),
    same: tuple[tuple[str, ...], ...] = (),
    unrepeatable: Mapping[str, str] | None = None,
    worse: str = "",
    adopted: Collection[str] = (),
    further: bool = False,
    ended: bool = False,
) -> str:
    """Return a sentence on the next trial; `excitation.probe` designs the trial itself.

    Args:
        claims: the causes that are claimed.
        look: what to run because of a gap without a cause; "" if there is none.
        groups: effects that the data cannot tell apart.
        seen: effects that only one trial shows.
        same: those of `groups` that are equivalent in this model.
        unrepeatable: trials that cannot or should not be repeated, with the reason.
        worse: why adopting the claimed effects is unwise (`ruler_words.objection`), or "".
        adopted: adopted effects, whose values are parameters of the model.
        further: whether more effects should be looked for first (`Verdict.look_for`).
        ended: whether all parameters that moved stopped at their bounds (`at_bounds`).
    """
    from grounded.effects import like_a_load, places

    if claims.known.no_cause:
        return "Run two or more trials in which every input changes."
    if groups and groups[0] in same:
        return f"None helps: {told_apart(groups[0], same)}, so adopt either."
    if groups:
        made = f"A trial designed for it may tell {tied(groups[0])}."
        turns = bool(places.plane(claims.data.model))
        return " ".join([made, *distinguishing(groups[0], turns=turns)])
    if seen:
        one = seen[0]
        if one.repeats:
            return f"Run a different motion: all trials that show {one.effect} move alike."
        why = (unrepeatable or {}).get(one.trial)
        if why is None:
            return f"Repeat trial {one.trial}: few others show {one.effect}."
        there = "" if one.region is None else f" that goes where {one.region.told}"
        better = f"run a gentler one{there}" if why == LOST else f"record another one{there}"
        return f"Trial {one.trial} shows {one.effect} best, but it {why}: {better}."
    if not claims.names and look:
        return look
    if not claims.names and not claims.blamed:
        return "None is needed: nothing is tied and nothing needs adopting."
    if worse:
        return f"Adopt nothing yet: {worse}. Run another trial and diagnose again."
    if further:
        return "None is needed yet: look for more effects first."
    if len(claims.names) > 1 and like_a_load(claims.data.model, claims.names):
        return "None is needed yet: give the model a parameter for a load and diagnose again."
    if ended:
        return AT_BOUNDS
    if _own_numbers(claims, adopted):
        return "None is needed to tell causes apart: fit the model's parameters."
    return "None is needed to tell causes apart: adopt the claimed effects."


def _own_numbers(claims: Claims, adopted: Collection[str]) -> bool:
    """Check whether only parameters of the original model are blamed, none of adopted effects."""
    from grounded.effects import ParamFamily, param_name

    effects, theirs = claims.best.hypothesis.effects, tuple(param_name(n, "") for n in adopted)
    names = [e.site.target if isinstance(e.family, ParamFamily) else "" for e in effects]
    off = names if claims.names else _off(claims)
    return all(off) and not any(theirs and name.startswith(theirs) for name in off)


HINTS = {
    "dead_zone": "sweep it slowly through zero and hold small commands",
    "stall": "sweep it slowly through zero and hold small commands",
    "stiction": "start and stop often, from small commands",
    "coulomb_friction": "coast down from different speeds",
    "viscous_friction": "hold several speeds, slow and fast",
    "quadratic_drag": "hold several speeds, slow and fast",
    "delay": "step the input sharply, by different amounts",
    "first_order_lag": "step the input sharply, by different amounts",
    "rate_limit": "step the input by small and large amounts",
    "slew_limit": "step the input by small and large amounts",
    "input_bias": "use small and large commands, of both signs where it takes them",
    "input_gain": "use small and large commands",
    "input_fade": "repeat the same manoeuvre early and late in one trial",
    "understeer": "drive the same curve slowly and fast",
    "rate_gain": "drive the same curve slowly and fast",
    "sensor_bias": "start from different headings and reverse direction",
    "patch": "cross the same places at other speeds and directions",
    "slope": "drive the same way in several headings",
}

STRAIGHT = {  # where nothing has a heading or drives a curve
    "sensor_bias": "hold still before and after the run, and move both ways",
    "rate_gain": "make the same motion slowly and fast",
}


def sentence(clauses: Iterable[str]) -> str:
    """Join clauses to a sentence (`called` keeps names from being its first word)."""
    text = "; ".join(clauses)
    return f"{text[:1].upper()}{text[1:]}."


def told_apart(group: Sequence[str], same: Sequence[Sequence[str]]) -> str:
    """Return a clause: these data cannot tell the group apart, or no data can."""
    if group in same:
        return f"{listed(group)} are equivalent in this model"
    return f"The data can't tell {tied(group)}"


def tied(group: Sequence[str]) -> str:
    """Return `A from B or C`."""
    return f"{group[0]} from {' or '.join(group[1:])}"


def distinguishing(group: Sequence[str], *, turns: bool = True) -> list[str]:
    """Return sentences on how to excite the robot so that a trial tells a group apart.

    Args:
        group: names of effects.
        turns: whether the model has a heading.
    """
    found = []
    for name in group:
        family, _, target = name.partition(":")
        hint = STRAIGHT.get(family) if not turns else None
        hint = hint or HINTS.get(family)
        text = f"{hint[0].upper()}{hint[1:]} ({target})." if hint else ""
        if text and text not in found:
            found.append(text)
    return found or ["Excite every input over its whole range."]
