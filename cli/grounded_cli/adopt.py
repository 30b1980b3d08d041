"""grounded adopt: diagnosed effects join the model."""

from __future__ import annotations

import click

from grounded_cli import completion as complete
from grounded_cli.options import as_json, in_workspace, next_line, open_workspace
from grounded_cli.terminal import field, number, remark, sentence, show, show_json
from grounded_trials.wording import with_unit

UNCLAIMED = (
    "was not claimed by the last diagnosis: its values were fitted by themselves, in place of what "
    "was claimed; the model's own parameters stay as they are"
)
BESIDE = (
    "was adopted from the same diagnosis, and stays in the model: its values were fitted in place "
    "of these, not beside them. Take it out of [model] effects in grounded.toml, or diagnose again"
)


@click.command("adopt")
@click.argument(
    "effects", nargs=-1, required=True, metavar="EFFECT...", shell_complete=complete.effects
)
@click.option("--effect-only", is_flag=True, help="Leave the model's own parameters alone.")
@in_workspace
@as_json
def command(effects: tuple[str, ...], effect_only: bool, json_: bool) -> None:
    """Add effects of the last diagnosis (`family:target`) to [model] in grounded.toml.

    Effects that were claimed together were estimated together: adopt them together. Parameters of
    the model that were calibrated beside them come along, in [model] params. An effect that was
    not claimed can be adopted by itself: its values come without parameters.

    The search goes on from the best policy, planned with the better model. To undo it, take the
    effects out of [model] effects and the parameters that were printed out of [model] params in
    grounded.toml, or give them their old values.
    """
    workspace = open_workspace()
    before = workspace.base_model.params
    done = workspace.adopt(*effects, parameters=not effect_only)
    if json_:
        show_json(done.to_json())
        return
    for name in dict.fromkeys(effects):
        sentence(f"{name} is part of the model now ({workspace.config.file})")
    if not done.claimed:
        remark("note", f"{effects[0]} {UNCLAIMED}")
    if done.beside:
        remark("warning", f"{', '.join(done.beside)} {BESIDE}")
    if done.params:
        show("written to [model] params, calibrated beside the effects:")
    for name, value in done.params.items():
        text = with_unit(f"{number(before[name].value)} -> {number(value)}", before[name].unit)
        show(field(name, text, "  "))
    show(f"\n{next_line(done.then)}")
