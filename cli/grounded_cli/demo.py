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
from grounded.search.standing import Standing
from grounded_cli.console.terminal import (
    field,
    located,
    next_line,
    number,
    progress,
    remark,
    say,
    show,
    stages,
)
from grounded_cli.learn import narrated
from grounded_cli.status import summary
from grounded_trials import Workspace
from grounded_trials.starting.examples import example
from grounded_trials.wording import count

STEPS = 1200  # steps of the trials that are diagnosed, so that a demo ends within a minute or two
EFFECTS_SOUGHT = 3  # effects that are looked for if there are more: each more takes 20 s


def demo(name: str, folder: str | None) -> Iterator[dict[str, Any]]:
    """Learn, diagnose and report an example on its simulated real system."""
    example(name)
    target = Path(folder or f"demo-{name}")
    if target.exists() and any(target.iterdir()):
        raise refused("file.exists", target)
    workspace = Workspace.create(target, example=name)
    located(click.get_current_context(), None, str(target))  # for the commands in its texts
    say(f"{target}: {name}\n")
    status = narrated(workspace)
    some, most = _few(status.standing, STEPS // workspace.task.horizon), None
    if len(some) < status.standing.trials:
        most = EFFECTS_SOUGHT
    with stages() as tell:
        tell("diagnosis")
        engine = Engine(cores())
        diagnosed = workspace.diagnose(some, max_effects=most, engine=engine, progress=tell)
    with progress("report"):
        html, rrd = (find_spec(name) is not None for name in ("jinja2", "rerun"))
        report = workspace.report(html=html, rrd=rrd)
    for made, what, extra in ((html, "page", "report"), (rrd, "recording", "view")):
        if not made:
            remark("note", f"no {what}: extra `{extra}`")
    trials, paths = status.standing.trials, report.to_json()["paths"]
    about = {"workspace": str(target), "trials": trials, "diagnosed_trials": len(some)}
    yield report.to_json() | about

    # what was learned and diagnosed
    show("\n" + summary(status))
    first, last = status.standing.utilities[0], status.standing.utilities[-1]
    gain = f"{percent(1 - last / first)} better after {count(trials, 'trial')}"
    show("\n" + field("learned", f"{number(first)} at first, {number(last)} now: {gain}"))
    verdict = [sentence(one) for one in told(diagnosed).lines]
    if len(some) < trials:
        verdict.append(f"Diagnosed: {len(some)} of {trials} trials.")
    for k, line in enumerate(verdict):
        show(field("gap" if k == 0 else "", line))
    for kind, path in paths.items():
        show(field(kind, path))
    then = NextCommand("view") if rrd else NextCommand("init", ("robot", "--from", "LOG"))
    show(f"\n{next_line(then)}")


def _few(standing: Standing, most: int) -> list[str]:
    """Choose the trials to diagnose: first, last and best, then the earliest.

    The later ones hardly differ from the best, and leaving them out saves time.
    """
    best = standing.incumbent
    every = sorted((t for one in standing.history for t in one.trials), key=lambda t: t.id)
    repeats = best.trials if best else ()  # they show how far runs scatter
    chosen = dict.fromkeys(one.id for one in (*every[:1], *every[-1:], *repeats, *every))
    return list(chosen)[: max(most, 2)]
