"""grounded adopt: add diagnosed effects to the model, or undo it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from grounded_cli.console import completion as complete
from grounded_cli.console.options import as_json, misuse
from grounded_cli.console.terminal import field, sentence, show, show_json, tell
from grounded_cli.console.workspace_option import in_workspace, next_line, open_workspace
from grounded_trials.wording import ALONE, moved

if TYPE_CHECKING:
    from grounded_trials import Workspace

DIGITS = 4  # of a parameter, at least


@click.command("adopt")
@click.argument("effects", nargs=-1, metavar="EFFECT...", shell_complete=complete.effects)
@click.option("--effect-only", is_flag=True, help="Leave the model's own parameters alone.")
@click.option("--undo", is_flag=True, help="Undo the last adoption.")
@in_workspace
@as_json
def command(effects: tuple[str, ...], effect_only: bool, undo: bool, json_: bool) -> None:
    """Add effects of the last diagnosis (`family:target`) to [model] in grounded.toml.

    Effects that were claimed together were estimated together: adopt them together. The model
    parameters calibrated with them are written to [model] params. An effect that was not claimed
    can be adopted alone: its values come without parameters.

    The search goes on from the best policy and plans with the better model. --undo restores the
    effects and parameters that [model] had before the last adoption; repeat it to go further back.
    """
    if undo == bool(effects) or (undo and effect_only):
        raise misuse("EFFECT...", "--undo")
    workspace = open_workspace()
    if undo:
        _undo(workspace, json_)
        return
    before = workspace.base_model.params
    done = workspace.adopt(*effects, parameters=not effect_only)
    if json_:
        show_json(done.to_json())
        return
    for name in dict.fromkeys((*effects, *done.along)):
        alone = ALONE * (name in done.jointly)
        show(field("adopted", f"{name}{alone}"))
    tell(done.findings)
    if done.params:
        show("[model] params:")
    for name, value in done.params.items():
        text = moved(before[name].value, value, before[name].unit, DIGITS)
        show(field(name, text + ALONE * (name in done.jointly), "  "))
    show(f"\n{next_line(done.then)}")


def _undo(workspace: Workspace, json_: bool) -> None:
    """Undo the last adoption and print the restored effects and parameters."""
    before = workspace.base_model.params
    done = workspace.undo_adoption()
    if json_:
        show_json(done.to_json())
        return
    sentence(f"undone: {', '.join(done.undone)} ({workspace.config.file})")
    now = workspace.base_model.params
    for name, was in before.items():
        if was.value != now[name].value:
            show(field(name, moved(was.value, now[name].value, was.unit, DIGITS), "  "))
    rest = ", ".join(str(effect["name"]) for effect in done.effects)
    show(field("adopted", rest or "none"))
    show(f"\n{next_line(done.then)}")
