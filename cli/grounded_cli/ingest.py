"""grounded ingest: take in what came back from the real system."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from grounded_cli import completion as complete
from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import field, number, progress, remark, show, show_json, table

if TYPE_CHECKING:
    from grounded_trials.workspace.ingest import Ingested

# what a verdict means for the search
VERDICTS = {
    "first": ": what the search improves on",
    "better": ": the best so far",
    "no better": " than the best so far",
    "waiting": ": more trials of it are needed ([search] repeats)",
    "in doubt": ": it may be bad luck, the best so far is run once more",
    "probe": ", for the diagnosis: the search leaves it out",
    "run again": ": its utility is the mean of its trials",
}


@click.command("ingest")
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option(
    "--candidate", metavar="ID", shell_complete=complete.candidates, help="Which candidate was run."
)
@click.option("--data", is_flag=True, help="The log ran no candidate: for fit and diagnose only.")
@in_workspace
@as_json
def command(
    files: tuple[str, ...], candidate: str | None, data: bool, folder: str | None, json_: bool
) -> None:
    """Check, resample and store trials: MCAP files or bag folders.

    A file that was stored before is a success that says which trial it is. Trials that grounded
    wrote are taken as they are; other logs are mapped by the [log] table (`grounded inspect LOG`
    prints one).
    """
    workspace = open_workspace(folder)
    from grounded_trials.workspace.ingest import ingest_log
    from grounded_trials.workspace.proposing import candidate_named

    done: list[Ingested] = []
    for name in files:
        with progress(f"reading {name}"):
            ran = candidate and candidate_named(workspace, candidate)
            found = ingest_log(workspace, Path(name), ran, data=data)
        done.append(found)
        if not json_:
            _tell(name, found)
    if json_:
        show_json({"trials": [as_document(one) for one in done]})
    else:
        follow = "diagnose" if done[-1].verdict == "probe" else "propose"
        show(f"\nnext: grounded {follow if done[-1].candidate else 'fit'}")


def as_document(one: Ingested) -> dict[str, Any]:
    """The fields of CONTRACT.md; a failed run's utility is null and `failed` true."""
    return {
        "trial": one.trial,
        "sha256": one.sha256,
        "known": one.known,
        "candidate": one.candidate or None,
        "utility": one.utility,
        "failed": one.utility == float("-inf"),
        "accepted": one.accepted,
        "verdict": one.verdict or None,
        "warnings": list(one.warnings),
        "signals": [vars(signal) for signal in one.signals],
    }


def _tell(name: str, one: Ingested) -> None:
    for warning in one.warnings:
        remark("warning", f"{name}: {warning}")
    known = "was stored before as" if one.known else "is stored as"
    show(f"{name} {known} {one.trial}")
    if not one.candidate:
        show(field("data", "for fit and diagnose: it ran no candidate", "  "))
    else:
        meaning = VERDICTS.get(one.verdict, "")
        if one.utility == float("-inf"):
            meaning = ": it did not run to the end" * (one.verdict == "no better")
        text = f"utility {number(one.utility)}, {one.verdict}{meaning}"
        show(field(one.candidate, text, "  "))
    if one.signals:
        rows = [
            (
                s.name,
                f"{s.rate_hz:.1f}",
                f"{1e3 * s.jitter_s:.1f}",
                f"{1e3 * s.largest_gap_s:.0f}",
                "-" if s.skew_s is None else f"{1e3 * s.skew_s:.1f}",
                str(s.bridged),
                f"{s.low:.3g} .. {s.high:.3g}",
            )
            for s in one.signals
        ]
        header = ("signal", "Hz", "jitter ms", "gap ms", "skew ms", "bridged", "range")
        show(table(rows, header))
