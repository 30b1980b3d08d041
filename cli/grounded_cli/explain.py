"""grounded explain: what the code of a finding, or an effect, means."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

from grounded.diagnosis.causes import in_words
from grounded.effects import Family, Scales, Site
from grounded.errors import GroundedError
from grounded.findings.catalogue import WEIGHTS, codes, entry_of
from grounded.findings.numbers import bare
from grounded.models import car, pendulum
from grounded.refusals import unknown
from grounded_cli.console.terminal import field, open_workspace, show
from grounded_trials.workspace.adopted import installed_effects


def explain(name: str) -> Iterator[dict[str, Any]]:
    """Print what a code or an effect means, or list all."""
    family, _, target = name.partition(":")
    findings = {one: entry_of(one)._asdict() for one in codes() if name in ("", one)}
    library = installed_effects().families
    chosen = [one for one in library if family in ("", one.name)]
    if not findings and not chosen:
        raise unknown("code or effect", family, [*(one.name for one in library), *codes()])
    effects = _described(chosen, target) if chosen else {}
    yield {"findings": findings, "effects": effects}
    if name:
        read = f"read docs/effects.md, {family}" if effects else "[text] is told where it applies"
        show(f"{name}: <name> stands for a value; {read}")
        (told,) = (findings | effects).values()
        show("\n".join(field(key, _text(value)) for key, value in told.items() if value))
    else:
        first = {one: next(iter(told.values())) for one, told in (findings | effects).items()}
        show("\n".join(field(one, text, width=20) for one, text in first.items()))


def _text(value: Any) -> str:
    """Return a text to be read without facts, names in a line, or names with their units."""
    if isinstance(value, dict):
        return ", ".join(f"{name} [{unit}]" for name, unit in value.items())
    if isinstance(value, str):
        return f"{value}: {WEIGHTS[value]}" if value in WEIGHTS else bare(value)
    return ", ".join(value)


def _described(families: Sequence[Family], target: str) -> dict[str, dict[str, Any]]:
    """Return what the registry has of families, with units at the target, or at an example."""
    models, told = [car.model, pendulum.model], {}
    with suppress(GroundedError):
        models = [open_workspace().base_model, *models]
    for family in families:
        found = [(model, at) for model in models for at in family.targets(model)]
        found.sort(key=lambda pair: pair[1] != target)
        sites = [Site(model, tuple(at.split("+")), Scales()) for model, at in found[:1]]
        told[family.name] = {
            "equation": family.equation,
            "sentence": in_words(family.sentence, target),
            "quantities": {q.name: q.unit for site in sites for q in family.quantities(site)},
            "example": "".join(f"{family.name}:{site.joined}" for site in sites),
            "lookalikes": list(family.lookalikes),
        }
    return told
