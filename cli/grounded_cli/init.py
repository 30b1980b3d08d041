"""grounded init: a workspace from an example, or from a model alone."""

from __future__ import annotations

import shlex

import click

from grounded_cli import completion as complete
from grounded_cli.options import as_json
from grounded_cli.terminal import show, show_json


@click.command("init")
@click.argument("folder", metavar="DIR", required=False)
@click.option(
    "--example",
    "name",
    metavar="NAME",
    shell_complete=complete.examples,
    help="Which example (see --list).",
)
@click.option(
    "--blank",
    metavar="MODEL.py",
    type=click.Path(exists=True, dir_okay=False),
    help="No example: your model, a target and weights to fill in, drive.py for your robot.",
)
@click.option("--list", "list_", is_flag=True, help="List the examples.")
@as_json
def command(
    folder: str | None, name: str | None, blank: str | None, list_: bool, json_: bool
) -> None:
    """Make a workspace in DIR: grounded.toml, model.py, target.csv, trials/, candidates/.

    real.py stands in for your robot; replace [system] in grounded.toml when you have one.
    """
    if list_:
        from grounded_trials.workspace.examples import EXAMPLES

        if json_:
            show_json({"examples": {key: value.text for key, value in EXAMPLES.items()}})
        else:
            show("\n".join(f"{key:15} {value.text}" for key, value in EXAMPLES.items()))
        return
    if folder is None or (name is None) == (blank is None):
        raise click.UsageError(
            "give a folder and either an example or a model: grounded init DIR --example car-turn "
            "(`grounded init --list` names them), or grounded init DIR --blank model.py"
        )
    from grounded_trials import Workspace

    Workspace.create(folder, example=name or "", blank=blank)
    if json_:
        show_json({"workspace": folder, "example": name, "blank": blank})
        return
    where = f"cd {shlex.quote(folder)} && " * (folder != ".")
    if blank:
        show(f"{folder} is a workspace for the model of {blank}. Yours to fill in:")
        show("  grounded.toml  dt, start, weights, limits")
        show("  target.csv     what the states are to do")
        show("  drive.py       measure() and send() of your robot")
        show(f"\nnext: edit these, then {where}grounded propose")
        return
    files = [
        ("grounded.toml", "the task: target, reward, limits, search"),
        ("model.py", "the crude model, plain NumPy"),
        ("target.csv", "what the states are to do"),
        ("real.py", "a simulated real system, in place of your robot"),
    ]
    show(f"{folder} is a workspace for {name}:")
    show("\n".join(f"  {a:14} {b}" for a, b in files))
    show(f"\nnext: {where}grounded propose")
