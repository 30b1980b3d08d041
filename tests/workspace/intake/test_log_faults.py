"""Angles that [log] reads from one number of a quaternion, and commands in degrees."""

from types import SimpleNamespace

import numpy as np
import pytest

from cli import grounded
from facts import holds
from grounded import Model, Trial
from grounded_trials import Workspace
from grounded_trials.workspace.intake.log_faults import column_faults
from ros_bags import rover_bag


def test_a_part_of_a_quaternion_is_told_wherever_it_is_read(tmp_path):
    log, w = rover_bag(tmp_path / "bag"), tmp_path / "w"
    grounded("init", w, "--from", log, "--json")
    toml, angle, part = w / "grounded.toml", "orientation.@rpy.yaw", "orientation.z"

    def told():
        said = grounded("-C", w, "inspect", log, "--json").json["remarks"]
        found = [one.finding for one in Workspace(w).preflight()]
        return [any(holds(one, part, angle) for one in some) for some in (said, found)]

    assert not any(part in one for one in Workspace(w).ingest(log, data=True).warnings)
    assert told() == [False, False]
    toml.write_text(toml.read_text().replace(angle, part))
    grounded("-C", w, "discard", "t0001")
    (warning,) = (s for s in Workspace(w).ingest(log, data=True).warnings if part in s)
    assert holds(warning, "psi", "quaternion", angle)
    assert told() == [True, True]


def test_a_command_in_degrees_is_named_with_its_own_table():
    boat = Model(
        states={"psi": "rad", "r": "rad/s"},
        inputs={"rudder": "rad"},
        derivative=lambda s, a, p: {"psi": s.r, "r": (0.6 * a.rudder - s.r) / 0.8},
        angles=("psi",),
    )
    rudder = 0.3 * np.sign(np.sin(0.9 * np.arange(400) * 0.1))[:, None]
    x = [np.zeros(2)]
    for u in rudder:
        x.append(boat.system.step(x[-1][None], u[None], boat.values, 0.1)[0])
    y = np.array(x) + 1e-3 * np.random.default_rng(1).standard_normal((401, 2))
    trial = Trial(y, np.degrees(rudder), 0.1, ("psi", "r"), ("rudder",))
    (fault,) = column_faults(SimpleNamespace(base_model=boat), trial)
    assert (fault.code, fault.about) == ("log.unit", ("rudder",))
    assert fault.facts["by"] == pytest.approx(1 / 57.29578)
    assert holds(fault.sentence, "[log.input.rudder]", "0.017453293")
