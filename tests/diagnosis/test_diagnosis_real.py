"""Real systems whose authors published what the model lacks (../shared/data, each SOURCE.md)."""

import pytest

from cli import grounded
from grounded.diagnosis.diagnose import diagnose
from grounded_trials.store.trial_file import write_trial
from real_systems import BAM_Q, DART_STEERING, DART_THROTTLE, SERVO
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


def diagnosed(system, folder, every=1):
    """Trials as MCAP files, ingested and diagnosed; the document."""
    trials = system.read()[::every]
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


@pytest.mark.slow
@needs_data
def test_the_servo_has_a_speed_limit_and_a_delay():
    """Published: 40 ms, 1.56/s. The filter's r is lower: the servo also needs time to speed up."""
    found = diagnose(SERVO.model, SERVO.read()[:22:2])
    named = {row.effect: row.params for row in found.ranking if row.claimed}
    assert 1.0 < named["slew_limit:position"]["r"].value < 1.7
    late = [named[name]["d"].value for name in named if "delay" in name]
    assert 0.035 < sum(late) < 0.055


@pytest.mark.slow
@needs_data
def test_the_dart_steers_late(tmp_path):
    found = diagnosed(DART_STEERING, tmp_path / "dart")
    named = found["verdict"]["effects"]
    late = [e for e in named if e in ("first_order_lag:steering", "delay:steering")]
    assert len(late) == 1  # beside a response that saturates
    assert 0.05 < next(iter(values(found, late[0]).values())) < 0.18


@pytest.mark.slow
@needs_data
def test_the_dart_throttle_has_a_dead_zone(tmp_path):
    found = diagnosed(DART_THROTTLE, tmp_path / "dart", every=2)
    assert found["ranking"][0]["effect"] == "dead_zone:throttle"
    assert 0.15 < values(found, "dead_zone:throttle")["c"] < 0.22
    alike = {
        one["like"]: one["share"]
        for one in found["lookalikes"]
        if one["effect"] == "dead_zone:throttle"
    }
    assert 0.75 < alike["coulomb_friction:v"] < 1


@pytest.mark.slow
@needs_data
def test_the_friction_of_a_geared_servo_grows_with_its_load():
    """Only its angle is logged; under coloured noise a plain friction is likelier, and worse."""
    found = diagnose(BAM_Q.model, BAM_Q.read())
    assert found.credit[0].of == "load_friction:volts<-w"
    load = next(row.params for row in found.ranking if row.effect == "load_friction:volts<-w")
    assert 0.25 < load["c"].value < 0.45 and 0.15 < load["k"].value < 0.3  # [V], of what it carries
    half, whole = found.prediction_error[1], found.prediction_error[-1]
    assert half.horizon_s == 0.5 and half.with_effects["q"] < 0.095  # the best made by hand
    assert whole.whole_trial and whole.with_effects["q"] < 0.098
