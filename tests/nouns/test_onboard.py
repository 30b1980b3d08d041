"""The runner for the robot: a single file that raises nothing in the control loop."""

import ast
import subprocess
import sys
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fuzzed_runner import HOSTILE, fuzz
from grounded import onboard
from grounded.onboard import Runner
from grounded.policy import Policy, to_arrays

H, DT = 5, 0.1


def policy(**changes):
    fields = {
        "feedforward": np.linspace(0.1, 0.5, H)[:, None],
        "low": np.array([-1.0]),
        "high": np.array([0.45]),
        "dt": DT,
        "state_names": ("x", "v"),
        "input_names": ("force",),
        "depths": (1,),
        "angles": (False, False),
        "past": np.array([0.7]),
        "gain": np.tile([[[-1.0, 0.0, 0.5]]], (H, 1, 1)),
        "reference": np.tile([0.0, 0.0, 0.7], (H, 1)),
    }
    return Policy(**fields | changes)


@pytest.fixture
def exported(tmp_path):
    path = tmp_path / "c0001.npz"
    np.savez(path, **to_arrays(policy(), task="t"))
    return path


def test_the_file_runs_alone_and_gives_the_same_inputs(exported, tmp_path):
    alone = tmp_path / "robot"
    alone.mkdir()
    (alone / "run.py").write_bytes(Path(onboard.__file__).read_bytes())
    code = (
        "import run; r = run.load({path!r}, states=('x', 'v'))\n"
        "print([float(r.action(0.1 * k, [0.1 * k, 0.0])[0]) for k in range(7)])\n"
        "import sys; assert not any(name.startswith('grounded') for name in sys.modules)"
    )
    command = [sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, {str(alone)!r})\n"]
    command[-1] += code.format(path=str(exported))
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    here = Runner(policy())
    expected = [float(here.action(0.1 * k, [0.1 * k, 0.0])[0]) for k in range(7)]
    assert ast.literal_eval(done.stdout) == expected


def test_a_loaded_policy_has_the_horizon_that_the_docs_use(exported):
    assert onboard.load(exported).policy.horizon == policy().horizon == H


def test_the_file_is_valid_python_3_8():
    source = Path(onboard.__file__).read_text(encoding="utf-8")
    tree = ast.parse(source, feature_version=(3, 8))
    imported = {n.module.split(".")[0] for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    imported |= {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    assert imported == {"__future__", "sys", "io", "pathlib", "types", "typing", "zipfile", "numpy"}


@pytest.mark.parametrize(
    "state",
    [
        [np.nan, 0.0],
        [0.0],
        0.0,
        [0.0, 0.0, 0.0],
        [[0.0], [0.0]],
        np.ma.masked_array([0.0, 0.0], mask=[True, False]),
        ["a", "b"],
        None,
        [np.inf, 0.0],
    ],
    ids=str,
)
def test_a_state_that_cannot_be_used_sends_the_feedforward(state):
    runner = Runner(policy())
    assert runner.action(0.0, state) == pytest.approx([0.1])
    assert runner.blind == 1


def test_a_masked_state_without_a_masked_value_is_a_state():
    runner, masked = Runner(policy()), np.ma.masked_array([0.2, 0.0], mask=False)
    assert runner.action(0.0, masked) == pytest.approx([-0.1]) and runner.blind == 0


def test_time_runs_forward_or_stays():
    runner = Runner(policy(gain=None, reference=None))
    assert runner.action(0.2, [0, 0]) == pytest.approx([0.3])
    assert runner.action(0.05, [0, 0]) == pytest.approx([0.3])  # backwards: the latest step
    for t in (np.nan, None, "soon"):
        assert runner.action(t, [0, 0]) == pytest.approx([0.3])
    assert runner.blind == 3
    assert runner.action(-np.inf, [0, 0]) == pytest.approx([0.3])
    assert not runner.done(np.nan) and not runner.done(0.44)


def test_a_run_that_is_over_stays_over_where_the_time_begins_anew():
    runner, state = Runner(policy()), [0.0, 0.0]
    dt = policy().dt
    for k in range(H):
        assert not runner.done(k * dt)
        runner.action(k * dt, state)
    assert runner.action((H - 1.4) * dt, state) != pytest.approx([0.45])  # a little early
    assert runner.done(0.0) and runner.action(0.0, state) == pytest.approx([0.45])
    assert not Runner(policy()).done(0.0)


def test_what_is_held_after_the_end_is_inside_the_limits():
    runner = Runner(policy())
    for t in (0.5, 1e300, np.inf):
        assert runner.done(t) and runner.action(t, [0, 0]) == pytest.approx([0.45])
    assert Runner(policy()).action(np.nan, [0, 0]) == pytest.approx([0.45])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"high": np.array([np.inf])}, "limits"),
        ({"low": np.array([np.inf]), "high": np.array([np.inf])}, "limits"),
        ({"feedforward": np.ones((H, 1)) * 1j}, "feedforward.*complex"),
        ({"depths": np.array([10**9])}, "depths"),
        ({"state_names": np.array(["x"] * 2000)}, "state_names.*2000"),
        ({"format": "other"}, "not a candidate"),
    ],
    ids=str,
)
def test_a_file_that_is_none_is_refused(change, message, tmp_path):
    path = tmp_path / "bad.npz"
    np.savez(path, **to_arrays(policy()) | change)
    with pytest.raises(ValueError, match=message):
        onboard.load(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(HOSTILE))
def test_a_small_file_that_asks_for_gigabytes_is_refused_before_they_are_taken(name, tmp_path):
    path = tmp_path / "bad.npz"
    path.write_bytes(HOSTILE[name]())
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"bad\.npz"):
            onboard.load(path)
        assert tracemalloc.get_traced_memory()[1] < 2e8
    finally:
        tracemalloc.stop()


def test_whatever_a_robot_passes_nothing_is_raised_and_all_is_inside_the_limits(tmp_path):
    found = fuzz(Path(onboard.__file__), tmp_path, calls=3000, seed=5)
    assert found.calls >= 3000 and found.used > 300
    assert not found.raised and not found.outside


def test_what_a_file_holds_is_shown(exported):
    command = [sys.executable, onboard.__file__, str(exported)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert lines[0] == "5 steps of 0.1 s" and lines[-1] == "input   force, limits -1 to 0.45"


def test_a_runner_of_something_else_than_a_policy():
    for given, told in (
        ("nofile.npz", r"load\('nofile.npz'\)"),
        (SimpleNamespace(policy=policy()), "pass its policy"),
        (None, "NoneType"),
    ):
        with pytest.raises(ValueError, match=told):
            Runner(given)
