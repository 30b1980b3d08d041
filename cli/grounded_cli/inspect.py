"""grounded inspect: show the contents of a log, and a [log] table for it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from grounded_cli.console.terminal import names_in, number, progress, remark, show, table
from grounded_cli.console.workspace import given, next_line, typed
from grounded_trials.formats.tables import Layout
from grounded_trials.logs.inspection.inspect_log import FieldReport, TopicReport
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
