"""grounded propose: what to run next, what it will do, and whether to trust it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import number, progress, say, show, show_json

if TYPE_CHECKING:
    from grounded_trials.proposing import Proposed
    from grounded_trials.workspace import Workspace


@click.command("propose")
@in_workspace
@as_json
def command(folder: str | None, json_: bool) -> None:
    """Say what to run next and write its candidate file.

    The outstanding candidate is named again while its trial is missing. Nothing is proposed once
    the search has ended.
    """
    workspace = open_workspace(folder)
    from grounded_trials.proposing import propose_in

    with progress("planning"):
        proposed = propose_in(workspace)
    if json_:
        show_json(as_document(workspace, proposed))
    else:
        _tell(workspace, proposed)


def as_document(workspace: Workspace, proposed: Proposed) -> dict[str, Any]:
    """The fields of CONTRACT.md; candidate is null when the search has ended."""
    standing, candidate = proposed.proposal.standing, proposed.proposal.candidate
    phase = "await-trial" if candidate is not None else standing.phase
    document: dict[str, Any] = {
        "candidate": None,
        "file": None,
        "iteration": standing.iteration,
        "alpha": None,
        "predicted_utility": None,
        "phase": phase,
        "sentence": standing.sentence,
        "notes": list(proposed.proposal.notes),
    }
    if candidate is not None:
        document |= {
            "candidate": candidate.id,
            "file": str(proposed.file),
            "iteration": candidate.iteration,
            "alpha": candidate.alpha,
            "predicted_utility": candidate.predicted_utility,
            "best_utility": standing.incumbent.utility if standing.incumbent else None,
            "new": proposed.proposal.is_new,
        }
    return document


def _tell(workspace: Workspace, proposed: Proposed) -> None:
    standing, candidate = proposed.proposal.standing, proposed.proposal.candidate
    for note in proposed.proposal.notes:
        say(f"note: {note}")
    if candidate is None:
        show(f"Nothing to run: {standing.sentence}.")
        return
    task = workspace.task
    best = standing.incumbent
    waiting = "" if proposed.proposal.is_new else " (proposed before, its trial is missing)"
    show(f"Run {candidate.id}{waiting}: {proposed.file}")
    what = (
        "the model's own policy"
        if not candidate.base
        else (f"iteration {candidate.iteration}, alpha = {candidate.alpha:g} from {candidate.base}")
    )
    if candidate.caution:
        what += f", designed more gently after {candidate.caution} crash(es)"
    show(f"  what       {what}, {task.horizon * task.dt:g} s")
    show(
        f"  predicted  utility {number(candidate.predicted_utility)}",
    )
    if best is not None:
        show(f"  so far     best {best.candidate.id} with {number(best.utility)}")
    show(f"  trust      {_trust(workspace, proposed)}")
    reach = candidate.predicted_states
    for name in _position(task.model.roles):
        i = task.model.state_names.index(name)
        unit = task.model.states[name]
        show(f"  {name:10} from {reach[:, i].min():.2f} to {reach[:, i].max():.2f} {unit}")
    system = workspace.config.system
    follow = "grounded run" if system.command or system.model else "grounded ingest TRIAL.mcap"
    show(f"\nnext: {follow}")


def _trust(workspace: Workspace, proposed: Proposed) -> str:
    """How well predictions came true so far."""
    pairs = [
        (tried.candidate.predicted_utility, tried.utility)
        for tried in proposed.proposal.standing.history
        if tried.utilities
    ]
    if not pairs:
        return "unknown: the crude model was never compared with the real system"
    predicted, real = pairs[-1]
    return f"the last prediction was {number(predicted)}, the real run gave {number(real)}" + (
        f" ({len(pairs)} candidates so far)" if len(pairs) > 1 else ""
    )


def _position(roles: Any) -> list[str]:
    position = roles.get("position", ())
    return [position] if isinstance(position, str) else list(position)
