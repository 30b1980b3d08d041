"""grounded adopt: diagnosed effects join the model."""

from __future__ import annotations

import click

from grounded_cli import completion as complete
from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import field, number, show, show_json
from grounded_trials.words import with_unit


@click.command("adopt")
@click.argument(
    "effects", nargs=-1, required=True, metavar="EFFECT...", shell_complete=complete.effects
)
@click.option("--effect-only", is_flag=True, help="Leave the model's own parameters alone.")
@in_workspace
@as_json
def command(effects: tuple[str, ...], effect_only: bool, folder: str | None, json_: bool) -> None:
    """Add effects of the last diagnosis (`family:target`) to [model] in grounded.toml.

    Effects that were claimed together were estimated together: adopt them together. Parameters of
    the model that were calibrated beside them come along.

    The search goes on from the best policy, planned with the better model. To undo it, take the
    effects out of grounded.toml again.
    """
    workspace = open_workspace(folder)
    from grounded_trials.adopting import adopt_effects

    adopted, params = adopt_effects(workspace, effects, parameters=not effect_only)
    if json_:
        show_json({"effects": [dict(one) for one in adopted], "params": params})
        return
    for name in dict.fromkeys(effects):
        show(f"{name} is part of the model now ({workspace.config.file})")
    before = workspace.base_model.params
    changed = {n: v for n, v in params.items() if abs(v - before[n].value) > 1e-6 * abs(v)}
    if changed:
        show("the model's own parameters, calibrated beside the effects:")
    for name, value in changed.items():
        text = with_unit(f"{number(before[name].value)} -> {number(value)}", before[name].unit)
        show(field(name, text, "  "))
    show("\nnext: grounded propose")
