"""All figures of a report, in reading order; those without content are left out."""

from __future__ import annotations

from grounded_trials.figures import Figure
from grounded_trials.figures_forecast import forecast_figures
from grounded_trials.figures_gap import gap_figure
from grounded_trials.figures_runs import (
    bias_figure,
    error_figure,
    input_figure,
    path_figure,
    state_figure,
)
from grounded_trials.figures_search import search_figure
from grounded_trials.findings import Findings


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
