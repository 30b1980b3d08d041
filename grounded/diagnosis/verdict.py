"""What a diagnosis says in words: the verdict, each effect in it, what to run next."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from grounded.diagnosis.claims import Claims
from grounded.diagnosis.leftover import Leftover
from grounded.diagnosis.report import (
    Estimate,
    Kind,
    Likeness,
    Ranked,
    Remainder,
    Verdict,
    number,
    quantity,
)
from grounded.effects import Effect, ParamFamily, places
from grounded.model import Model

NAMED = 2  # leftovers
MOST = 0.5  # share of the squared error: calibration that makes more is said to make most of it


def verdict(
    claims: Claims,
    before: float,
    after: float,
    ranking: tuple[Ranked, ...],
    groups: tuple[tuple[str, ...], ...],
    alike: tuple[Likeness, ...],
    remainder: tuple[Remainder, ...],
    without: float = math.nan,
) -> Verdict:
    """One effect, several, none or unknown, and why, in sentences.

    Args:
        claims: what is blamed.
        before: held-out gap without effects, in units of the noise.
        after: the same with them.
        ranking: the claimed effects first.
        groups: what ties.
        alike: what is nearly the same as a claimed effect.
        remainder: what no effect explains.
        without: the gap that the calibrated parameters leave without the effects; NaN: none were.
    """
    left = "; ".join(r.sentence() for r in remainder[:NAMED])
    left += f"; and {len(remainder) - NAMED} more" if len(remainder) > NAMED else ""
    if claims.known.no_cause:
        return Verdict("unknown", (), f"No cause is named: {claims.known.sentences[0]}.")
    claimed = [row for row in ranking if row.claimed]
    if claims.blamed:
        words = [_calibration(claims, ranking), improvement(before, after)]
        words.append("Fit them all at once.")
    elif claims.names:
        effects = {e.name: e for e in claims.best.hypothesis.effects}
        words = [sentence(meaning(effects[row.effect], row.params) for row in claimed)]
        words.append(improvement(before, after))
        if before**2 - without**2 > MOST * (before**2 - after**2) > 0:
            words.append(
                "Most of that is the calibration of the model's own parameters: without the "
                f"effect{'s' * (len(claimed) > 1)} they leave {number(without)} times the noise."
            )
    elif remainder:
        return Verdict("unknown", (), f"A gap remains that no known effect explains: {left}.")
    else:
        level = f"predictions {number(before)} times what noise alone makes"
        return Verdict("none", (), f"The model explains the data down to the noise ({level}).")
    words += [f"The data can't tell {tied(group)}." for group in groups]
    if alike:
        words.append(nearly(alike))
    if claims.names and remainder:
        words.append(f"Something is left that no known effect explains: {left}.")
    kind: Kind = "effect" if len(claimed) == 1 else "several"
    return Verdict(kind, tuple(row.effect for row in claimed), " ".join(words))


def _calibration(claims: Claims, ranking: Sequence[Ranked]) -> str:
    """The model's form is right, its numbers are not."""
    model, listed = claims.data.model, []
    for row in ranking[: len(claims.blamed)]:
        name = row.effect.partition(":")[2]
        nominal, d = model.params[name].value, row.params["d"]
        new = quantity(replace(d, value=nominal + d.value))
        part = f" ({d.value / abs(nominal):+.1%})" if nominal else ""
        listed.append(f"{name} should be {new}{part}")
    return sentence(["the model's form explains the data, its numbers don't", *listed])


def next_trial(
    claims: Claims, left: Sequence[Leftover], groups: tuple[tuple[str, ...], ...]
) -> str:
    """A sentence; `excitation.probe` makes the trial itself."""
    if claims.known.no_cause:
        return "Run two or more trials in which every input changes."
    if groups:
        made = f"A trial made for it would tell {tied(groups[0])}."
        return " ".join([made, *distinguishing(groups[0])])
    if not claims.names and left:
        return (
            f"Repeat a trial twice with the same inputs to see whether the leftover in "
            f"{left[0].channel} repeats."
        )
    if not claims.names and not claims.blamed:
        return "Nothing is tied and nothing to adopt: go on with the search."
    them = "them" if len(claims.names) > 1 else "it"
    return f"Nothing is tied: adopt {them}, or go on with the search."


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
    "input_bias": "use commands of both signs and of different size",
    "input_gain": "use small and large commands",
    "input_fade": "repeat the same manoeuvre early and late in one trial",
    "understeer": "drive the same curve slowly and fast",
    "rate_gain": "drive the same curve slowly and fast",
    "sensor_bias": "start from different headings and reverse direction",
    "patch": "cross the same places at other speeds and directions",
    "slope": "drive the same way in several headings",
}

