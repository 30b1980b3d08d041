"""grounded status: where the search stands."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import number, progress, show, show_json, sparkline, table

if TYPE_CHECKING:
    from grounded.search import Standing


@click.command("status")
@in_workspace
@as_json
def command(folder: str | None, json_: bool) -> None:
    """Show where the search stands: derived from the stored trials, nothing is planned."""
    workspace = open_workspace(folder)
    from grounded_trials.proposing import standing_in

    with progress("reading trials"):
        standing = standing_in(workspace)
    if json_:
        show_json(as_document(standing))
        return
    show(summary(standing))
    system = workspace.config.system
    show(f"\nnext: {next_command(standing, bool(system.command or system.model))}")


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
    lines = []
    rows = []
    for t in standing.history:
        error = t.standard_error
        verdict = {True: "better", False: "no better", None: "waiting"}[t.accepted]
        if not t.candidate.base and t.accepted:
            verdict = "first"
        rows.append(
            (
                t.candidate.id,
                str(t.candidate.iteration),
                f"{t.candidate.alpha:g}",
                number(t.candidate.predicted_utility),
                number(t.utility),
                "-" if error != error else f"{error:.2g}",
                str(len(t.trials)),
                verdict,
            )
        )
    if rows:
        header = ("candidate", "iteration", "alpha", "predicted", "utility", "+-", "trials", "")
        lines.append(table(rows, header))
        bars = sparkline([t.utility for t in standing.history if t.utilities])
        lines.append(f"\nutility    {bars}")
    if standing.incumbent is not None:
        best = standing.incumbent
        first = standing.utilities[0]
        gain = (best.utility - first) / abs(first) if first else 0.0
        lines.append(
            f"best       {best.candidate.id}, utility {number(best.utility)}"
            + (
                f", {100 * gain:.1f} % better than the model's own policy"
                if standing.iteration
                else ""
            )
        )
    if sure := certainty(standing):
        lines.append(f"certainty  {sure}")
    lines.append(f"phase      {standing.phase}: {standing.sentence}")
    return "\n".join(lines)


def certainty(standing: Standing) -> str:
    """Whether the last improvement exceeds the noise of the utility, as a sentence."""
    from grounded.certainty import last_improvement

    return last_improvement(standing.history)


def next_command(standing: Standing, can_run: bool) -> str:
    """The command to type next."""
    if standing.phase == "await-trial":
        return "grounded run" if can_run else "grounded ingest TRIAL.mcap"
    if standing.phase == "propose":
        return "grounded propose"
    return "grounded diagnose"
