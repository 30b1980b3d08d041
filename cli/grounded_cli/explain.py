"""grounded explain: what the code of a finding, or an effect, means."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import click

from grounded.errors import GroundedError, alike
from grounded.findings.catalogue import WEIGHTS, codes, entry_of
from grounded.findings.numbers import bare
from grounded.refusals import refused
from grounded_cli.console.options import as_json
from grounded_cli.console.terminal import field, show, show_json
from grounded_cli.console.workspace_option import open_workspace

if TYPE_CHECKING:
    from grounded.effects import Family
    from grounded.model import Model


@click.command("explain")
@click.argument("name", metavar="[CODE|EFFECT]", required=False, default="")
@as_json
def command(name: str, json_: bool) -> None:
    """Print what the CODE of a finding, or an EFFECT or its family, means; without, list all."""
    from grounded_trials.workspace.adopted import installed_effects

    family, _, target = name.partition(":")
    library = {one.name: one for one in installed_effects().families}
    findings = {one: _words(one) for one in codes() if name in ("", one)}
    models = [*_models()] if family in ("", *library) else []
    effects = {k: _seen(f, target, models) for k, f in library.items() if family in ("", k)}
    told = findings | effects
    if not told:
        close = filter(None, (alike(name, codes()), alike(family, library)))
        facts = {"near": "' or '".join(close)}
        facts = facts if facts["near"] else {"known": "those that `grounded explain` lists"}
        raise refused("given.name", name, kind="code or effect", **facts)
    if json_:
        show_json({"findings": findings, "effects": effects})
    elif name:
        show(f"{name}: <name> stands for a value, [text] is told where it applies")
        show("\n".join(field(key, _text(v)) for key, v in next(iter(told.values())).items() if v))
    else:
        short = {one: about.get("weight", about.get("equation")) for one, about in told.items()}
        show("\n".join(field(one, text, width=max(map(len, short))) for one, text in short.items()))


def _text(value: Any) -> str:
    """Return a text for reading without facts, names in a line, or names with their units."""
    if isinstance(value, dict):
        return ", ".join(f"{name} [{unit}]" for name, unit in value.items())
    return bare(value) if isinstance(value, str) else ", ".join(value)


def _words(code: str) -> dict[str, Any]:
    """Return the entry of a code, and what its weight means."""
    entry = entry_of(code)
    return {"weight": entry.weight, "means": WEIGHTS[entry.weight]} | vars(entry)


def _models() -> Iterator[Model]:
    """Yield the workspace's model, if there is one, then examples for the units of quantities."""
    from grounded.models import car, pendulum

    with suppress(GroundedError):
        yield open_workspace().base_model
    yield from (car.model, pendulum.model)


def _seen(family: Family, target: str, models: list[Model]) -> dict[str, Any]:
    """Return what the registry has of a family, with units at the target, or at an example."""
    from grounded.diagnosis.causes import in_words
    from grounded.effects import Scales, Site

    found = [(model, one) for model in models for one in family.targets(model)]
    found.sort(key=lambda pair: pair[1] != target)
    sites = [Site(model, tuple(at.split("+")), Scales()) for model, at in found[:1]]
    return {
        "equation": family.equation,
        "sentence": in_words(family.sentence, target),
        "quantities": {q.name: q.unit for site in sites for q in family.quantities(site)},
        "example": "".join(f"{family.name}:{site.joined}" for site in sites),
        "lookalikes": list(family.lookalikes),
        "read": "docs/effects.md",
    }
