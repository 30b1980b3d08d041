"""All figures of a report, in reading order; those without content are left out."""

from __future__ import annotations

from grounded_trials.report.figures.figure import Figure
from grounded_trials.report.figures.gap import forecast_figures, gap_figure
from grounded_trials.report.figures.runs import (
    bias_figure,
    error_figure,
    input_figure,
    path_figure,
    state_figure,
)
from grounded_trials.report.figures.utilities import search_figure
from grounded_trials.report.findings import Findings


def all_figures(findings: Findings) -> list[Figure]:
    """What the page shows, for files."""
    made = [
        search_figure(findings),
        path_figure(findings),
        state_figure(findings),
        error_figure(findings),
        input_figure(findings),
        bias_figure(findings),
        gap_figure(findings.diagnosis),
        *forecast_figures(findings),
    ]
    return [figure for figure in made if figure is not None]
