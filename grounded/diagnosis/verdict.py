"""The verdict: its kind, its sentence, and what to run next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from grounded.diagnosis.claims import Claims
from grounded.diagnosis.leftover import Leftover
from grounded.diagnosis.lookalike import Likeness
from grounded.diagnosis.report import (
    Kind,
    Ranked,
    Remainder,
    number,
    quantity,
)
from grounded.diagnosis.words import distinguishing, improvement, meaning, nearly, sentence, tied

NAMED = 2  # leftovers


def verdict(
    claims: Claims,
    before: float,
    after: float,
    ranking: tuple[Ranked, ...],
    groups: tuple[tuple[str, ...], ...],
    alike: tuple[Likeness, ...],
    remainder: tuple[Remainder, ...],
) -> tuple[Kind, str]:
    """One effect, several, none or unknown, and why, in sentences.

    Args:
        claims: what is blamed.
        before: held-out gap without effects, in units of the noise.
        after: the same with them.
        ranking: the claimed effects first.
        groups: what ties.
        alike: what is nearly the same as a claimed effect.
        remainder: what no effect explains.
    """
    left = "; ".join(r.sentence() for r in remainder[:NAMED])
    left += f"; and {len(remainder) - NAMED} more" if len(remainder) > NAMED else ""
    if claims.known.no_cause:
        return "unknown", f"No cause is named: {claims.known.sentences[0]}."
    if claims.blamed:
        return _calibration(claims, before, after, ranking, groups, alike)
    if not claims.names and not remainder:
        return "none", (
            f"The model explains the data down to the noise (predictions "
            f"{number(before)} times what noise alone makes)."
        )
    if not claims.names:
        return "unknown", f"A gap remains that no known effect explains: {left}."
    effects = {e.name: e for e in claims.best.hypothesis.effects}
    claimed = [row for row in ranking if row.claimed]
    words = [sentence(meaning(effects[row.effect], row.params) for row in claimed)]
    words.append(improvement(before, after))
    words += [f"The data can't tell {tied(group)}." for group in groups]
    if alike:
        words.append(nearly(alike))
    if remainder:
        words.append(f"Something is left that no known effect explains: {left}.")
    return ("effect" if len(claims.names) == 1 else "several"), " ".join(words)


def _calibration(
    claims: Claims,
    before: float,
    after: float,
    ranking: Sequence[Ranked],
    groups: tuple[tuple[str, ...], ...],
    alike: tuple[Likeness, ...],
) -> tuple[Kind, str]:
    """The model's form is right, its numbers are not."""
    model, listed = claims.data.model, []
    for row in ranking[: len(claims.blamed)]:
        name = row.effect.partition(":")[2]
        nominal, d = model.params[name].value, row.params["d"]
        new = quantity(replace(d, value=nominal + d.value))
        part = f" ({d.value / abs(nominal):+.1%})" if nominal else ""
        listed.append(f"{name} should be {new}{part}")
    text = sentence(["the model's form explains the data, its numbers don't", *listed])
    words = [text, improvement(before, after), "`grounded fit` fits them all."]
    words += [f"The data can't tell {tied(group)}." for group in groups]
    words += [nearly(alike)] if alike else []
    return ("effect" if len(listed) == 1 else "several"), " ".join(words)


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
