"""Figures of prediction errors."""

from grounded.diagnosis.error_report import RulerRow
from grounded.diagnosis.parts import Diagnosis, Verdict
from grounded.diagnosis.pictures import accuracy_figure
from grounded.figures.interactive import plotted


def test_the_error_over_whole_trials_is_no_error_at_a_horizon():
    def row(seconds, error, whole=False):
        return RulerRow(seconds, whole, {"x": "m"}, crude={"x": error}, with_effects={"x": error})

    rows = (row(0.5, 1.0), row(1.0, 2.0), row(2.0, 0.3, whole=True))
    (panel,) = accuracy_figure(Diagnosis(Verdict("none"), prediction_error=rows)).panels
    line, apart = panel.curves
    assert (line.style, list(line.x), list(line.y)) == ("line", [0.5, 1.0], [1.0, 2.0])
    assert (apart.style, list(apart.y), line.name) == ("points", [0.3], apart.name)
    assert [label for _, label in panel.x_ticks] == ["0.5", "1", "whole\ntrial"]
    drawn = plotted(panel)
    assert drawn["data"][1]["mode"] == "markers"
    assert "whole trial" in drawn["data"][1]["hovertemplate"]
    assert drawn["layout"]["xaxis"]["ticktext"][-1] == "whole<br>trial"
    assert drawn["layout"]["xaxis"]["ticklabeloverflow"] == "allow"  # it was hidden at the edge
    (alone,) = accuracy_figure(Diagnosis(Verdict("none"), prediction_error=rows[2:])).panels
    assert [label for _, label in alone.x_ticks] == ["whole\ntrial"] and len(alone.curves) == 1
