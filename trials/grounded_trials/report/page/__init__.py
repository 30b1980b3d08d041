"""report.html: one self-contained page that needs no network and runs only its own scripts.

Read `page` first, then `page.html`, the template with its sections. Names and texts from files are
never markup: the template escapes them, and a content security policy allows only the two scripts
whose hashes the page states. The page holds the figures as data; `page.js` draws each with
Plotly when it comes into view. `plotly-basic.min.js` is Plotly's smallest bundle, unchanged (npm:
plotly.js-basic-dist-min 4.1.1, MIT). It is a quarter of the size of the bundle in the Python
package, so that pages open fast.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from grounded.diagnosis.telling import (
    FINDINGS,
    effect_table,
    instrument_lines,
    sentence,
)
from grounded.diagnosis.telling import error_table as held_out_table
from grounded.errors import NextCommand, needs
from grounded.figures import PALETTE, Panel, typeset
from grounded.result import begun
from grounded.search.difference import last_gain
from grounded_trials.report.figures.runs import all_figures
from grounded_trials.report.findings import Findings
from grounded_trials.report.tables import (
    Table,
    about,
    candidate_table,
    counted,
    error_table,
    improved,
    parameter_table,
)
from grounded_trials.wording import glued, legend, placed, rendered
from grounded_trials.workspace.next_step import DIAGNOSE


def page(findings: Findings) -> str:
    """Return the HTML of the report.

    Raises:
        GroundedError: if Jinja2 is not installed.
    """
    needs("jinja2", "report")
    from jinja2 import Environment

    jinja = Environment(autoescape=True, finalize=typeset, trim_blocks=True, lstrip_blocks=True)
    jinja.filters["glued"] = lambda text: _unbroken(placed(str(text), findings.folder))
    jinja.filters["words"] = _words
    scripts = [_own("plotly-basic.min.js"), _own("page.js")]
    panels: list[dict[str, Any]] = []

    def number(panel: Panel) -> int:
        panels.append(_plain({"kind": panel.kind, "data": panel.data, "layout": panel.layout}))
        return len(panels) - 1

    def data() -> str:  # called after all panels have been numbered
        text = json.dumps({"panels": panels, "colours": PALETTE}, allow_nan=False)
        return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")

    found, gain = findings.diagnosis, last_gain(findings.history)
    diagnosed = []
    if found is not None and not found.no_cause:  # with too little data, what was fitted is nothing
        diagnosed = [
            ("Errors of held-out predictions", "held-out", Table(*held_out_table(found))),
            ("Effects that were compared", "effects", Table(*effect_table(found))),
        ]
    candidates, left = candidate_table(findings)
    return jinja.from_string(_own("page.html")).render(
        findings=findings,
        about=about(findings),
        tiles=counted(findings),
        improved=improved(findings),
        diagnose=rendered(DIAGNOSE, findings.folder),
        said=findings.told,
        odd=[] if found is None else instrument_lines(found.preflight),
        most=FINDINGS,
        sentence=sentence,
        figures={one.name: one for one in all_figures(findings)},
        errors=error_table(findings),
        gain=begun(gain.to_finding().sentence) if gain else "",
        candidates=candidates,
        left=left,
        legend=begun(legend("", [t.candidate.iteration for t in findings.history])),
        status=rendered(NextCommand("status"), findings.folder),
        diagnosed=diagnosed,
        parameters=parameter_table(findings),
        style=_own("page.css") + _roles(),
        scripts=scripts,
        hashes=[_hash(script) for script in scripts],
        number=number,
        data=data,
    )


def _unbroken(text: str) -> Any:
    """Return markup in which no quantity (0.05 kg, 1e-05) is broken; text in ` becomes code."""
    from markupsafe import Markup, escape

    parts = str(text).split("`")
    if len(parts) % 2 == 0:  # an unmatched backtick
        parts = [str(text)]
    for k, part in enumerate(parts):
        if k % 2:
            parts[k] = f"<code>{_words(part)}</code>"
        else:
            plain = re.sub(r"-(?=\d)|\|", "\\g<0>\u2060", glued(part))
            parts[k] = str(escape(typeset(plain)))
    return Markup("".join(parts))


def _words(command: str) -> Any:
    """Return markup in which a line is broken between the words of a command, not at hyphens."""
    from markupsafe import Markup, escape

    return Markup(" ".join(f"<span>{escape(word)}</span>" for word in command.split(" ")))


@cache
def _own(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _hash(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def _plain(value: Any) -> Any:
    """Pack arrays, and convert NumPy numbers to Python's, in nested data."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):  # as Plotly's JSON has typed ones, NaN if not finite
        numbers = np.where(np.isfinite(value), value, np.nan).astype("<f4")
        return {"dtype": "f4", "bdata": base64.b64encode(numbers.tobytes()).decode()}
    return float(value) if isinstance(value, np.floating) else typeset(value)


def _roles() -> str:
    """Return the style of the roles' colours, light and dark; print uses light."""
    light, dark = (
        "".join(f".{role}{{--c:{pair[k]}}}" for role, pair in PALETTE.items()) for k in (0, 1)
    )
    return f"{light}@media screen and (prefers-color-scheme: dark){{{dark}}}"
