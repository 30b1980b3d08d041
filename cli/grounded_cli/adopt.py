"""grounded adopt: a diagnosed effect joins the model."""

from __future__ import annotations

import click

from grounded_cli import completion as complete
from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import field, number, show, show_json


@click.command("adopt")
@click.argument("effect", metavar="EFFECT", shell_complete=complete.effects)
@click.option("--effect-only", is_flag=True, help="Leave the model's own parameters alone.")
@in_workspace
@as_json
def command(effect: str, effect_only: bool, folder: str | None, json_: bool) -> None:
    """Add an effect of the last diagnosis (`family:target`) to [model] in grounded.toml.

    Parameters that were calibrated beside it come along.

    The search goes on from the best policy, planned with the better model. To undo it, take the
    effect out of grounded.toml again.
    """
    workspace = open_workspace(folder)
    from grounded_trials.diagnosing import adopt_effect

    adopted, params = adopt_effect(workspace, effect, parameters=not effect_only)
    if json_:
        show_json({"effects": [dict(one) for one in adopted], "params": params})
        return
    show(f"{effect} is part of the model now ({workspace.config.file})")
    before = workspace.base_model.params
    changed = {n: v for n, v in params.items() if abs(v - before[n].value) > 1e-6 * abs(v)}
    if changed:
        show("the model's own parameters, calibrated beside it:")
    for name, value in changed.items():
        show(field(name, f"{number(before[name].value)} -> {number(value)}", "  "))
    show("\nnext: grounded propose")
