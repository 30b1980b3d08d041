"""grounded adopt: add diagnosed effects to the model, or undo it."""

from __future__ import annotations

from collections.abc import Iterator

import click

from grounded_cli.console import completion as complete
from grounded_cli.console.options import command, flag, misuse
from grounded_cli.console.terminal import field, sentence, show, tell
from grounded_cli.console.workspace_option import next_line, open_workspace
from grounded_trials.wording import ALONE, moved
from grounded_trials.workspace.adoption import Adopted, Undone, numbers_in

DIGITS = 4  # of a parameter, at least


@command("adopt")
@click.argument("effects", nargs=-1, metavar="EFFECT...", shell_complete=complete.effects)
@flag("--effect-only", help="Leave the model's own parameters alone.")
@flag("--undo", help="Undo the last adoption.")
def adopt(effects: tuple[str, ...], effect_only: bool, undo: bool) -> Iterator[Adopted | Undone]:
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
    before, file = workspace.base_model.params, workspace.config.file
    were = numbers_in(workspace)
    if undo:
        done: Adopted | Undone = workspace.undo_adoption()
    else:
        done = workspace.adopt(*effects, parameters=not effect_only)
    yield done
    if isinstance(done, Undone):
        sentence(f"undone: {', '.join(done.undone)} ({file})")
        now = workspace.base_model.params
        values = {k: now[k].value for k, was in before.items() if was.value != now[k].value}
        jointly: tuple[str, ...] = ()
    else:
        values, jointly = dict(done.params), done.jointly
        for name in dict.fromkeys((*effects, *done.along)):
            show(field("adopted", f"{name}{ALONE * (name in jointly)}"))
        tell(done.findings)
    if values:
        show("[model] params:")
    for name, value in values.items():
        text = moved(before[name].value, value, before[name].unit, DIGITS)
        show(field(name, text + ALONE * (name in jointly), "  "))
    known = numbers_in(workspace)
    if changed := {name: one for name, one in known.items() if were.get(name, one) != one}:
        show("[model] effects:")
    for name, (value, unit) in changed.items():
        show(field(name, moved(were[name][0], value, unit, DIGITS), "  "))
    if isinstance(done, Undone):
        show(field("adopted", ", ".join(str(one["name"]) for one in done.effects) or "none"))
    show(f"\n{next_line(done.then)}")
