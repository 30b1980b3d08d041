"""report.html: one page with everything, that needs no network and runs no script but its own.

What a name or a file says is text, never markup: it is escaped, and a content security policy
allows only the one script whose hash the page states.
"""

from __future__ import annotations

import base64
import hashlib
import math
from html import escape
from importlib.resources import files

from grounded_trials.report.figures.runs import (
    bias_figure,
    error_figure,
    input_figure,
    path_figure,
    state_figure,
)
from grounded_trials.report.figures.utilities import search_figure
from grounded_trials.report.findings import Findings
from grounded_trials.report.page.page_diagnosis import gap_section, verdict_block
from grounded_trials.report.page.page_tables import (
    candidate_table,
    channel_table,
    command,
    error_table,
    figure_block,
    parameter_table,
    role_styles,
)
from grounded_trials.wording import count, figure


def page(findings: Findings) -> str:
    """The whole document."""
    package = files(__package__)
    script = package.joinpath("page.js").read_text(encoding="utf-8")
    style = package.joinpath("page.css").read_text(encoding="utf-8") + role_styles()
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; "
        f"script-src 'sha256-{digest}'"
    )
    links = bodies = ""
    for number, (title, body) in enumerate(s for s in _sections(findings) if s[1]):
        links += f'<a href="#s{number}">{escape(title)}</a>'
        bodies += f'<section id="s{number}"><h2>{escape(title)}</h2>{body}</section>'
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(findings.name)} – grounded</title><style>{style}</style></head>"
        f"<body><main>{_head(findings)}<nav>{links}</nav>{bodies}</main>"
        f'<div id="tip" role="status"></div><script>{script}</script></body></html>\n'
    )


def _sections(findings: Findings) -> list[tuple[str, str]]:
    """Titles and bodies, in reading order; an empty body is left out."""
    return [
        ("Utility", _utility(findings)),
        ("Paths", figure_block(path_figure(findings), "two")),
        ("States", figure_block(state_figure(findings))),
        ("Tracking error", figure_block(error_figure(findings)) + error_table(findings)),
        ("Inputs", figure_block(input_figure(findings))),
        ("Bias", figure_block(bias_figure(findings))),
        ("Gap", gap_section(findings)),
        ("Task and model", _task(findings)),
        ("What to run next", _next(findings)),
    ]


def _head(findings: Findings) -> str:
    task = findings.task
    about = (
        f"{task.model.name}: {task.horizon} steps of {task.dt:g} s ({task.horizon * task.dt:g} s), "
        f"{'closed loop' if task.feedback else 'open loop'}; {findings.method}"
    )
    diagnosis = findings.diagnosis
    verdict = verdict_block(diagnosis, findings.since, short=True) if diagnosis else ""
    return (
        f'<h1>{escape(findings.name)}</h1><p class="soft">{escape(about)}</p>'
        f"{_lost(findings)}{_tiles(findings)}{verdict}"
    )


def _tiles(findings: Findings) -> str:
    first, best = findings.first, findings.best
    tiles = []
    if best is not None:
        tiles.append((figure(best.utility), f"best utility, {best.candidate.id}"))
    if first is not None:
        tiles.append((figure(first.utility), "the model’s own policy"))
    if findings.optimum is not None:
        tiles.append((figure(findings.optimum), "optimum of the real system"))
    if first is not None and best is not None and -math.inf < first.utility < 0:
        gain = 100 * (1 - best.utility / first.utility)
        tiles.append((f"{gain:.1f} %", "of the first policy’s loss is gone"))
    now, logs = findings.standing, len(findings.logs)
    if findings.history or not logs:
        better = count(now.iteration, "improvement")
        tiles.append((str(now.trials), f"trial{'s' * (now.trials != 1)}, {better}"))
    if logs:
        tiles.append((str(logs), f"log{'s' * (logs != 1)} of data"))
    tiles.append((now.phase, "phase of the search"))
    inside = "".join(
        f'<div class="tile"><b>{escape(a)}</b><span>{escape(b)}</span></div>' for a, b in tiles
    )
    return f'<div class="tiles">{inside}</div>'


def _lost(findings: Findings) -> str:
    if not findings.lost:
        return ""
    items = [f"<li><b>{escape(one.file)}</b>: {escape(one.reason)}</li>" for one in findings.lost]
    said = "<b>This report is not complete.</b> Left out: "
    return f'<div class="lost" id="lost">{said}<ul>{"".join(items)}</ul></div>'


def _utility(findings: Findings) -> str:
    if not findings.history:
        logs = count(len(findings.logs), "log")
        return f"<p>No candidate was proposed yet; {logs} of data.</p>"
    from grounded.search.certainty import last_improvement

    sure = last_improvement(findings.history)
    begun = (sure[:1].upper() + sure[1:]).replace("+-", "±")
    sentence = f"<p>{escape(begun)}.</p>" if sure else ""
    opened = " open" if len(findings.history) <= 12 else ""
    return (
        f"{figure_block(search_figure(findings))}{sentence}"
        f"<details{opened}><summary>All candidates</summary>{candidate_table(findings)}</details>"
    )


def _task(findings: Findings) -> str:
    adopted = ", ".join(findings.effects) or "none"
    words = f"Adopted effects: {adopted}. Stored trials of other tasks: {findings.others}."
    return (
        f"<p>{escape(words)}</p>{channel_table(findings)}"
        f"<details><summary>Parameters of the model</summary>{parameter_table(findings)}</details>"
    )


def _next(findings: Findings) -> str:
    parts = [f"<p>{escape(findings.standing.phase)}: {escape(findings.standing.sentence)}.</p>"]
    if findings.diagnosis is not None and findings.diagnosis.next_trial:
        parts.append(f"<p>To learn more: {escape(findings.diagnosis.next_trial)}</p>")
    parts.append(f"<p>{command(findings.next_command, 'c-next')}</p>")
    return "".join(parts)
