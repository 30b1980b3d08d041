"""grounded challenge: make, run and score blind cases for the diagnosis, with sealed labels."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from grounded.challenge import make, summary
from grounded.engine import Engine
from grounded.errors import NextCommand
from grounded.refusals import refused
from grounded_cli.console.terminal import bar, names_in, number, show, table, typed
from grounded_trials.challenge import diagnose_cases, score_cases, write_cases
from grounded_trials.wording import count


def make_cases(
    folder: str,
    kind: str,
    cases: int,
    seed: int,
    systems: str,
    labels: str | None,
    param_error: float | None,
) -> Iterator[dict[str, Any]]:
    """Write cases and their sealed labels."""
    sealed = Path(labels or f"{folder}-labels")
    drawn = make(kind, cases, seed, groups=names_in(systems), param_error=param_error)  # type: ignore[arg-type]
    with bar("cases") as progress:
        names = write_cases(drawn, Path(folder), sealed, lambda done: progress(done, cases))
    yield {"workspace": folder, "labels": str(sealed), "cases": names}
    show(f"{folder}: {count(len(names), 'case')}; labels: {sealed}")
    show(f"\nnext: {typed(NextCommand('challenge', ('run', folder)))}")


def run_cases(
    folder: str, without: tuple[str, ...], again: bool, jobs: int | None
) -> Iterator[dict[str, Any]]:
    """Diagnose the cases without a diagnosis."""
    families = [name for text in without for name in names_in(text)]
    engine = Engine(jobs or 1)
    with bar("diagnoses") as progress:
        times = diagnose_cases(
            Path(folder), without=families, again=again, engine=engine, progress=progress
        )
    yield {"cases": list(times), "cpu_s": times}
    if times:
        show(f"{count(len(times), 'case')}: {sum(times.values()) / len(times):.1f} s CPU")
    labels = () if Path(f"{folder}-labels").is_dir() else ("--labels", "DIR")
    show(f"\nnext: {typed(NextCommand('challenge', ('score', folder, *labels)))}")


def score(folder: str, labels: str | None, jobs: int | None) -> Iterator[dict[str, Any]]:
    """Score the diagnoses; print a table and the shares."""
    sealed = Path(labels or f"{folder}-labels")
    if labels is None and Path(folder).is_dir() and not sealed.is_dir():
        raise refused("file.missing", sealed, where="--labels")
    with bar("cases") as progress:
        marks = score_cases(Path(folder), sealed, engine=Engine(jobs or 1), progress=progress)
    found = summary(marks)
    yield {"summary": found, "cases": marks}
    rows = [
        (m["case"], *(", ".join(m[k]) for k in ("truth", "named")), m["verdict"]) for m in marks
    ]
    show(table(rows, ("case", "truth", "verdict", "named")))
    for kind, row in found.items():
        show(f"\n{kind}")
        for key, value in row.items():
            show(f"  {key.replace('_', ' '):<20} {_words(value)}")


def _words(value: Any) -> str:
    """Return a number, numbers by name, or a share as `17 of 18 (94 %; 74 to 99 %)`."""
    if not isinstance(value, dict):
        return str(value) if isinstance(value, int) else number(value, 3)
    if "of" not in value:
        return ", ".join(f"{key} {_words(one)}" for key, one in value.items())
    if value["share"] is None or value["interval"] is None:
        return "none of that kind"
    share, low, high = (100 * part for part in (value["share"], *value["interval"]))
    return f"{value['count']} of {value['of']} ({share:.3g} %; {low:.0f} to {high:.0f} %)"
