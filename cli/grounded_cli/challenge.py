"""grounded challenge: blind cases for the diagnosis, with sealed labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from grounded_cli.options import as_json
from grounded_cli.terminal import bar, number, show, show_json, table


@click.group("challenge")
def command() -> None:
    """Make, diagnose and score blind cases for the diagnosis.

    Run `grounded challenge run DIR` where the labels are not on the disk.
    """


def parallel(function: Any) -> Any:
    """The options of a command that is a list of independent jobs."""
    for option in (
        click.option("--address", metavar="URL", help="Scheduler of a Dask cluster."),
        click.option(
            "--engine",
            type=click.Choice(["local", "dask"]),
            default="local",
            help="Where jobs run: here (default) or on a Dask cluster that sees this disk.",
        ),
        click.option(
            "--jobs",
            type=click.IntRange(1),
            metavar="N",
            default=1,
            help="Processes on this machine.",
        ),
    ):
        function = option(function)
    return function


@command.command("make", short_help="Write cases, and their labels, sealed, elsewhere.")
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
    show(f"\nnext: grounded challenge run {folder}")


@command.command("run", short_help="Diagnose the cases that were not yet.")
@click.argument("folder", metavar="DIR")
@click.option("--without", multiple=True, metavar="FAMILY", help="Not to blame (repeatable).")
@click.option("--again", is_flag=True, help="Those that were diagnosed before too.")
@parallel
@as_json
def run_cases(
    folder: str,
    without: tuple[str, ...],
    again: bool,
    jobs: int,
    engine: str,
    address: str | None,
    json_: bool,
) -> None:
    """Diagnose the cases of DIR that were not yet; a run that was cut off goes on."""
    from grounded.experiments.jobs import Engine
    from grounded_trials.challenge_jobs import diagnose_cases

    where = Engine(jobs=jobs, name=engine, address=address)
    with bar("diagnoses") as progress:
        times = diagnose_cases(
            Path(folder), without=without, again=again, engine=where, progress=progress
        )
    if json_:
        show_json({"cases": list(times), "cpu_s": times})
        return
    mean = sum(times.values()) / max(len(times), 1)
    show(f"{len(times)} cases are diagnosed, {mean:.1f} s of CPU each")
    show(f"\nnext: grounded challenge score {folder}")


@command.command("score", short_help="Open the labels, mark the diagnoses.")
@click.argument("folder", metavar="DIR")
@click.option("--labels", metavar="DIR", help="Where the labels are (default: DIR-labels).")
@parallel
@as_json
def score(
    folder: str, labels: str | None, jobs: int, engine: str, address: str | None, json_: bool
) -> None:
    """Open the labels and mark the diagnoses of DIR, beside an oracle that knows the effects."""
    from grounded.diagnosis.challenge import summary
    from grounded.experiments.jobs import Engine
    from grounded_trials.challenge_jobs import score_cases

    sealed = Path(labels or f"{folder}-labels")
    where = Engine(jobs=jobs, name=engine, address=address)
    with bar("cases") as progress:
        marks = score_cases(Path(folder), sealed, engine=where, progress=progress)
    found = summary(marks)
    if json_:
        show_json({"summary": found, "cases": marks})
        return
    rows = [(m["case"], ", ".join(m["truth"]), m["verdict"], ", ".join(m["named"])) for m in marks]
    show(table(rows, ("case", "truth", "verdict", "named")))
    for kind, row in found.items():
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
