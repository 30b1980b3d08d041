"""Signals that [log] reads from each other's column, by what those are called."""

import pytest

from facts import holding, holds, of_code
from grounded import Model
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.logs.log_table import LogMapping
from grounded_trials.logs.signals import SignalSpec
from grounded_trials.workspace.intake.opening.columns_by_name import crossed
from recorded import LOGGED, record
from workspaces import make

ARM = Model(
    states={"shoulder": "rad", "elbow": "rad", "shoulder_vel": "rad/s", "elbow_vel": "rad/s"},
    inputs={"torque": "N m"},
    derivative=lambda s, a, p: {
        "shoulder": s.shoulder_vel,
        "elbow": s.elbow_vel,
        "shoulder_vel": a.torque,
        "elbow_vel": -a.torque,
    },
)
PLANE = Model(
    states={"x": "m", "y": "m"},
    inputs={"u": "m/s"},
    roles={"position": ("x", "y")},
    derivative=lambda s, a, p: {"x": a.u, "y": s.x},
)


def reading(model, *columns, form="/csv.{}"):
    paths = {
        name: SignalSpec(form.format(column))
        for name, column in zip((*model.states, *model.inputs), columns, strict=True)
    }
    states = {name: paths[name] for name in model.states}
    return LogMapping(states, {name: paths[name] for name in model.inputs})


@pytest.mark.parametrize(
    "model, columns, pairs",
    [
        (ARM, ("shoulder", "elbow", "shoulder_vel", "elbow_vel", "torque"), []),
        (ARM, ("shoulder_pos", "elbow_pos", "elbow_vel", "shoulder_vel", "torque"), ["elbow_vel"]),
        (ARM, ("shoulder_vel", "elbow", "shoulder", "elbow_vel", "torque"), ["shoulder_vel"]),
        (ARM, ("shoulder", "torque_Nm", "shoulder_vel", "elbow_vel", "elbow_deg"), ["torque"]),
        (ARM, ("a", "b", "c", "d", "e"), []),
        (ARM, ("elbow", "b", "c", "d", "shoulder_cmd"), []),  # of another thing
        (PLANE, ("y", "x", "u"), []),  # the log's axes are its own
    ],
)
def test_what_the_names_of_columns_say(model, columns, pairs):
    found = crossed(model, reading(model, *columns))
    assert len(found) == len(pairs)
    assert all(holds(one.what, part) for one, part in zip(found, pairs, strict=True))


def test_an_input_in_the_column_of_a_state_is_told_at_ingest(tmp_path):
    w = Workspace(make(tmp_path / "w", config=LOGGED).folder)
    log = record(w, tmp_path / "run.csv", w.propose().candidate.policy, 0.0)
    config = w.folder / "grounded.toml"
    text = config.read_text().replace("/csv.v", "/csv.V").replace("/csv.force", "/csv.v")
    config.write_text(text.replace("/csv.V", "/csv.force"))
    other = Workspace(w.folder)
    with pytest.raises(GroundedError, match=holding("/csv.force", "/csv.v", "exchanged")):
        other.ingest(log)
    (told,) = of_code(other.ingest(log, data=True), "log.path")
    assert set(told.about) == {"v", "force"}
