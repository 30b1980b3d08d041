"""grounded experiment: run the paper's studies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click

from grounded.engine import Engine
from grounded.experiments import car, flight, footnote9, theorem1
from grounded.refusals import wrong
from grounded_cli.console.options import command, misuse, parallel
from grounded_cli.console.terminal import bar, show, table
from grounded_trials.store.documents import StudyStore

# name -> (function, meaning of --seeds, see `_seeds`, or "" if it takes none, summary)
STUDIES: dict[str, tuple[Callable[..., Any], str, str]] = {
    "flight": (flight.run, "count", "Table 1, Figure 1"),
    "car": (car.run, "seeds", "Figures 4, 5"),
    "footnote9": (footnote9.run, "", "footnote 9"),
    "theorem1": (theorem1.run, "seeds", "theorem 1"),
}


@command("experiment", workspace=False)
@click.argument("name", type=click.Choice(list(STUDIES)), metavar="[NAME]", required=False)
@click.option("--seeds", metavar="N|A-B|A,B,...", help="How many seeds, or which ones.")
@parallel
@click.option(
    "--keep", metavar="DIR", help="Where finished jobs are kept (default: .grounded-studies/NAME)."
)
def experiment(
    name: str | None, seeds: str | None, engine: Engine, keep: str | None
) -> Iterator[Any]:
    """Run one of the paper's studies; the same seeds give the same results on any machine.

    Without NAME the studies are listed. Finished jobs are kept, so an interrupted study resumes.
    """
    if name is None:
        yield {"studies": {key: text for key, (_, _, text) in STUDIES.items()}}
        return show("\n".join(f"{key:15} {text}" for key, (_, _, text) in STUDIES.items()))
    study, kind, _ = STUDIES[name]
    given: dict[str, Any] = _seeds(seeds, kind, name)
    if kind:
        given |= {
            "engine": engine,
            "finished": StudyStore(Path(keep or f".grounded-studies/{name}")),
        }
    with bar(name) as progress:
        if kind:
            given["progress"] = progress
        result = study(**given)
    yield result
    for one in result.tables():
        show(f"{one.title}\n\n{table(one.rows, one.head)}\n")


def _unlike(text: str) -> click.UsageError:
    """Return the error of --seeds that select nothing that the study can run."""
    return click.UsageError(str(wrong("--seeds", got=text, like="8 or 0-7")))


def _seeds(text: str | None, kind: str, name: str) -> dict[str, Any]:
    """Translate --seeds into the arguments of a study."""
    if text is None:
        return {}
    if not kind:
        raise misuse(name, "--seeds")
    try:
        if "-" in text:
            first, last = (int(part) for part in text.split("-"))
            chosen = list(range(first, last + 1))
        elif "," in text:
            chosen = [int(part) for part in text.split(",")]
        else:
            chosen = list(range(int(text)))
    except ValueError:
        raise _unlike(text) from None
    if not chosen:
        raise _unlike(text)
    if kind == "seeds":
        return {"seeds": chosen}
    if chosen != list(range(chosen[0], chosen[-1] + 1)):
        raise _unlike(text)
    return {"count": len(chosen), "first_seed": chosen[0]}
