"""grounded inspect: what is in a log, what it is, and a [log] table for it."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import number, progress, remark, show, show_json, table
from grounded_trials.wording import count

if TYPE_CHECKING:
    from grounded_trials.logs.inspect_log import LogReport, TopicReport


@click.command("inspect")
@click.argument("log", metavar="LOG")
@in_workspace
@as_json
def command(log: str, folder: str | None, json_: bool) -> None:
    """Show topics, types, rates and fields of a log, and a ready-made [log] table.

    The table is guessed for the states and inputs of the workspace; `unsure` marks what to look at.
    It is left out for files of grounded's own, for damaged ones, and outside a workspace.
    """
    from grounded_trials.logs.inspect_log import inspect_log

    with progress(f"reading {log}"):
        report = inspect_log(log)
    mapping = "" if report.meta.get("format") or report.damage else _mapping(report, folder)
    if json_:
        show_json(_document(report, mapping))
        return
    what = _what(report)
    show(
        f"{', '.join(str(f) for f in report.files)}: {what}{chr(10) + '  ' if what else ''}"
        f"{count(report.messages, 'message')} in {report.duration_s:.2f} s, "
        f"written by {report.library or 'an unknown writer'}"
    )
    for topic in report.topics:
        _tell(topic)
    for one in report.remarks:
        remark("note", one)
    if mapping:
        show(f"\n# for grounded.toml; look at what is marked unsure\n{mapping}")
    show(f"{'' if mapping else chr(10)}{_next(report, log, bool(mapping))}")


def _tell(topic: TopicReport) -> None:
    show(f"\n{topic.topic}  {topic.type} ({topic.encoding})")
    rate = (
        f", {topic.rate_hz:.1f} Hz, jitter {1e3 * topic.jitter_s:.1f} ms, largest gap "
        f"{topic.largest_gap_s:.3f} s"
    )
    show(f"  {count(topic.messages, 'message')}{rate * (topic.messages > 1)}")
    if topic.skew_s is not None:
        side = "before" if topic.skew_s < 0 else "after"
        show(f"  header stamps {1e3 * abs(topic.skew_s):.1f} ms {side} the log's own times")
    if topic.problem:
        show(f"  can't be read: {topic.problem}")
    rows = [(f"  {f.path}", number(f.low), number(f.high)) for f in topic.fields]
    if rows:
        show(table(rows, ("  field", "low", "high")))


def _what(report: LogReport) -> str:
    """What a file is, where it says so itself."""
    from grounded_trials.store.own_files import CANDIDATE, TRIAL

    damaged = "DAMAGED" * bool(report.damage)
    comma = ", " * bool(damaged)
    form, ran = report.meta.get("format", ""), report.meta.get("candidate", "")
    if form == TRIAL:
        return f"{damaged}{comma}a trial{f' of {ran}' * bool(ran)} that grounded wrote"
    if form == CANDIDATE:
        return f"{damaged}{comma}a candidate: the policy to run, not a trial"
    return damaged


def _next(report: LogReport, log: str, mapped: bool) -> str:
    """What to do with the file."""
    from grounded_trials.store.own_files import CANDIDATE, TRIAL

    quoted = shlex.quote(log)
    if report.damage:
        return f"next: grounded recover {quoted if len(report.files) == 1 else 'FILE'}"
    form = report.meta.get("format", "")
    if form == TRIAL and Path(log).resolve().parent.name == "trials":
        return "it is stored already, and needs no [log] table\nnext: grounded report"
    if form == TRIAL:
        return f"it needs no [log] table\nnext: grounded ingest {quoted}"
    if form == CANDIDATE:
        return f"next: grounded run {Path(log).stem}"
    if mapped:
        return f"# next: put this table into grounded.toml, then: grounded ingest {quoted}"
    return f"next: grounded -C WORKSPACE inspect {quoted}"


def _mapping(report: LogReport, folder: str | None) -> str:
    from grounded.errors import GroundedError
    from grounded_trials.logs.inspect_guess import guess_mapping, is_simulated, mapping_toml

    try:
        model = open_workspace(folder).base_model
    except GroundedError as error:
        why = f": {error}"
        if "does not exist: this is not a workspace" in why:
            why = " outside a workspace (-C DIR names one)"
        remark("note", f"no [log] table is guessed{why}")
        return ""
    states, inputs = guess_mapping(report, model.state_names, model.input_names)
    return mapping_toml(states, inputs, simulated=is_simulated(report))


def _document(report: LogReport, mapping: str) -> dict[str, Any]:
    return {
        "files": [str(f) for f in report.files],
        "format": report.meta.get("format") or None,
        "library": report.library,
        "duration_s": report.duration_s,
        "messages": report.messages,
        "topics": [vars(t) | {"fields": [vars(f) for f in t.fields]} for t in report.topics],
        "remarks": list(report.remarks),
        "damage": report.damage,
        "log_table": mapping,
    }
