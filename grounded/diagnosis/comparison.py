"""Two groups of trials in words: what changed between them, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from grounded.diagnosis.cause_words import give_or_take
from grounded.diagnosis.report import Changed, Diagnosis
from grounded.diagnosis.verdict import UNEXPLAINED
from grounded.result import listed

BOTH = "A gap remains if both groups get the same values: "
CHANGED = (
    "None is needed yet: the robot changed between the two groups, so adopt no value of both. "
    "Diagnose the newer trials alone, or discard the older ones."
)


def with_comparison(found: Diagnosis, adopted: Iterable[str]) -> Diagnosis:
    """Let the verdict begin with what changed between two groups of trials, if there are two.

    Args:
        found: the diagnosis of both groups together.
        adopted: names of adopted effects, whose values are parameters of the model.
    """
    if found.changed is None or found.no_cause:
        return found
    first, sentences = comparison(found.changed, adopted), found.verdict.lines
    if found.changed:
        found = replace(found, next_trial=CHANGED)
        sentences = tuple(text.replace(UNEXPLAINED, BOTH, 1) for text in sentences)
    sentences = (first, *sentences)
    said = replace(
        found.verdict, comparison=first, sentences=sentences, sentence=" ".join(sentences)
    )
    return replace(found, verdict=said)


def comparison(changed: Iterable[Changed], adopted: Iterable[str]) -> str:
    """Return a sentence on what changed between the two groups, or that nothing did."""
    adopted = tuple(adopted)
    told = [
        f"{value_of(one, adopted)} changed from {give_or_take(one.first)} to "
        f"{give_or_take(one.second)}"
        for one in changed
    ]
    if not told:
        return "Nothing that these trials show changed between the two groups beyond the noise."
    return f"Between the two groups, {listed(told)}."


def value_of(one: Changed, adopted: Iterable[str]) -> str:
    """Name a compared value: `r`, `c of dead_zone:u`, also if an adopted effect has it."""
    from grounded.effects import param_name

    if not one.effect.startswith("parameter:"):
        return f"{one.quantity} of {one.effect}"
    for effect in adopted:
        start = param_name(effect, "")
        if one.quantity.startswith(start):
            return f"{one.quantity.removeprefix(start)} of {effect}"
    return one.quantity
