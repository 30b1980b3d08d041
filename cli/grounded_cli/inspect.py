"""grounded inspect, recover: what is in a log, and what is readable in a damaged one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from grounded.errors import NextCommand
from grounded_cli.console.options import exits
from grounded_cli.console.terminal import (
    field,
    given,
    names_in,
    next_line,
    number,
    progress,
    remark,
    say,
    show,
    table,
    typed,
)
from grounded_trials.formats.tables import Layout
from grounded_trials.logs.inspection.inspect_log import FieldReport, TopicReport
from grounded_trials.logs.recover import Recovery, recover_log
from grounded_trials.store.own_files import CANDIDATE, TRIAL
from grounded_trials.wording import count, extent
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.inspecting import Inspected, inspect_in

# constant fields of one array (an IMU's covariance has 9) that are folded into one line
FOLDED_FIELDS = 9


def inspect(log: str, columns: str | None, rate: float | None) -> Iterator[Inspected]:
    """Print topics, types, rates and fields of a log, and its [log] table."""
    layout = Layout(tuple(names_in(columns)), rate or 0.0)
    with progress(f"reading {log}"):
        found = inspect_in(Folder(given() or "."), log, layout)
    if found.why_none:
        remark("note", f"no [log] table is guessed{found.why_none}")
    yield found
    report, what = found.report, _what(found)
    show(
        f"{', '.join(str(f) for f in report.files)}: {what}{chr(10) + '  ' if what else ''}"
        f"{count(report.messages, 'message')} in {report.duration_s:.2f} s, "
        f"written by {report.library or '?'}"
    )
    for topic in report.topics:
        _tell(topic)
    for one in (*report.remarks, *found.odd):
        remark("note", one)
    if found.log_table:
        show(f"\n# for grounded.toml\n{found.log_table}")
    else:
        show()
    show(f"# next: {typed(found.then)}" if found.log_table else next_line(found.then))


def _tell(topic: TopicReport) -> None:
    show(f"\n{topic.topic}  {topic.type} ({topic.encoding})")
    rate = (
        f", {topic.rate_hz:.1f} Hz, jitter {1e3 * topic.jitter_s:.1f} ms, "
        f"gap {topic.largest_gap_s:.3f} s"
    )
    show(f"  {count(topic.messages, 'message')}{rate * (topic.messages > 1)}")
    if topic.skew_s is not None:
        side = "before" if topic.skew_s < 0 else "after"
        show(f"  header stamps {1e3 * abs(topic.skew_s):.1f} ms {side}")
    if rows := _rows(topic.fields):
        show(table(rows, ("  field", "low", "high")))


def _rows(fields: Sequence[FieldReport]) -> list[tuple[str, str, str]]:
    """Return a row per field; constants of arrays (an IMU's covariance has 9) are counted."""
    still = [
        one for one in fields if "[" in one.path and one.low is not None and one.low == one.high
    ]
    folded = still if len(still) >= FOLDED_FIELDS else []
    rows = []
    for one in fields:
        if one not in folded:
            low, high = one.low, one.high
            if low is not None and high is not None:
                low, high = extent(low, high)
            rows.append((f"  {one.path}", number(low), number(high)))
    return [*rows, *[(f"  {len(folded)} constants of arrays", "", "")] * bool(folded)]


def _what(found: Inspected) -> str:
    """Describe what a file is, if it says so itself; else ""."""
    damaged = ["DAMAGED"] * bool(found.report.damage)
    ran = found.report.meta.get("candidate", "")
    kinds = {TRIAL: f"trial{f' of {ran}' * bool(ran)}", CANDIDATE: "candidate"}
    return ", ".join(damaged + [text for form, text in kinds.items() if form == found.format])


def recover(log: str, output: str | None) -> Iterator[Recovery]:
    """Save the readable part of a damaged log."""
    source = Path(log)
    target = Path(output) if output else source.with_name(f"{source.stem}-recovered.mcap")
    with progress(f"reading {log}"):
        found = recover_log(source, target)
    exits(0 if found.complete else 3)
    yield found
    for loss in found.losses:
        say(field("lost", loss))
    if found.complete:
        show(field("lost", "nothing"))
    saved = count(sum(found.messages.values()), "message")
    show(field("saved", f"{saved} in {found.duration_s:.2f} s: {found.file}"))
    for topic, kept in found.messages.items():
        lost = found.lost_messages.get(topic, 0)
        show(f"  {topic}: {kept}" + (f", {lost} lost" if lost else ""))
    show(f"\n{next_line(_next(found))}")


def _next(found: Recovery) -> NextCommand:
    """Return what to do with the file."""
    target = str(found.file)
    if found.format == CANDIDATE:
        return NextCommand("propose")
    if found.format != TRIAL:
        return NextCommand("inspect", (target,))  # which says how it is ingested
    whole = all(one.facts.get("index") for one in found.findings)
    return NextCommand("ingest", (target,) if whole else ("--data", target))
