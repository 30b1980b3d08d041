"""grounded ingest, next: store logs of the real system, and go on from them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import click

from grounded.errors import NextCommand
from grounded.result import listed
from grounded_cli.console import completion as complete
from grounded_cli.console.options import as_json, values_by_name
from grounded_cli.console.options import details as all_findings
from grounded_cli.console.terminal import (
    field,
    number,
    progress,
    remark,
    sentence,
    show,
    show_json,
    table,
    tell,
)
from grounded_cli.console.workspace_option import in_workspace, next_line, open_workspace
from grounded_trials.wording import extent, with_unit

if TYPE_CHECKING:
    from grounded.model import Model
    from grounded.search.candidate import Tried
    from grounded_trials import Workspace
    from grounded_trials.workspace.intake.ingest import Ingested

CLOCKS = {"header": "header stamps", "log": "log times", "publish": "publish times"}
MOST = 3  # findings that are told without --details
TABLE = "/csv."  # before the columns of a table, in the path of a signal
AGAIN, ASIDE = "run again", "set aside"  # verdicts
BEGUN = "in doubt for its start"  # a verdict "in doubt" that another run of the same one settles
BEST = ("better", "maybe better")  # verdicts on what was the best when its run arrived
# verdict -> what it means for the search
VERDICTS = {
    "first": ": what the search improves on",
    "better": ": the best so far",
    "maybe better": ": the best so far, but by no more than runs may scatter",
    "no better": " than the best so far",
    "crashed": ": it did not run to the end",
    "waiting": ": more trials of it are needed ([search] repeats)",
    "in doubt": ": it may be bad luck, the best so far is run once more",
    BEGUN: ": by the model where it began explains much of that, and it is run once more",
    "probe": ", for the diagnosis: the search ignores it",
    ASIDE: ": it does not count",
    AGAIN: ": the candidate counts with the mean of its runs",
}


@click.command("ingest")
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option(
    "--candidate", metavar="ID", shell_complete=complete.candidates, help="Which candidate was run."
)
@click.option("--data", is_flag=True, help="The log ran no candidate: for fit and diagnose only.")
@click.option(
    "--group",
    default="",
    metavar="NAME",
    help="A condition that no signal shows: wet.",
)
@click.option(
    "--before", multiple=True, metavar="U=0", help="An input before a log that begins with a step."
)
@all_findings
@in_workspace
@as_json
def command(
    files: tuple[str, ...],
    candidate: str | None,
    data: bool,
    group: str,
    before: tuple[str, ...],
    details: bool,
    json_: bool,
) -> None:
    """Check, resample and store logs of any format that `inspect` reads.

    Ingesting a file again succeeds and names the trial it is stored as. Trials written by grounded
    are stored unchanged; other logs are mapped by the [log] table (`grounded inspect LOG` prints
    one).
    """
    from pathlib import Path

    from grounded_trials.logs.log_files import logs_in

    workspace = open_workspace()
    held = values_by_name(before, "--before")
    done = []
    for name in (str(log) for file in files for log in logs_in(Path(file))):
        with progress(f"reading {name}"):
            about: Any = {"candidate": candidate, "data": data, "group": group, "before": held}
            done.append(workspace.ingest(name, **about))
        if not json_:
            _tell(name, done[-1], _best(workspace, done[-1]), workspace.base_model, details)
    if json_:
        show_json({"trials": [one.to_json() for one in done]})
    else:
        show(f"\n{next_line(done[-1].then)}")


@click.command("next")
@click.argument("log", metavar="LOG")
@click.option(
    "--candidate", metavar="ID", shell_complete=complete.candidates, help="Which candidate was run."
)
@all_findings
@in_workspace
@as_json
def following(log: str, candidate: str | None, details: bool, json_: bool) -> None:
    """Ingest a log, show the verdict, propose, and export for the robot.

    Does the same as `ingest LOG`, `propose` and `export ID --runner`; the candidate is written into
    the workspace's folder.
    """
    from grounded_cli.propose import tell_proposed

    workspace = open_workspace()
    with progress(f"reading {log} and planning"):
        done = workspace.next(log, candidate=candidate)
    if json_:
        show_json(done.to_json())
        return
    if done.proposed is None:
        _tell(log, done.taken, None, workspace.base_model, details)
        ran = done.taken.trial
        show("")
        sentence(f"nothing is proposed before {ran} is discarded; or go on with it: `propose`")
        show(next_line(done.taken.then))
        return
    best = done.proposed.standing.incumbent
    _tell(log, done.taken, best, workspace.base_model, details)
    show("")
    for path in done.removed:
        remark("note", f"{path} is deleted: {path.stem} was not run and is void")
    tell_proposed(done.proposed, last=done.exported is None)
    if done.exported is not None:
        show(field("files", f"{done.exported.file}, {done.exported.runner}", "  "))
        then = next_line(NextCommand("next", ("LOG",)))
        ran = done.exported.candidate
        show(f"\ncopy both to the robot, run {ran}, record a log, then\n{then}")


def _best(workspace: Workspace, one: Ingested) -> Tried | None:
    """Return the best candidate if it may be another than that of the log; else None."""
    if one.verdict != AGAIN and not one.known:
        return None
    from grounded_trials.workspace.candidates.search_state import standing_in

    return standing_in(workspace).incumbent


def _tell(name: str, one: Ingested, best: Tried | None, model: Model, details: bool) -> None:
    if one.known:
        sentence(f"{name} was stored before as {one.trial}: nothing is new. Its result again:")
    tell(one.findings, name, most=len(one.findings) if details else MOST)
    if not one.known:
        sentence(f"{name} is stored as {one.trial}")
    if not one.candidate:
        show(field("data", "for fit and diagnose: it is no run of a candidate of this task", "  "))
    else:
        passed = best is not None and best.candidate.id != one.candidate
        passed = passed and (one.verdict == AGAIN or (one.known and one.verdict in BEST))
        doubted = one.verdict == "in doubt" and one.to_settle == one.candidate
        meaning = VERDICTS.get(BEGUN if doubted else one.verdict, "")
        if one.then.verb == "discard":  # "it may be bad luck" would contradict the warning
            meaning = "; discard it, as the warning says, or go on with it: `propose`"
        if passed and one.verdict in BEST:
            meaning = " than those before it"
        ended = one.utility == float("-inf")
        gained = "no utility" if ended else f"utility {number(one.utility)}"
        if one.runs > 1 and number(one.mean) != number(one.utility) and math.isfinite(one.mean):
            gained += f" (mean of its {one.runs} runs: {number(one.mean)})"
        text = f"{gained}, {one.verdict}{_earlier(one) or meaning}"
        if one.verdict == "crashed" and one.then.verb == "discard":
            text = f"no utility: it ended early{meaning}"
        if one.verdict == ASIDE and ended:
            text = f"{ASIDE}{meaning}"
        if passed and best is not None:
            luck = ", perhaps by luck: see `status`" * (best.verdict() == "maybe better")
            text += f"; the best is now {best.candidate.id}, {number(best.utility)}{luck}"
        show(field(one.candidate, text, "  "))
    if one.off_target:
        show(field("off target", "; ".join(each.summary() for each in one.off_target), "  "))
    if one.signals:
        units = {**model.states, **model.inputs}
        rows = [
            (
                s.name,
                f"{s.rate_hz:.1f}",
                f"{1e3 * s.jitter_s:.1f}",
                f"{1e3 * s.largest_gap_s:.0f}",
                "-" if s.skew_s is None else f"{1e3 * s.skew_s:.1f}",
                str(s.bridged),
                with_unit(" .. ".join(f"{v:.3g}" for v in extent(s.low, s.high)), units[s.name]),
            )
            for s in one.signals
        ]
        header = ("signal", "Hz", "jitter ms", "gap ms", "skew ms", "bridged", "range")
        show(table(rows, header))
        own = {
            clock: f" ({', '.join(s.name for s in one.signals if s.clock == clock)})"
            for clock in dict.fromkeys(s.clock for s in one.signals)
        }
        called = CLOCKS
        if all(s.path.startswith(TABLE) for s in one.signals):
            called = CLOCKS | {"header": "the column of times"}
        clocks = listed(called[clock] + names * (len(own) > 1) for clock, names in own.items())
        skewed = "; skew: stamp minus log time, negative if recorded after its stamp"
        sentence(f"  Hz, jitter, gap: by {clocks}{skewed * any(s.skew_s for s in one.signals)}")


def _earlier(one: Ingested) -> str:
    """Return a text if other runs of the candidate crashed but this one did not; else ""."""
    if not one.crashed or one.trial in one.crashed:
        return ""
    return (
        f": this run completed, but {listed(one.crashed)} did not, and one incomplete run fails "
        "the candidate (`discard` removes a run that somebody stopped)"
    )
