"""grounded demo: a whole example in an empty folder."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from grounded_cli.learn import learn_in
from grounded_cli.options import as_json
from grounded_cli.status import summary
from grounded_cli.terminal import field, number, progress, say, show, show_json
from grounded_trials.wording import count

if TYPE_CHECKING:
    from grounded_trials.workspace.folder import Workspace


@click.command("demo")
@click.argument("name", metavar="[NAME]", default="car-figure8")
@click.option("--dir", "folder", metavar="DIR", help="Default: demo-NAME in the current folder.")
@as_json
def command(name: str, folder: str | None, json_: bool) -> None:
    """Learn an example's manoeuvre on its simulated real system, diagnose the gap, report.

    `grounded init --list` lists the examples. The optimum is found afterwards with the TRUE model,
    which the search never sees.
    """
    from grounded.errors import GroundedError
    from grounded_trials.report.reporting import save_optimum
    from grounded_trials.workspace.examples import example, write_example
    from grounded_trials.workspace.folder import Workspace

    example(name)
    target = Path(folder or f"demo-{name}")
    if target.exists() and any(target.iterdir()):
        raise GroundedError(f"{target} is not empty: name another folder with --dir, or remove it")
    write_example(target, name)
    workspace = Workspace(target)
    say(f"workspace {target}: {name}, a crude model and a simulated real system\n")
    standing = learn_in(workspace)
    optimum = _optimum(workspace)
    save_optimum(workspace, optimum)
    verdict = _diagnosis(workspace)
    paths = _report(workspace)
    document = {
        "workspace": str(target),
        "utilities": standing.utilities,
        "trials": standing.trials,
        "phase": standing.phase,
        "optimum": optimum,
        "verdict": verdict,
        "paths": paths,
    }
    if json_:
        show_json(document)
        return
    say("")
    show(summary(standing))
    _tell(document)


def _tell(document: dict[str, Any]) -> None:
    first, last = document["utilities"][0], document["utilities"][-1]
    gain = f"{100 * (1 - last / first):.1f} % better after {count(document['trials'], 'trial')}"
    show(
        "\n"
        + field("learned", f"{number(first)} by the model's own policy, {number(last)} now: {gain}")
    )
    if document["optimum"] is not None:
        known = "planned with the true model, which the search never saw"
        show(field("optimum", f"{number(document['optimum'])}, {known}"))
    show(field("gap", document["verdict"]["sentence"]))
    for kind, path in document["paths"].items():
        show(field(kind, path))
    verb = "view" if "rrd" in document["paths"] else "report"
    show(f"\nnext: grounded -C {shlex.quote(document['workspace'])} {verb}")


def _optimum(workspace: Workspace) -> float | None:
    from grounded_trials.workspace.running import optimum

    with progress("finding the optimum with the true model"):
        return optimum(workspace)


def _diagnosis(workspace: Workspace) -> dict[str, Any] | None:
    from grounded_trials.workspace.diagnosing import diagnose_in

    with progress("diagnosing the gap"):
        return dict(diagnose_in(workspace).document["verdict"])


def _report(workspace: Workspace) -> dict[str, str]:
    from grounded_cli.report import write_all

    with progress("writing the report"):
        return write_all(workspace)
