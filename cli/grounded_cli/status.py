"""grounded status: where the search stands."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import field, number, progress, show, show_json, sparkline, table

if TYPE_CHECKING:
    from grounded.search import Standing, Tried


@click.command("status")
@in_workspace
@as_json
def command(folder: str | None, json_: bool) -> None:
    """Show where the search stands: derived from the stored trials, nothing is written."""
    workspace = open_workspace(folder)
    from grounded_trials.proposing import standing_in

    with progress("reading trials"):
        standing = standing_in(workspace, ahead=True)
    if json_:
        show_json(as_document(standing))
        return
    show(summary(standing))
    system, diagnosed = workspace.config.system, (workspace.reports / "diagnosis.json").exists()
    show(f"\nnext: {next_command(standing, bool(system.command or system.model), diagnosed)}")


def as_document(standing: Standing) -> dict[str, Any]:
    """The fields of CONTRACT.md, and the whole history."""
    best = standing.incumbent
    return {
        "phase": standing.phase,
        "iteration": standing.iteration,
        "best": None if best is None else {"candidate": best.candidate.id, "utility": best.utility},
        "utilities": standing.utilities,
        "trials": standing.trials,
        "outstanding": standing.outstanding.id if standing.outstanding else None,
        "missing": standing.missing,
        "sentence": standing.sentence,
        "certainty": certainty(standing),
        "history": [
            {
                "candidate": t.candidate.id,
                "iteration": t.candidate.iteration,
                "alpha": t.candidate.alpha,
                "base": t.candidate.base or None,
                "predicted_utility": t.candidate.predicted_utility,
                "utility": t.utility,
                "standard_error": t.standard_error,
                "trials": [trial.id for trial in t.trials],
                "accepted": t.accepted,
            }
            for t in standing.history
        ],
    }


def summary(standing: Standing) -> str:
    """The history as a table, with a line of bars and how sure the last improvement is."""
    from grounded_trials.report_text import spaced

    lines = []
    if standing.history:
        header = ("id", "iter", "alpha", "damp", "predicted", "utility", "+-", "trials", "")
        lines.append(table([_row(t) for t in standing.history], header))
        bars = sparkline(spaced([t.utility for t in standing.history if t.utilities]))
        lines.append("\n" + field("utility", bars))
    if standing.incumbent is not None:
        best, first = standing.incumbent, standing.utilities[0]
        gain = 100 * (best.utility - first) / abs(first) if first else 0.0
        better = f", {gain:.1f} % better than the model's own policy" * bool(standing.iteration)
        lines.append(field("best", f"{best.candidate.id}, utility {number(best.utility)}{better}"))
    if sure := certainty(standing):
        lines.append(field("certainty", sure))
    lines.append(field("phase", f"{standing.phase}: {standing.sentence}"))
    return "\n".join(lines)


def _row(tried: Tried) -> tuple[str, ...]:
    error = tried.standard_error
    verdict = {True: "better", False: "no better", None: "waiting"}[tried.accepted]
    if not tried.candidate.base and tried.accepted:
        verdict = "first"
    return (
        tried.candidate.id,
        str(tried.candidate.iteration),
        f"{tried.candidate.alpha:g}",
        f"{tried.candidate.damping:.2g}" if tried.candidate.base else "-",
        number(tried.candidate.predicted_utility),
        number(tried.utility),
        "-" if error != error else f"{error:.2g}",
        str(len(tried.trials)),
        verdict,
    )


def certainty(standing: Standing) -> str:
    """Whether the last improvement exceeds the noise of the utility, as a sentence."""
    from grounded.certainty import last_improvement

    return last_improvement(standing.history)


def next_command(standing: Standing, can_run: bool, diagnosed: bool = False) -> str:
    """The command to type next."""
    if standing.phase == "await-trial":
        return "grounded run" if can_run else "grounded ingest TRIAL.mcap"
    if standing.phase == "propose":
        return "grounded propose"
    return "grounded report --html" if diagnosed else "grounded diagnose"
