"""grounded adopt: a diagnosed effect joins the model."""

from __future__ import annotations

import click

from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import show, show_json


@click.command("adopt")
@click.argument("effect", metavar="EFFECT")
@in_workspace
@as_json
def command(effect: str, folder: str | None, json_: bool) -> None:
    """Add an effect of the last diagnosis (`family:target`) to [model] in grounded.toml.

    The search goes on from the best policy, planned with the better model. To undo it, take the
    effect out of grounded.toml again.
    """
    workspace = open_workspace(folder)
    from grounded_trials.diagnosing import adopt_effect

    adopted = adopt_effect(workspace, effect)
    if json_:
        show_json({"effects": [dict(one) for one in adopted]})
        return
    show(f"{effect} is part of the model now ({workspace.config.file})")
    show("\nnext: grounded propose")
