"""Figures of prediction errors."""

from grounded.diagnosis.error_report import RulerRow
from grounded.diagnosis.pictures import accuracy_figure
from grounded.diagnosis.report import Diagnosis, Verdict
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
    (bars,) = accuracy_figure(Diagnosis(Verdict("none"), prediction_error=rows[2:])).panels
    assert bars.title == "x, whole trial"


def test_noise_of_zero_is_in_the_caption_and_not_in_the_legend():
    def figure(noise):
        rows = [
            RulerRow(
                s, False, {"x": "m"}, crude={"x": 1.0}, with_effects={"x": 0.1}, noise_floor=noise
            )
            for s in (0.5, 1.0)
        ]
        return accuracy_figure(Diagnosis(Verdict("none"), prediction_error=tuple(rows)))

    exact, noisy, unknown = figure({"x": 0.0}), figure({"x": 0.01}), figure({})
    for found in (exact, unknown):
        assert [key.role for key in found.key] == ["model", "best"]
    assert [key.role for key in noisy.key] == ["model", "best", "other"]
    assert "noise is 0" in exact.caption
    assert not any("noise is 0" in found.caption for found in (noisy, unknown))
