"""grounded inspect: what is in a log, and a [log] table for it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import number, progress, say, show, show_json, table

if TYPE_CHECKING:
    from grounded_trials.inspect_log import LogReport


@click.command("inspect")
@click.argument("log", metavar="LOG")
@in_workspace
@as_json
def command(log: str, folder: str | None, json_: bool) -> None:
    """Show topics, types, rates and fields of a log, and a ready-made [log] table.

    The table is guessed for the states and inputs of the workspace; `unsure` marks what to look at.
    Outside a workspace the table is left out.
    """
    from grounded_trials.inspect_log import inspect_log

    with progress(f"reading {log}"):
        report = inspect_log(log)
    mapping = _mapping(report, folder)
    if json_:
        show_json(_document(report, mapping))
        return
    show(
        f"{', '.join(str(f) for f in report.files)}: {report.messages} messages in "
        f"{report.duration_s:.2f} s, written by {report.library or 'an unknown writer'}"
    )
    for topic in report.topics:
        show(f"\n{topic.topic}  {topic.type} ({topic.encoding})")
        skew = "" if topic.skew_s is None else f", header - log {1e3 * topic.skew_s:.1f} ms"
        show(
            f"  {topic.messages} messages, {topic.rate_hz:.1f} Hz, jitter "
            f"{1e3 * topic.jitter_s:.1f} ms, largest gap {topic.largest_gap_s:.3f} s{skew}"
        )
        if topic.problem:
            show(f"  can't be read: {topic.problem}")
        rows = [(f"  {f.path}", number(f.low), number(f.high)) for f in topic.fields]
        if rows:
            show(table(rows, ("  field", "low", "high")))
    for remark in report.remarks:
        say(f"note: {remark}")
    if mapping:
        show(f"\n# for grounded.toml\n{mapping}")


def _mapping(report: LogReport, folder: str | None) -> str:
    from grounded.errors import GroundedError
    from grounded_trials.inspect_guess import guess_mapping, is_simulated, mapping_toml

    try:
        model = open_workspace(folder).base_model
    except GroundedError as error:
        say(f"note: no [log] table is guessed: {error}")
        return ""
    states, inputs = guess_mapping(report, model.state_names, model.input_names)
    return mapping_toml(states, inputs, simulated=is_simulated(report))


def _document(report: LogReport, mapping: str) -> dict[str, Any]:
    return {
        "files": [str(f) for f in report.files],
        "library": report.library,
        "duration_s": report.duration_s,
        "messages": report.messages,
        "topics": [vars(t) | {"fields": [vars(f) for f in t.fields]} for t in report.topics],
        "remarks": list(report.remarks),
        "damage": report.damage,
        "log_table": mapping,
    }
