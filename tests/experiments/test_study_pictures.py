"""Pictures of the studies, from results made by hand: a file each that shows what it must."""

import io

import numpy as np
import pytest

from facts import holding
from grounded.errors import GroundedError
from grounded.experiments.car import CarResult, CarRun
from grounded.experiments.flight import FlightResult, FlightRun
from grounded.experiments.footnote9 import Footnote9Result, Footnote9Row
from grounded.experiments.theorem1 import Theorem1Result, Theorem1Row
from grounded.figures.figure import Bars
from grounded.figures.interactive import plotted
from grounded_cli.experiment import STUDIES
from grounded_trials.report.study_pictures import PICTURES, draw_study

ANGLE = np.linspace(0, 2 * np.pi, 61)
LOOP = np.column_stack([40 * np.sin(ANGLE), 40 * np.cos(ANGLE), 0 * ANGLE])


def flown(seed, off):
    paths = {"model": (LOOP + off).tolist(), "learned": LOOP.tolist()}
    return FlightRun(seed, False, (-9e3, -2e3, -1900.0), 3, (1.0, 1.0, 1.0), paths)


def driven(name, noisy, iterations):
    paths = {"target": LOOP[:, :2].tolist()}
    for i in range(iterations + 1):
        paths[f"iteration {i}"] = (LOOP[:, :2] * (1 + 0.1 / (1 + i))).tolist()
    return CarRun(name, 0, noisy, (-9.0, -1.0), (-9.0, -1.0), -0.9, 4, (1.0,), paths)


def results():
    cars = [driven("turn", True, 5), driven("circle", False, 2), driven("figure8", True, 0)]
    theorem = [
        Theorem1Row(e, s, e * (1 + s), (e * (1 + s)) ** 2, 2.0, 9)
        for e in (0.01, 0.1)
        for s in (0, 1)
    ]
    return {
        "flight": FlightResult((flown(0, 1.0), flown(1, 2.0)), -1826.0, LOOP.tolist()),
        "car": CarResult(tuple(cars)),
        "footnote9": Footnote9Result((Footnote9Row(5.0, 1e-11, 1.0, 2, 1e-11, 21),)),
        "theorem1": Theorem1Result(tuple(theorem)),
    }


def test_every_study_has_its_picture():
    assert set(PICTURES) == set(STUDIES) == set(results())


@pytest.mark.slow
@pytest.mark.extra("png")
@pytest.mark.parametrize("name", ["flight", "theorem1"])
def test_the_picture_holds_its_figure(name, tmp_path):
    from PIL import Image

    path = tmp_path / "made" / f"{name}.png"
    draw_study(name, results()[name], path)
    with Image.open(io.BytesIO(path.read_bytes())) as image:
        assert image.format == "PNG" and image.width >= 900
        levels = np.asarray(image.convert("L"))
    assert 0.005 < np.mean(levels < 250) < 0.5
    for panel in PICTURES[name](results()[name]).panels:
        traces = plotted(panel)["data"]
        if isinstance(panel, Bars):
            assert len(traces[0]["x"]) == len(panel.bars) > 0
        else:
            marks = [len(trace["x"]) for trace in traces if trace["mode"] == "markers"]
            assert len(traces) - len(marks) == len(panel.curves) > 0
            assert sum(marks) == len(panel.dots)


@pytest.mark.extra("png")
def test_a_study_without_a_picture_and_a_place_without_room_are_told(tmp_path):
    with pytest.raises(GroundedError, match=holding("'taxi'", "car")):
        draw_study("taxi", None, tmp_path / "a.png")
    (tmp_path / "file").write_text("")
    with pytest.raises(GroundedError, match=holding(tmp_path / "file")):
        draw_study("car", results()["car"], tmp_path / "file" / "a.png")
