"""grounded demo: run a whole example in an empty folder."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

from grounded.diagnosis.telling import sentence, told
from grounded.engine import Engine, cores
from grounded.errors import NextCommand
from grounded.refusals import refused
from grounded.result import percent
from grounded_cli.console.options import command
from grounded_cli.console.terminal import (
    field,
    number,
    progress,
    remark,
    say,
    show,
    stages,
)
from grounded_cli.console.workspace_option import located, next_line
from grounded_cli.learn import narrated
from grounded_cli.status import summary
from grounded_trials import Workspace
from grounded_trials.report.reporting import save_optimum
from grounded_trials.starting.examples import example
from grounded_trials.wording import count, rendered
from grounded_trials.workspace.candidates.proposing import Status
from grounded_trials.workspace.candidates.running import optimum

EFFECTS_SOUGHT = 3  # effects that are looked for if not all trials are used: each more takes 20 s
USED_ALL_BELOW = 1.5  # times as many trials as fit into STEPS: fewer are all used
STEPS = 800  # total steps of the diagnosed trials, so that a demo ends within a minute or two


@command("demo", workspace=False)
@click.argument("name", metavar="[NAME]", default="car-figure8")
@click.option("--dir", "folder", metavar="DIR", help="Default: demo-NAME in the current folder.")
def demo(name: str, folder: str | None) -> Iterator[dict[str, Any]]:
    """Learn an example's manoeuvre on its simulated real system, diagnose the gap, report.

    `grounded init --list` lists the examples. The optimum is found afterwards with the TRUE model,
    which the search never sees.
    """
    example(name)
    target = Path(folder or f"demo-{name}")
    if target.exists() and any(target.iterdir()):
        raise refused("file.exists", target)
    workspace = Workspace.create(target, example=name)
    located(str(target))  # for the commands in its texts
    say(f"{target}: {name}\n")
    status = narrated(workspace)
    with progress("optimum"):
        best = optimum(workspace)
    save_optimum(workspace, best)
    with stages() as tell:
        tell("diagnosis")
        some, engine = _few(workspace, status), Engine(cores())
        diagnosed = workspace.diagnose(
            some, max_effects=EFFECTS_SOUGHT if some else None, engine=engine, progress=tell
        )
    with progress("report"):
        html, rrd = (find_spec(name) is not None for name in ("jinja2", "rerun"))
        report = workspace.report(html=html, rrd=rrd)
    for made, what, extra in ((html, "page", "report"), (rrd, "recording", "view")):
        if not made:
            remark("note", f"no {what}: extra `{extra}`")
    document = {
        "workspace": str(target),
        "utilities": status.standing.utilities,
        "trials": status.standing.trials,
        "phase": status.standing.phase,
        "ending": status.standing.ending or None,
        "optimum": best,
        "verdict": diagnosed.verdict.to_json(),
        "diagnosed_trials": len(diagnosed.made.trials if diagnosed.made else ()),
        "paths": report.to_json()["paths"],
    }
    yield document
    say("")
    show(summary(status))
    _tell(document, [sentence(one) for one in told(diagnosed).lines])


def _few(workspace: Workspace, status: Status) -> list[str]:
    """Choose the trials to diagnose: first, last and best, then the earliest; [] means all.

    The later ones hardly differ from the best, and leaving them out saves time.
    """
    standing, most = status.standing, max(STEPS // workspace.task.horizon, 2)
    best = standing.incumbent
    tried = [trial for one in standing.history for trial in one.trials[:1]]
    last = sorted((t for one in standing.history for t in one.trials), key=lambda t: t.id)[-1:]
    repeats = [*best.trials] if best else []  # they show how far runs scatter
    chosen = list(dict.fromkeys(one.id for one in (*tried[:1], *last, *repeats, *tried)))
    return chosen[:most] if standing.trials > USED_ALL_BELOW * most else []


def _tell(document: dict[str, Any], verdict: list[str]) -> None:
    """Print what was learned and diagnosed."""
    first, last = document["utilities"][0], document["utilities"][-1]
    gain = f"{percent(1 - last / first)} better after {count(document['trials'], 'trial')}"
    show("\n" + field("learned", f"{number(first)} at first, {number(last)} now: {gain}"))
    if document["optimum"] is not None:
        show(field("optimum", f"{number(document['optimum'])}, by the true model"))
    used, trials = document["diagnosed_trials"], document["trials"]
    if 0 < used < trials:
        verdict = [*verdict, f"Diagnosed: {used} of {trials} trials."]
    for k, line in enumerate(verdict):
        show(field("gap" if k == 0 else "", line))
    for kind, path in document["paths"].items():
        if kind in ("html", "rrd"):
            show(field(kind, path))
    if "rrd" in document["paths"]:
        show(f"\n{next_line(NextCommand('view'))}")
    else:
        show(f"\nnext: {rendered(NextCommand('init', ('robot', '--from', 'LOG')))}")
