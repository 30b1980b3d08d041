"""grounded ingest: store logs of the real system."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from grounded.findings import Finding, Weight
from grounded_cli.console.options import json_asked, values_by_name
from grounded_cli.console.terminal import (
    field,
    next_line,
    number,
    open_workspace,
    progress,
    show,
    tell,
)
from grounded_trials.logs.log_paths import logs_in
from grounded_trials.workspace.intake.ingest import Ingested

ASIDE = "set aside"  # a verdict


def ingest(
    files: tuple[str, ...],
    candidate: str | None,
    data: bool,
    group: str,
    before: tuple[str, ...],
    details: bool,
) -> Iterator[dict[str, Any]]:
    """Store logs, and print what became of each."""
    workspace, held = open_workspace(), values_by_name(before, "--before")
    about: Any = {"candidate": candidate, "data": data, "group": group, "before": held}
    done, earlier = list[Ingested](), list[Finding]()
    for name in map(str, chain.from_iterable(map(logs_in, map(Path, files)))):
        with progress(f"reading {name}"):
            done.append(workspace.ingest(name, **about))
        if not json_asked():  # each at once, since the next one may be refused
            tell_ingested(name, done[-1], details, earlier)
            earlier += done[-1].findings
    yield {"trials": [one.to_json() for one in done]}
    show(f"\n{next_line(done[-1].then)}")


def tell_ingested(name: str, one: Ingested, details: bool, earlier: Sequence[Finding] = ()) -> None:
    """Print what became of a log; without details no note that was told of one before it."""
    if one.known:
        show(f"{name}: {one.trial}, stored before")
    new = list(one.findings)
    if earlier and not details:
        told = {(note.code, note.about) for note in earlier if note.weight is Weight.NOTE}
        new = [note for note in new if (note.code, note.about) not in told]
    tell(new, name, all_=details)
    if not one.known:
        show(f"{name}: {one.trial}")
    if not one.candidate:
        show(field("data", "for fit and diagnose", "  "))
    else:
        ended = one.utility == float("-inf")
        gained = "no utility" if ended else f"utility {number(one.utility)}"
        if one.runs > 1 and number(one.mean) != number(one.utility) and math.isfinite(one.mean):
            gained += f" (mean of its {one.runs} runs: {number(one.mean)})"
        text = f"{gained}, {one.verdict}"
        text = ASIDE if one.verdict == ASIDE and ended else text
        show(field(one.candidate, text, "  "))
    if one.off_target:
        show(field("off target", "; ".join(each.finding.what for each in one.off_target), "  "))
