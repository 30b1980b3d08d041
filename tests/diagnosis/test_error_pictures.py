"""Figures of prediction errors."""

from grounded.diagnosis.error_report import RulerRow
from grounded.diagnosis.parts import Diagnosis, Verdict
from grounded.diagnosis.telling import accuracy_figure


def test_the_error_over_whole_trials_is_no_error_at_a_horizon():
    def row(seconds, error, whole=False):
        return RulerRow(seconds, whole, {"x": "m"}, crude={"x": error}, with_effects={"x": error})

    rows = (row(0.5, 1.0), row(1.0, 2.0), row(2.0, 0.3, whole=True))
    (panel,) = accuracy_figure(Diagnosis(Verdict("none"), prediction_error=rows)).panels
    line, apart = panel.curves
    assert ([*line["x"]], [*line["y"]]) == ([0.5, 1.0], [1.0, 2.0])
    assert (apart["mode"], [*apart["y"]], line["name"]) == ("markers", [0.3], apart["name"])
    assert "whole trial" in apart["hovertemplate"]
    assert panel.layout["xaxis"]["ticktext"] == ["0.5", "1", "whole<br>trial"]
    assert panel.layout["xaxis"]["ticklabeloverflow"] == "allow"  # it was hidden at the edge
    (alone,) = accuracy_figure(Diagnosis(Verdict("none"), prediction_error=rows[2:])).panels
    assert alone.layout["xaxis"]["ticktext"] == ["whole<br>trial"] and len(alone.curves) == 1
