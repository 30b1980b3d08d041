"""The command report: gathers the findings of a workspace and writes the files in reports/.

All files in reports/ are derived and may be deleted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from grounded.errors import needs
from grounded.figures import Figure, typeset
from grounded.result import Result
from grounded_trials.report.figures.png import png as drawn
from grounded_trials.report.figures.runs import all_figures
from grounded_trials.report.findings import Findings, Run, measures
from grounded_trials.report.gathering import gather
from grounded_trials.report.page import page
from grounded_trials.store.store import made_folder, write_atomically
from grounded_trials.wording import rendered
from grounded_trials.workspace.folder import Folder

RECORDING, PAGE = "recording.rrd", "report.html"


@dataclass(frozen=True, eq=False, repr=False)
class Report(Result):
    """The result of `report`: the findings, and the files that were written."""

    findings: Findings
    paths: tuple[Path, ...]

    def summary(self) -> str:
        """Return the number of trials and the files."""
        return ", ".join([f"{len(self.findings.runs)} trials", *map(str, self.paths)])

    def _repr_html_(self) -> str:
        """Return the candidates, the diagnosis in three lines and the next command as HTML."""
        findings = self.findings
        lines = "".join(f"<p>{escape(typeset(line))}</p>" for line in findings.lines)
        lines += f"<p>next: <code>{escape(findings.next_command)}</code></p>"
        whole = f"<details><summary>All numbers</summary>{super()._repr_html_()}</details>"
        return f"{findings.standing._repr_html_()}{lines}{whole}"

    def figures(self) -> Sequence[Figure]:
        """Return all figures of the page."""
        return all_figures(self.findings)

    def to_json(self) -> dict[str, Any]:
        """Return the document of `report --json`, with the numbers of the text report by state."""
        findings, diagnosis = self.findings, self.findings.diagnosis
        document: dict[str, Any] = {
            "paths": {p.suffix[1:]: str(p) for p in self.paths if p.suffix != ".png"},
            "utilities": findings.standing.utilities,
            "phase": findings.standing.phase,
            "sentence": findings.standing.sentence,
            "ending": findings.standing.ending or None,
            "lost": [vars(one) for one in findings.lost],
            "next": rendered(findings.then, findings.folder),
            "model_policy": _measures(findings, findings.first),
            "best": _measures(findings, findings.best),
        }
        pictures = [str(path) for path in self.paths if path.suffix == ".png"]
        if pictures:
            document["paths"]["png"] = pictures
        if diagnosis is not None:
            verdict = {"kind": diagnosis.kind, "effects": diagnosis.effects}
            document["verdict"] = verdict | {"sentence": diagnosis.sentence}
            document["outdated"] = findings.since.sentence or None
            document["findings"] = [one.to_json() for one in diagnosis.findings]
        clauses = [f"{name}: {values}" for name, values in findings.adopted]
        document["adopted"] = {"clauses": clauses} if clauses else None
        return document


def _measures(findings: Findings, run: Run | None) -> dict[str, Any] | None:
    """Return a run's rms tracking error, prediction error and model bias, by state."""
    if run is None:
        return None
    names = findings.task.model.state_names
    return {"candidate": run.candidate.id, "utility": findings.tried_of(run).utility} | {
        what: dict(zip(names, map(float, values), strict=True))
        for what, values in measures(findings, run).items()
    }


def report_in(
    workspace: Folder, *, html: bool = False, png: bool = False, rrd: bool = False
) -> Report:
    """Report utilities, trajectories, model bias and gap of all stored trials.

    A damaged or missing file is left out and listed in `findings.lost`.

    Args:
        workspace: the workspace.
        html: write reports/report.html.
        png: write the figures of the page as reports/*.png.
        rrd: write reports/recording.rrd for the Rerun viewer.

    Raises:
        GroundedError: if an extra that one of them needs is missing; nothing is written then.
    """
    for module, asked, extra in (
        ("jinja2", html, "report"),
        ("matplotlib", png, "png"),
        ("rerun", rrd, "view"),
    ):
        if asked:
            needs(module, extra)
    findings, paths = gather(workspace), []
    files = {PAGE: page(findings).encode()} if html else {}
    if png:
        files |= {f"{figure.name}.png": drawn(figure) for figure in all_figures(findings)}
    for name, data in files.items():
        paths.append(made_folder(workspace.reports) / name)
        write_atomically(paths[-1], data)
    if rrd:
        from grounded_trials.report.recording import write_recording  # needs rerun

        paths.append(made_folder(workspace.reports) / RECORDING)
        write_recording(findings, paths[-1])
    return Report(findings, tuple(paths))
