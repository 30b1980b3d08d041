"""grounded challenge: make, run and score blind cases for the diagnosis, with sealed labels."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from grounded.challenge import make, summary
from grounded.engine import Engine
from grounded.errors import NextCommand
from grounded.refusals import refused
from grounded_cli.console.options import command, flag, parallel
from grounded_cli.console.terminal import bar, names_in, number, show, table
from grounded_cli.console.workspace_option import typed
from grounded_trials.challenge import diagnose_cases, score_cases, undiagnosed, write_cases
from grounded_trials.wording import count


@click.group("challenge")
def challenge() -> None:
    """Make, diagnose and score blind cases for the diagnosis.

    Run `grounded challenge run DIR` on a machine without the labels.
    """


@command("make", workspace=False, short_help="Write cases, and their sealed labels elsewhere.")
@click.argument("folder", metavar="DIR")
@click.option(
    "--kind",
    type=click.Choice(["single", "double", "none", "withheld"]),
    required=True,
    help="One effect, two, none, or one that is not in the library.",
)
@click.option("--cases", type=click.IntRange(1), required=True, metavar="N", help="How many.")
@click.option(
    "--seed", type=click.IntRange(0), required=True, metavar="S", help="Seed of all random draws."
)
@click.option(
    "--systems",
    default="own",
    metavar="G1,G2",
    help="Groups: own, kinked, mujoco (default: own; of several, own makes half of the cases).",
)
@click.option("--labels", metavar="DIR", help="Where the labels go (default: DIR-labels).")
@click.option(
    "--param-error",
    type=click.FloatRange(0.0, 0.5),
    metavar="E",
    help="Relative error of the model's parameters, 0 to 0.5.",
)
def make_cases(
    folder: str,
    kind: str,
    cases: int,
    seed: int,
    systems: str,
    labels: str | None,
    param_error: float | None,
) -> Iterator[dict[str, Any]]:
    """Write N workspaces with trials into DIR, and their labels, sealed by hash, elsewhere."""
    sealed = Path(labels or f"{folder}-labels")
    drawn = make(kind, cases, seed, groups=names_in(systems), param_error=param_error)  # type: ignore[arg-type]
    with bar("cases") as progress:
        names = write_cases(drawn, Path(folder), sealed, lambda done: progress(done, cases))
    yield {"workspace": folder, "labels": str(sealed), "cases": names}
    show(f"{folder}: {count(len(names), 'case')}; labels: {sealed}")
    show(f"\nnext: {typed(NextCommand('challenge', ('run', folder)))}")


@command("run", workspace=False, short_help="Diagnose the cases that have no diagnosis yet.")
@click.argument("folder", metavar="DIR")
@click.option("--without", multiple=True, metavar="F1,F2,...", help="Effect families to leave out.")
@flag("--again", help="Also repeat the diagnoses that exist.")
@parallel
def run_cases(
    folder: str, without: tuple[str, ...], again: bool, engine: Engine
) -> Iterator[dict[str, Any]]:
    """Diagnose the cases of DIR that have no diagnosis yet; an interrupted run resumes."""
    families = [name for text in without for name in names_in(text)]
    waiting = undiagnosed(Path(folder), again=again)
    with bar("diagnoses") as progress:
        times = diagnose_cases(
            Path(folder), without=families, again=again, engine=engine, progress=progress
        )
    yield {"cases": list(times), "cpu_s": times}
    if waiting:
        mean = sum(times.values()) / max(len(times), 1)
        show(f"{count(len(waiting), 'case')}: {mean:.1f} s CPU")
    labels = () if Path(f"{folder}-labels").is_dir() else ("--labels", "DIR")
    show(f"\nnext: {typed(NextCommand('challenge', ('score', folder, *labels)))}")


@command("score", workspace=False, short_help="Open the labels, score the diagnoses.")
@click.argument("folder", metavar="DIR")
@click.option("--labels", metavar="DIR", help="Where the labels are (default: DIR-labels).")
@parallel
def score(folder: str, labels: str | None, engine: Engine) -> Iterator[dict[str, Any]]:
    """Open the labels, score the diagnoses of DIR and compare with an oracle.

    The oracle knows the effects of each case.
    """
    sealed = _labels(folder, labels)
    with bar("cases") as progress:
        marks = score_cases(Path(folder), sealed, engine=engine, progress=progress)
    found = summary(marks)
    yield {"summary": found, "cases": marks}
    rows = [(m["case"], ", ".join(m["truth"]), m["verdict"], _few(m["named"])) for m in marks]
    show(table(rows, ("case", "truth", "verdict", "named")))
    for kind, row in found.items():
        show(f"\n{kind}")
        for key, value in row.items():
            show(f"  {key.replace('_', ' '):<20} {_words(value)}")


challenge.add_command(make_cases)
challenge.add_command(run_cases)
challenge.add_command(score)


def _few(names: list[str]) -> str:
    more = len(names) - 3
    return ", ".join(names[:3]) + (f" and {more} more" if more > 0 else "")


def _labels(folder: str, labels: str | None) -> Path:
    """Return the folder of the labels.

    Raises:
        GroundedError: if none is named and the default one does not exist.
    """
    usual = Path(f"{folder}-labels")
    if labels is None and Path(folder).is_dir() and not usual.is_dir():
        raise refused("file.missing", usual, where="--labels")
    return Path(labels) if labels is not None else usual


def _words(value: Any) -> str:
    if isinstance(value, dict) and "of" in value:
        return _share(**value)
    if isinstance(value, dict):
        return ", ".join(f"{key} {_words(one)}" for key, one in value.items())
    return _figure(value)


def _share(count: int, of: int, share: float | None, interval: list[float] | None) -> str:
    """Format a share with its interval, `17 of 18 (94 %; 74 to 99 %)`."""
    if share is None or interval is None:
        return "none of that kind"
    low, high = (100 * end for end in interval)
    return f"{count} of {of} ({100 * share:.3g} %; {low:.0f} to {high:.0f} %)"


def _figure(value: Any) -> str:
    return str(value) if isinstance(value, int) else number(value, 3)
