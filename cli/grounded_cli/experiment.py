"""grounded experiment: run the paper's studies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import click

from grounded.engine import Engine
from grounded.experiments import car, flight, theory
from grounded.refusals import wrong
from grounded_cli.console.options import misuse
from grounded_cli.console.terminal import bar, show, table

# name -> (function, meaning of --seeds, see `_seeds`, or "" if it takes none, summary)
STUDIES: dict[str, tuple[Callable[..., Any], str, str]] = {
    "flight": (flight.run, "count", "Table 1"),
    "car": (car.run, "seeds", "Figures 4, 5"),
    "footnote9": (theory.footnote9, "", "footnote 9"),
    "theorem1": (theory.theorem1, "seeds", "theorem 1"),
}


def experiment(name: str | None, seeds: str | None, jobs: int | None) -> Iterator[Any]:
    """Run a study, or list all."""
    if name is None:
        yield {"studies": {key: text for key, (_, _, text) in STUDIES.items()}}
        return show("\n".join(f"{key:15} {text}" for key, (_, _, text) in STUDIES.items()))
    study, kind, _ = STUDIES[name]
    given: dict[str, Any] = _seeds(seeds, kind, name)
    with bar(name) as progress:
        if kind:
            given |= {"engine": Engine(jobs or 1), "progress": progress}
        result = study(**given)
    yield result
    for one in result.tables():
        show(f"{one.title}\n\n{table(one.rows, one.head)}\n")


def _seeds(text: str | None, kind: str, name: str) -> dict[str, Any]:
    """Translate --seeds into the arguments of a study."""
    if text is None:
        return {}
    if not kind:
        raise misuse(name, "--seeds")
    first, dash, last = text.partition("-")
    try:
        if dash:
            chosen = [*range(int(first), int(last) + 1)]
        else:
            chosen = [*map(int, text.split(","))] if "," in text else [*range(int(text))]
    except ValueError:
        chosen = []
    in_row = chosen and chosen == [*range(chosen[0], chosen[-1] + 1)]
    if not (chosen and (kind == "seeds" or in_row)):
        raise click.UsageError(str(wrong("--seeds", got=text, like="8 or 0-7")))
    return {"seeds": chosen} if kind == "seeds" else {"count": len(chosen), "first_seed": chosen[0]}
