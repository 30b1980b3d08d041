"""The recording: verified by Rerun's own tool, complete, small, and seen in a real viewer."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facts import holding
from reported import gathered, many_flights

pytest.importorskip("rerun", reason="rerun-sdk is not installed")
from grounded_trials.report.recording import entity_of, over_time, write_recording

RERUN = Path(sys.executable).with_name("rerun")
needs_tool = pytest.mark.skipif(not RERUN.exists(), reason="the rerun program is not installed")


def _rerun(*args: object, timeout: float = 120) -> subprocess.CompletedProcess[str]:
    command = [str(RERUN), *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout)


def _entities(path: Path) -> str:
    return _rerun("rrd", "print", path).stdout


ENTITIES = """
/paths/model_policy /paths/best/body /paths/predicted /summary /verdict
"""


@needs_tool
def test_rerun_accepts_the_recording_and_finds_all_of_it(cart, tmp_path):
    path = tmp_path / "cart.rrd"
    findings = gathered(cart)
    write_recording(findings, path)
    done = _rerun("rrd", "verify", path)
    assert done.returncode == 0, done.stderr
    found = _entities(path)
    for entity in ENTITIES.split():
        assert f"{entity} " in found, entity
    for figure in over_time(findings):
        for panel in figure.panels:
            assert found.count(f"{entity_of(figure, panel)}/") >= len(panel.curves)
    for run in findings.runs:
        for part in ("path", "predicted", "body", "state", "input", "bias", "explained"):
            assert f"/trials/{run.trial.id}/{part}" in found


def test_a_recording_of_nothing_and_of_runs_with_gaps(tmp_path):
    findings = many_flights(1)
    write_recording(replace(findings, runs=()), tmp_path / "none.rrd")
    run = findings.runs[0]
    states, inputs = np.array(run.trial.states), np.array(run.trial.inputs)
    states[100:200] = np.nan
    states[:, 0] = np.nan
    gaps = replace(run, trial=replace(run.trial, states=states, inputs=inputs))
    write_recording(replace(findings, runs=(gaps,)), tmp_path / "gaps.rrd")
    assert (tmp_path / "gaps.rrd").stat().st_size > 1000


def test_an_unwritable_place_is_a_sentence(cart, tmp_path):
    from grounded.errors import GroundedError

    with pytest.raises(GroundedError, match=holding(tmp_path / "missing")):
        write_recording(gathered(cart), tmp_path / "missing" / "cart.rrd")


def _ended(command: list[str], log: Path, seconds: float) -> str:
    """What a program said; after so many seconds it is ended with all that it started."""
    with log.open("w") as out:
        started = subprocess.Popen(command, stdout=out, stderr=out, start_new_session=True)
        try:
            started.wait(seconds)
        except subprocess.TimeoutExpired:
            os.killpg(started.pid, signal.SIGTERM)
            started.wait()
    return log.read_text()


@needs_tool
@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="xvfb-run is not installed")
def test_the_viewer_shows_the_paths(car, tmp_path):
    path, shot = tmp_path / "car.rrd", tmp_path / "shot.png"
    write_recording(gathered(car), path)
    screen = ["xvfb-run", "-a", "-s", "-screen 0 1600x1000x24"]
    flags = ["--new", "--bind", "127.0.0.1", "--window-size", "1400x900", "--renderer", "vulkan"]
    command = [*screen, str(RERUN), *flags, "--screenshot-to", str(shot), str(path)]
    said = _ended(command, tmp_path / "said", 240)
    if not shot.exists():
        pytest.skip(f"the viewer can't draw here: {said[-300:]}")
    assert "ERROR" not in said
    from PIL import Image

    image = np.asarray(Image.open(shot).convert("RGB")).astype(int)
    left = image[:, : image.shape[1] // 2]
    for colour in ((213, 94, 0), (86, 180, 233), (170, 170, 170)):  # model's policy, best, desired
        near = (np.abs(left - colour).max(axis=2) < 25).sum()
        assert near > 300, colour