GREEK = (
    "alpha|beta|gamma|delta|epsilon|zeta|eta|theta|iota|kappa|lambda|mu|nu|xi|omicron|pi|rho|sigma"
    "|tau|upsilon|phi|chi|psi|omega"
)


def called(model: Model, name: str) -> str:
    """A state or an input in a sentence: `the speed v`, `the state delta`, `the throttle`.

    Symbols get a word before them: what is short, Greek, or not letters alone.
    """
    roles = {
        "speed": (places.speed(model),),
        "heading": places.role(model, "heading"),
        "heading rate": places.role(model, "heading_rate"),
        "position": places.position(model),
        "angle": model.angles,
    }
    word = next((role for role, played in roles.items() if name in played), "")
    if not word and (len(name) <= 3 or re.fullmatch(GREEK, name) or not name.isalpha()):
        word = "input" if name in model.input_names else "state"
    return f"the {name}" if not word or name == word else f"the {word} {name}"


def meaning(effect: Effect, params: Mapping[str, Estimate]) -> str:
    """The family's sentence with names and numbers filled in; starts with a small letter."""
    model, targets = effect.site.model, effect.site.targets
    words: dict[str, str] = {name: quantity(e) for name, e in params.items()}
    words.setdefault("s", "s" if len(targets) == 1 else "")
    driven, _, source = effect.site.target.partition("<-")
    words["target"] = " and ".join(called(model, n) for n in targets)
    if isinstance(effect.family, ParamFamily):
        words["target"] = effect.site.target
    words |= {"driven": called(model, driven), "source": called(model, source)}

    def filled(found: re.Match[str]) -> str:
        name, percent, more, less = found.groups()
        if percent is None or name not in params:
            return words.get(name, found.group(0))
        value = 100 * params[name].value
        if more is None:
            return f"{number(value)} %"
        return f"{number(abs(value))} % {more if value >= 0 else less}"

    def kept(found: re.Match[str]) -> str:  # of a quantity that is estimated, or [left out]
        return found[1] if set(re.findall(r"\{(\w)\}", found[1])) <= set(params) else ""

    text = re.sub(r"\[([^]]*)\]", kept, effect.family.sentence)
    return re.sub(r"\{(\w+)(%)?(?:([^{}|]+)\|([^{}|]+))?\}", filled, text)


def sentence(clauses: Iterable[str]) -> str:
    """Clauses as one sentence: first word capital (never a name: `called` puts a word before)."""
    text = "; ".join(clauses)
    return f"{text[:1].upper()}{text[1:]}."


def improvement(before: float, after: float) -> str:
    """What held-out predictions gained."""
    verb = "improve" if after < before else "go"
    return f"Held-out predictions {verb} from {number(before)} to {number(after)} times the noise."


def tied(group: Sequence[str]) -> str:
    """`A from B or C`."""
    return f"{group[0]} from {' or '.join(group[1:])}"


def nearly(alike: Sequence[Likeness]) -> str:
    """Which other effects would do nearly the same."""
    parts = []
    for name in dict.fromkeys(one.effect for one in alike):
        others = [
            f"{a.like} ({100 * a.share:.0f} % of its signal)" for a in alike if a.effect == name
        ]
        parts.append(f"{name} is nearly inseparable from {', '.join(others)}")
    return f"In these trials {'; '.join(parts)}."


def distinguishing(group: Sequence[str]) -> list[str]:
    """What to do in a trial that tells a group apart, in sentences."""
    found = []
    for name in group:
        family, _, target = name.partition(":")
        hint = HINTS.get(family)
        text = f"{hint[0].upper()}{hint[1:]} ({target})." if hint else ""
        if text and text not in found:
            found.append(text)
    return found or ["Excite every input over its whole range."]
