"""Real systems whose authors published what the model lacks (../shared/data, each SOURCE.md).

Their logs become MCAP trials, which are ingested and diagnosed by the commands that a user types.
"""

import pytest

from cli import grounded
from grounded_trials.mcap_log import write_trial
from real_systems import DART_STEERING, DART_THROTTLE, EMPS, SERVO
from shared_data import needs_data

CONFIG = """[model]
file = "model.py"

[task]
dt = {dt}
horizon = 10
target = "target.csv"

[reward]
state = {{ {state} = 1.0 }}
"""


def diagnosed(system, folder):
    """Trials as MCAP files, ingested and diagnosed; the document."""
    trials = system.read()
    first = trials[0]
    name = first.state_names[0]
    folder.mkdir()
    (folder / "model.py").write_text(system.text)
    (folder / "grounded.toml").write_text(CONFIG.format(dt=first.dt, state=name))
    rows = "\n".join(f"{k * first.dt:.6f},0" for k in range(11))
    (folder / "target.csv").write_text(f"t,{name}\n{rows}\n")
    paths = []
    for k, trial in enumerate(trials):
        paths.append(str(folder / f"log{k:02d}.mcap"))
        write_trial(folder / f"log{k:02d}.mcap", trial, {"kind": "data"})
    stored = grounded("-C", folder, "ingest", "--data", *paths, "--json")
    assert stored.code == 0 and len(stored.json["trials"]) == len(trials), stored.err
    found = grounded("-C", folder, "diagnose", "--json")
    assert found.code == 0, found.err
    return found.json


def values(document, effect):
    row = next(r for r in document["ranking"] if r["effect"] == effect)
    return {name: estimate["value"] for name, estimate in row["params"].items()}


@needs_data
def test_emps_has_dry_and_viscous_friction_of_the_published_size(tmp_path):
    found = diagnosed(EMPS, tmp_path / "emps")
    assert {"coulomb_friction:v", "viscous_friction:v"} <= set(found["verdict"]["effects"])
    dry, viscous = values(found, "coulomb_friction:v"), values(found, "viscous_friction:v")
    assert dry["c"] == pytest.approx(20.394 / 95.109, rel=0.05)
    assert viscous["k"] == pytest.approx(203.5 / 95.109, rel=0.05)
    assert found["gap"]["held_out"] and found["gap"]["before"] > 20 * found["gap"]["after"]


@needs_data
def test_the_servo_has_a_speed_limit_and_a_delay(tmp_path):
    """Published: 40 ms, 1.56/s. The filter's r is lower: the servo also needs time to speed up."""
    found = diagnosed(SERVO, tmp_path / "servo")
    assert {"slew_limit:position", "delay:command"} <= set(found["verdict"]["effects"])
    assert 1.0 < values(found, "slew_limit:position")["r"] < 1.7
    assert 0.035 < values(found, "delay:command")["d"] < 0.05


@needs_data
def test_the_dart_steers_late(tmp_path):
    found = diagnosed(DART_STEERING, tmp_path / "dart")
    named = found["verdict"]["effects"]
    late = [e for e in named if e in ("first_order_lag:steering", "delay:steering")]
    assert len(late) == 1  # beside a response that saturates
    assert 0.05 < next(iter(values(found, late[0]).values())) < 0.18


@needs_data
def test_the_dart_throttle_has_a_dead_zone(tmp_path):
    found = diagnosed(DART_THROTTLE, tmp_path / "dart")
    assert found["ranking"][0]["effect"] == "dead_zone:throttle"
    assert 0.15 < values(found, "dead_zone:throttle")["c"] < 0.22
    alike = {
        one["like"]: one["share"]
        for one in found["lookalikes"]
        if one["effect"] == "dead_zone:throttle"
    }
    assert 0.75 < alike["coulomb_friction:v"] < 1
    assert "dead_zone:throttle is nearly inseparable from" in found["verdict"]["sentence"]
