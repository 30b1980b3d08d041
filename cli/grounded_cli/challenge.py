"""grounded challenge: blind cases for the diagnosis, with sealed labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from grounded_cli.options import as_json
from grounded_cli.terminal import bar, number, show, show_json, table


@click.group("challenge")
def command() -> None:
    """Make or score blind cases for the diagnosis.

    Diagnose each case with `grounded -C DIR/CASE diagnose`, where the labels are not on the disk.
    """


@command.command("make")
@click.argument("folder", metavar="DIR")
@click.option("--kind", type=click.Choice(["single", "double", "none", "withheld"]), required=True)
@click.option("--cases", type=click.IntRange(1), required=True, metavar="N", help="How many.")
@click.option("--seed", type=click.IntRange(0), required=True, metavar="S", help="Of everything.")
@click.option("--labels", metavar="DIR", help="Where the labels go (default: DIR-labels).")
@click.option("--param-error", type=float, metavar="E", help="Error of the model's parameters.")
@as_json
def make_cases(
    folder: str,
    kind: str,
    cases: int,
    seed: int,
    labels: str | None,
    param_error: float | None,
    json_: bool,
) -> None:
    """Write N workspaces of trials into DIR, and their labels, sealed by hash, elsewhere."""
    from grounded.diagnosis.challenge import make
    from grounded_trials.challenge_files import write_cases

    sealed = Path(labels or f"{folder}-labels")
    drawn = make(kind, cases, seed, param_error=param_error)  # type: ignore[arg-type]
    with bar("cases") as progress:
        names = write_cases(drawn, Path(folder), sealed, lambda done: progress(done, cases))
    if json_:
        show_json({"workspace": folder, "labels": str(sealed), "cases": names})
        return
    show(f"{len(names)} cases in {folder}, their labels in {sealed} (keep them away from it)")
    show(f"\nnext: grounded -C {folder}/{names[0]} diagnose")


@command.command("score")
@click.argument("folder", metavar="DIR")
@click.option("--labels", metavar="DIR", help="Where the labels are (default: DIR-labels).")
@as_json
def score_cases(folder: str, labels: str | None, json_: bool) -> None:
    """Open the labels and mark the diagnoses of DIR, beside an oracle that knows the effects."""
    from grounded.diagnosis.challenge import summary
    from grounded_trials.challenge_files import read_manifest, score_case

    sealed = Path(labels or f"{folder}-labels")
    entries = read_manifest(Path(folder))
    marks = []
    with bar("cases") as progress:
        for done, (name, entry) in enumerate(entries.items(), start=1):
            marks.append(score_case(Path(folder), sealed, name, entry))
            progress(done, len(entries))
    figures = summary(marks)
    if json_:
        show_json({"summary": figures, "cases": marks})
        return
    rows = [(m["case"], ", ".join(m["truth"]), m["verdict"], ", ".join(m["named"])) for m in marks]
    show(table(rows, ("case", "truth", "verdict", "named")))
    for kind, row in figures.items():
        show(f"\n{kind}: {_words(row)}")


def _words(row: dict[str, Any]) -> str:
    parts = []
    for key, value in row.items():
        if isinstance(value, dict):
            parts.append(f"{key} " + ", ".join(f"{k} {_figure(v)}" for k, v in value.items()))
        else:
            parts.append(f"{key.replace('_', ' ')} {_figure(value)}")
    return "; ".join(parts)


def _figure(value: Any) -> str:
    return str(value) if isinstance(value, int) else number(value, 3)
