"""Data of a robot that stands still until somebody touches the joystick, and publishes nothing."""

import numpy as np
import pytest

from grounded_trials import Workspace
from grounded_trials.formats.mcap_writer import McapWriter
from grounded_trials.formats.protobuf import encode_doubles
from workspaces import CONFIG, make


def test_a_robot_that_stands_still_before_its_first_command_was_sent_nothing(tmp_path):
    w = Workspace(make(tmp_path / "v", config=SEPARATE).folder)
    starts = {}
    for speed in (0.0, 0.4):
        path = published_when_touched(tmp_path / f"{speed}.mcap", speed)
        found = w.ingest(path, data=True)
        trial = w.trials()[-1].trial
        starts[speed] = (trial.states[0, 0], trial.start_inputs)
        assert bool(found.notes) == (speed > 0)
    assert starts[0.0][0] == pytest.approx(0.3, abs=0.01) and starts[0.0][1] == pytest.approx([0])
    assert starts[0.4][0] > 0.6 and starts[0.4][1][0] > 0  # with its first command as that before


def test_commands_that_come_on_another_grid_than_dt_are_told(tmp_path):
    w = Workspace(make(tmp_path / "v", config=SEPARATE.replace("dt = 0.05", "dt = 0.02")).folder)
    rows = np.column_stack([0.02 * np.arange(41), np.zeros((41, 2))])
    named = {"delimiter": ",", "header": "t,x,v", "comments": ""}
    np.savetxt(w.folder / "target.csv", rows, **named)
    notes = w.ingest(published_when_touched(tmp_path / "a.mcap", 0.0), data=True).notes
    assert any("0.05 s" in note and "0.02" in note for note in notes)


SEPARATE = CONFIG + (
    '[log]\nclock = "publish"\n[log.state.x]\npath = "/state.x"\n[log.state.v]\n'
    'path = "/state.v"\n[log.input.force]\npath = "/sent.force"\n'
)


def published_when_touched(path, speed):
    """A log of 1 s at a constant speed, then 8 s of a joystick's whole numbers every 50 ms."""
    rng = np.random.default_rng(0)
    t = np.arange(0, 9, 0.02)
    v = speed + 0.5 * np.clip(t - 1, 0, None)
    x = 0.3 + speed * t + 0.25 * np.clip(t - 1, 0, None) ** 2 + rng.normal(0, 0.002, len(t))
    sent = np.arange(1, 9, 0.05)
    force = np.round(2 + np.sin(np.floor(sent / 0.35))) + 1.0
    with path.open("wb") as stream:
        log = McapWriter(stream)
        state, command = (
            log.doubles("/state", "S", ["x", "v"]),
            log.doubles("/sent", "F", ["force"]),
        )
        for k, row in enumerate(encode_doubles(np.column_stack([x, v]))):
            log.message(state, 10**18 + k * 20_000_000, row)
        for k, row in enumerate(encode_doubles(force[:, None])):
            log.message(command, 10**18 + 10**9 + k * 50_000_000, row)
        log.finish()
    return path
