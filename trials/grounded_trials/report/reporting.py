"""report: the findings of a workspace and the files that show them, in reports/.

All of reports/ may be deleted and made again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grounded.errors import GroundedError, needs
from grounded.result import Result
from grounded_trials.report.findings import Findings, Run, off_prediction, off_target, rms
from grounded_trials.report.gathering import gather
from grounded_trials.store.documents import write_document
from grounded_trials.store.store import write_atomically
from grounded_trials.wording import rendered
from grounded_trials.workspace.folder import Folder

if TYPE_CHECKING:
    from grounded.figures.figure import Figure

RECORDING, PAGE, OPTIMUM = "recording.rrd", "report.html", "optimum.json"
STAMP = "watched.svg"


@dataclass(frozen=True, eq=False, repr=False)
class Report(Result):
    """What `report` shows: the findings, and the files that were written."""

    findings: Findings
    paths: tuple[Path, ...]

    def summary(self) -> str:
        """How much it shows, and its files."""
        trials = len(self.findings.runs) + self.findings.left_runs
        return ", ".join([f"{trials} trials", *map(str, self.paths)])

    def figures(self) -> Sequence[Figure]:
        """All that the page shows."""
        from grounded_trials.report.figures.runs import all_figures

        return all_figures(self.findings)

    def to_json(self) -> dict[str, Any]:
        """The document of `report --json`, with the figures of the text by state and input."""
        findings, diagnosis = self.findings, self.findings.diagnosis
        document: dict[str, Any] = {
            "paths": {_kind(path): str(path) for path in self.paths if path.suffix != ".png"},
            "utilities": findings.standing.utilities,
            "phase": findings.standing.phase,
            "sentence": findings.standing.sentence,
            "optimum": findings.optimum,
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
        settled = findings.settled
        document["adopted"] = (
            None
            if settled is None
            else {"clauses": settled.adopted, "gained": settled.gained, "left": settled.left}
        )
        return document


def _kind(path: Path) -> str:
    """html, rrd, foxglove or plotjuggler."""
    name, _, layout = path.stem.partition("-")
    return name if layout else path.suffix[1:]


def _measures(findings: Findings, run: Run | None) -> dict[str, Any] | None:
    """How far a run was from its target, from its prediction and from the model's, by state."""
    if run is None:
        return None
    task = findings.task
    measures = {
        "tracking_error": rms(off_target(findings, run)),
        "prediction_error": rms(off_prediction(findings, run)),
        "bias_rate": rms(run.residual) / task.dt,
    }
    return {"candidate": run.candidate.id, "utility": run.utility} | {
        name: dict(zip(task.model.state_names, map(float, values), strict=True))
        for name, values in measures.items()
    }


def report_in(workspace: Folder, *, html: bool, png: bool, rrd: bool) -> Report:
    """The findings, and the files that were asked for, see `Workspace.report`."""
    for module, asked, extra in (
        ("jinja2", html, "report"),
        ("matplotlib", png, "png"),
        ("rerun", rrd, "view"),
    ):
        if asked:
            needs(module, extra)
    findings, paths = gather(workspace), []
    if html:
        paths.append(save_page(workspace, findings))
    if png:
        paths += save_pictures(workspace, findings)
    if rrd:
        paths.append(save_recording(workspace, findings))
    if html or rrd:
        paths += save_layouts(workspace, findings)
    return Report(findings, tuple(paths))


def save_recording(workspace: Folder, findings: Findings | None = None) -> Path:
    """reports/recording.rrd for the Rerun viewer."""
    from grounded_trials.report.recording.recording import write_recording

    path = _place(workspace) / RECORDING
    write_recording(findings or gather(workspace), path)
    return path


def save_layouts(workspace: Folder, findings: Findings) -> tuple[Path, Path]:
    """The layouts in reports/ that show a trial in Foxglove and in PlotJuggler."""
    from grounded_trials.report.layouts import write_layouts

    return write_layouts(_place(workspace), findings.task.model)


def save_page(workspace: Folder, findings: Findings, watched: int = 0) -> Path:
    """reports/report.html; where it is `watched`, a revision beside it that makes it reload.

    A page from a file may load pictures from beside it, but no data: the revision is the width of
    an empty picture.
    """
    from grounded_trials.report.page.page import page

    path = _place(workspace) / PAGE
    write_atomically(path, page(findings, watched).encode())
    if watched:
        stamp = f'<svg xmlns="http://www.w3.org/2000/svg" width="{watched}" height="1"/>'
        write_atomically(path.with_name(STAMP), stamp.encode())
    return path


def watched(
    workspace: Folder, every: float, trouble: Callable[[GroundedError], None]
) -> Iterator[Report]:
    """Writes the page now and whenever a file that it shows has changed, see `Workspace.watch`."""
    before: object = None
    revision = int(time.time()) % 30_000
    while True:
        now = _changed(workspace)
        if now != before:
            before, revision = now, revision % 30_000 + 1
            try:
                workspace.forget()
                findings = gather(workspace)
                yield Report(findings, (save_page(workspace, findings, revision),))
            except GroundedError as error:
                trouble(error)
        time.sleep(every)


def _changed(workspace: Folder) -> list[tuple[str, int, int]]:
    """Names, sizes and times of the files that a page is made of."""
    found = []
    for pattern in ("*.*", "candidates/*", "trials/**/*", f"{workspace.reports.name}/*.json"):
        for path in workspace.folder.glob(pattern):
            with suppress(OSError):  # gone meanwhile
                about = path.stat()
                found.append((str(path), about.st_size, about.st_mtime_ns))
    return sorted(found)


def save_pictures(workspace: Folder, findings: Findings) -> list[Path]:
    """reports/utility.png, paths.png and so on: the figures of the page."""
    from grounded_trials.report.figures.png import png
    from grounded_trials.report.figures.runs import all_figures

    paths = []
    for figure in all_figures(findings):
        path = _place(workspace) / f"{figure.name}.png"
        write_atomically(path, png(figure))
        paths.append(path)
    return paths


def save_optimum(workspace: Folder, utility: float | None) -> None:
    """Leaves the optimum of the real system, where a study knows it, for the report to show."""
    if utility is not None:
        write_document(_place(workspace) / OPTIMUM, {"utility": utility})


def _place(workspace: Folder) -> Path:
    try:
        workspace.reports.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GroundedError(f"{workspace.reports} can't be made: {error.strerror}") from None
    return workspace.reports
