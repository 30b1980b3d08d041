"""Numbers that no picture was made for: reports are made all the same, without NaN in them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from grounded_cli.report import report_text
from grounded_trials.report.figures.png import png
from grounded_trials.report.figures.runs import all_figures
from grounded_trials.report.gathering import RUNAWAY
from grounded_trials.report.page import page
from reported import car, gathered

__all__ = ["car"]


def _jump(states):
    states[15:], states[16::2] = 1e300, -1e300


CASES = {
    "huge": lambda s: s.fill(1e200),
    "jumps": _jump,
    "zero": lambda s: s.fill(0.0),
    "infinite": lambda s: s[10:].fill(np.inf),
    "unknown": lambda s: s.fill(np.nan),
    "tiny": lambda s: s.fill(1e-300),
    "constant": lambda s: s.fill(1e12),
    "offset": lambda s: np.copyto(s, 1e9 + 1e-3 * np.random.default_rng(0).random(s.shape)),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@pytest.mark.extra("view", "png")
def test_a_report_is_made_of_any_numbers(car, tmp_path, case):
    from grounded_trials.report.recording import write_recording

    findings, runs = gathered(car), []
    for run in findings.runs:
        states = np.array(run.trial.states)
        CASES[case](states)
        states[np.abs(states) > RUNAWAY] = np.nan  # as they are gathered
        runs.append(replace(run, trial=replace(run.trial, states=states)))
    findings = replace(findings, runs=tuple(runs))
    head, data = page(findings).split('id="data">')
    assert "nan" not in head.split("<style>")[0].lower() + head.split("</style>")[1].lower()
    assert json.loads(data.split("</script>")[0])["panels"]
    figure = all_figures(findings)[1 + list(CASES).index(case) % 2]  # the paths, the states
    assert len(png(figure)) > 1000
    write_recording(findings, tmp_path / "r.rrd")
    assert "next: grounded" in report_text(findings)
