"""grounded status: where the search stands."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import click

from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import field, number, progress, show, show_json, sparkline, table
from grounded_trials.wording import folded, verdict

if TYPE_CHECKING:
    from grounded.search.standing import Standing, Tried
    from grounded_trials.workspace.diagnosis_file import Diagnosis
    from grounded_trials.workspace.folder import Workspace

LEGEND = "damp: penalty on leaving the last trial's inputs; +-: standard error"


@click.command("status")
@in_workspace
@as_json
def command(folder: str | None, json_: bool) -> None:
    """Show where the search stands: derived from the stored trials, nothing is written."""
    workspace = open_workspace(folder)
    from grounded_trials.workspace.proposing import standing_in

    with progress("reading trials"):
        standing = standing_in(workspace, ahead=True)
    if json_:
        show_json(as_document(standing))
        return
    show(summary(standing))
    if text := _outdated(workspace):
        show(field("diagnosis", text))
    show(f"\n{next_line(workspace, standing)}")


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
                "verdict": verdict(t, t is standing.history[-1]),
            }
            for t in standing.history
        ],
    }


def summary(standing: Standing) -> str:
    """The history as a table, with a line of bars and how sure the last improvement is."""
    from grounded_trials.report.report_text import spaced

    lines = []
    if standing.history:
        header = ("id", "iter", "alpha", "damp", "predicted", "utility", "+-", "trials", "")
        last = standing.history[-1]
        lines.append(table([_row(t, t is last) for t in standing.history], header))
        lines.append(f"  {LEGEND}")
        bars = sparkline(spaced([t.utility for t in standing.history if t.utilities]))
        lines.append("\n" + field("utility", bars))
    if standing.incumbent is not None:
        best = standing.incumbent
        text = f"{best.candidate.id}, utility {number(best.utility)}{gained(standing)}"
        lines.append(field("best", text))
    if sure := certainty(standing):
        lines.append(field("certainty", sure))
    lines.append(field("phase", f"{standing.phase}: {standing.sentence}"))
    return "\n".join(lines)


def gained(standing: Standing) -> str:
    """By how much the best candidate beats the model's own policy, as the end of a sentence."""
    best, own = standing.incumbent, standing.history[0]
    if best is None or best.candidate is own.candidate or own.candidate.base or not own.utilities:
        return ""
    if not math.isfinite(own.utility):
        return "; the model's own policy failed"
    if best.candidate.base == "" or not own.utility:
        return ""
    gain = 100 * (best.utility - own.utility) / abs(own.utility)
    return f", {gain:.1f} % better than the model's own policy"


def _row(tried: Tried, last: bool) -> tuple[str, ...]:
    error = tried.standard_error
    return (
        tried.candidate.id,
        str(tried.candidate.iteration),
        f"{tried.candidate.alpha:g}",
        f"{tried.candidate.damping:.2g}" if tried.candidate.base else "-",
        number(tried.candidate.predicted_utility),
        number(tried.utility),
        "-" if error != error else f"{error:.2g}",
        str(len(tried.trials)),
        verdict(tried, last),
    )


def certainty(standing: Standing) -> str:
    """Whether the last improvement exceeds the noise of the utility, as a sentence."""
    from grounded.search.standing import last_improvement

    return last_improvement(standing.history)


def next_line(workspace: Workspace, standing: Standing) -> str:
    """The last line of an output: the command to type next."""
    from grounded_trials.workspace.next_step import next_command, usable_ids

    usable = usable_ids(workspace)
    return folded(next_command(workspace, standing, _diagnosis(workspace), usable))


def _diagnosis(workspace: Workspace) -> Diagnosis | None:
    from grounded.errors import GroundedError
    from grounded_trials.workspace.diagnosis_file import read_diagnosis

    try:
        return read_diagnosis(workspace.reports)
    except GroundedError:  # a damaged one is made again
        return None


def _outdated(workspace: Workspace) -> str:
    """Why the last diagnosis is not the last word."""
    from grounded_trials.workspace.next_step import since_diagnosis, usable_ids

    found = _diagnosis(workspace)
    return since_diagnosis(workspace, found, usable_ids(workspace)).sentence if found else ""
