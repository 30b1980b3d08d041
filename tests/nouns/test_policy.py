"""theta + alpha d; its file; the runner for a robot: numpy alone, and it raises nothing."""

import ast
import os
import pickle
import subprocess
import sys
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from facts import holding
from fuzzed_runner import HOSTILE, fuzz
from grounded import onboard
from grounded.errors import GroundedError
from grounded.onboard import Runner
from grounded.policy import Policy, load, to_arrays, z_difference

STATES, INPUTS = ("x", "psi"), ("speed", "turn")


def policy(H=10, seed=0, feedback=True, depths=(1, 2), **changes):
    rng = np.random.default_rng(seed)
    nz = 2 + sum(depths)
    fields = {
        "feedforward": rng.normal(size=(H, 2)),
        "low": np.full(2, -50.0),
        "high": np.full(2, 50.0),
        "dt": 0.1,
        "state_names": STATES,
        "input_names": INPUTS,
        "depths": depths,
        "angles": (False, True),
        "past": np.array([0.5, -0.5]),
        "gain": rng.normal(size=(H, 2, nz)) if feedback else None,
        "reference": rng.normal(size=(H, nz)) if feedback else None,
    }
    return Policy(**fields | changes)


def law(p, t, z):
    """u = ubar + K (z - zbar), with the angle's difference wrapped, written out."""
    u = p.feedforward[t].copy()
    for i in range(len(u)):
        for j in range(len(z)):
            d = z[j] - p.reference[t, j]
            if j == 1:
                d = np.arctan2(np.sin(d), np.cos(d))
            u[i] += p.gain[t, i, j] * d
    return u


def test_alpha_0_is_theta_alpha_1_is_the_other_and_a_half_is_between():
    a, b = policy(seed=1), policy(seed=2)
    z = np.random.default_rng(3).normal(size=(20, 10, 5)) * 0.1
    assert a.toward(b, 1.0) is b
    for alpha in (0.0, 0.5, 0.125):
        mixed = a.toward(b, alpha)
        for sample in z:
            for t in range(10):
                near = b.reference[t] + sample[t]
                # differences of angles to both references stay within (-pi, pi) here
                expected = (1 - alpha) * law(a, t, near) + alpha * law(b, t, near)
                np.testing.assert_allclose(law(mixed, t, near), expected, atol=1e-12)
        np.testing.assert_array_equal(mixed.reference, b.reference)
        np.testing.assert_allclose(mixed.gain, (1 - alpha) * a.gain + alpha * b.gain, atol=1e-15)


def test_open_loop_policies_mix_their_inputs():
    a, b = policy(seed=1, feedback=False), policy(seed=2, feedback=False)
    half = a.toward(b, 0.5)
    np.testing.assert_allclose(half.feedforward, 0.5 * (a.feedforward + b.feedforward))
    assert half.gain is None


def test_a_policy_about_another_reference_is_the_same_policy():
    a = policy(seed=1)
    moved = a.about(a.reference + np.random.default_rng(0).normal(size=a.reference.shape) * 0.3)
    for t in range(10):
        z = a.reference[t] + 0.1
        np.testing.assert_allclose(law(moved, t, z), law(a, t, z), atol=1e-12)


def test_mismatched_sizes_are_refused():
    with pytest.raises(GroundedError, match=holding("gain", "reference")):
        policy(reference=None)
    with pytest.raises(GroundedError, match=holding("(10, 2, 5)", "(10, 5)")):
        policy(gain=np.zeros((10, 2, 4)))


def test_the_runner_is_the_law_with_the_queue_of_past_inputs():
    p, rng = policy(), np.random.default_rng(5)
    run, sent = Runner(p), [p.past, p.past]
    for t in range(10):
        s = rng.normal(size=2)
        z = np.array([*s, sent[-1][0], sent[-1][1], sent[-2][1]])
        expected = np.clip(law(p, t, z), p.low, p.high)
        found = run.action(t * p.dt, s)
        np.testing.assert_allclose(found, expected, atol=1e-12)
        sent.append(found)


def test_clipped_inputs_are_what_is_remembered():
    p = policy(low=np.array([-0.1, -0.1]), high=np.array([0.1, 0.1]))
    run, s = Runner(p), np.array([100.0, 1.0])
    first = run.action(0.0, s)
    assert np.abs(first).max() <= 0.1
    z = np.array([*s, first[0], first[1], p.past[1]])
    np.testing.assert_allclose(run.action(0.1, s), np.clip(law(p, 1, z), -0.1, 0.1), atol=1e-12)


def test_the_controller_of_the_nearest_step_is_used():
    p = policy(feedback=False)
    for t, step in ((0.0, 0), (0.049, 0), (0.051, 1), (0.149, 1), (0.26, 3), (0.949, 9)):
        np.testing.assert_array_equal(Runner(p).action(t, np.zeros(2)), p.feedforward[step])
    np.testing.assert_array_equal(Runner(p).action(-0.3, np.zeros(2)), p.feedforward[0])


def test_missed_calls_held_the_last_input():
    p = policy()
    run, s = Runner(p), np.zeros(2)
    sent = run.action(0.1, s)
    z = np.array([0.0, 0.0, sent[0], sent[1], sent[1]])  # steps 2 .. 4 held what was sent at 1
    np.testing.assert_allclose(run.action(0.5, s), law(p, 5, z), atol=1e-12)


def test_a_turn_more_changes_nothing():
    p = policy()
    a, b = Runner(p), Runner(p)
    for t in range(10):
        s = np.array([0.1, 0.4])
        one, other_ = a.action(t * 0.1, s), b.action(t * 0.1, s + np.array([0, 6 * np.pi]))
        np.testing.assert_allclose(one, other_, atol=1e-9)


def saved(folder, p, **about):
    path = folder / "c.npz"
    np.savez(path, **to_arrays(p, task="feed", **about))
    return path


@pytest.mark.parametrize("feedback", [True, False])
def test_a_saved_policy_is_the_same_policy(tmp_path, feedback):
    p = policy(feedback=feedback)
    a, b = Runner(p), load(saved(tmp_path, p), states=STATES, inputs=INPUTS, task="feed")
    for t in range(12):
        s = np.array([0.1 * t, -0.2])
        np.testing.assert_array_equal(a.action(t * 0.1, s), b.action(t * 0.1, s))
    assert b.policy.z_names == ("x", "psi", "speed[t-1]", "turn[t-1]", "turn[t-2]")


@pytest.mark.parametrize(
    ("asked", "match"),
    [
        ({"states": ("psi", "x")}, holding("('x', 'psi')", "('psi', 'x')")),
        ({"inputs": ("speed",)}, holding("('speed', 'turn')", "('speed',)")),
        ({"task": "beef"}, holding("feed", "beef")),
    ],
)
def test_another_robot_or_task_is_refused(tmp_path, asked, match):
    with pytest.raises(GroundedError, match=match):
        load(saved(tmp_path, policy()), **asked)


def test_a_file_that_is_not_there_or_not_ours(tmp_path):
    with pytest.raises(GroundedError, match=holding("nowhere.npz")):
        load(tmp_path / "nowhere.npz")
    (tmp_path / "a.npz").write_bytes(b"")
    (tmp_path / "b.npz").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    np.savez(tmp_path / "c.npz", a=np.zeros(3))
    np.save(tmp_path / "d.npy", np.zeros(3))
    for name in ("a.npz", "b.npz", "c.npz", "d.npy"):
        with pytest.raises(GroundedError, match=name):
            load(tmp_path / name)


def test_nothing_in_a_file_is_executed(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "boom"),))

    np.savez(tmp_path / "a.npz", **to_arrays(policy()) | {"low": np.array([Bomb()], dtype=object)})
    (tmp_path / "b.npz").write_bytes(pickle.dumps(Bomb()))
    for name in ("a.npz", "b.npz"):
        with pytest.raises(GroundedError):
            load(tmp_path / name)
    assert not (tmp_path / "boom").exists()


WRONG = {
    "feedforward": [np.full((10, 2), np.nan), np.zeros(10), np.array([["a", "b"]])],
    "low": [np.array([np.nan, 0.0]), np.array([60.0, 60.0]), None],
    "high": [np.zeros(3)],
    "past": [np.array([np.nan, 0.0]), np.zeros(3)],
    "dt": [np.array([0.1, 0.2]), 0.0, np.nan, "soon"],
    "depths": [np.array([1]), np.array([0, -1]), np.array(["a", "b"])],
    "angles": [np.array([True])],
    "state_names": [np.array("x")],
    "gain": [np.zeros((10, 2, 4))],
    "reference": [None],
    "format": ["grounded-policy-2"],
}


@pytest.mark.parametrize("name", WRONG)
def test_garbage_inside_is_one_sentence(tmp_path, name):
    path = tmp_path / "c.npz"
    for value in WRONG[name]:
        arrays = to_arrays(policy()) | {name: value}
        np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
        with pytest.raises(GroundedError, match=r"c\.npz"):
            load(path)


def test_cut_and_flipped_files_are_refused_or_whole(tmp_path):
    good = saved(tmp_path, policy()).read_bytes()
    reference, path = policy(), tmp_path / "bad.npz"
    rng = np.random.default_rng(0)
    for _ in range(60):
        data = bytearray(good)
        if rng.random() < 0.5:
            data = data[: rng.integers(len(data))]
        else:
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(bytes(data))
        try:
            run = load(path)
        except GroundedError:
            continue
        np.testing.assert_array_equal(run.policy.feedforward, reference.feedforward)
        np.testing.assert_array_equal(run.policy.gain, reference.gain)


def test_the_robot_needs_numpy_alone(tmp_path):
    path = saved(tmp_path, policy())
    code = (
        "import sys; from grounded.policy import load; import numpy as np\n"
        f"run = load({str(path)!r})\nprint(run.action(0.0, np.zeros(2)).tolist())\n"
        "bad = {'llvmlite', 'scipy', 'mcap', 'click', 'rerun', 'google'} & set(sys.modules)\n"
        "assert not bad, bad\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("depths", [(1, 1), (1, 2), (3, 1)])
@pytest.mark.parametrize("limit", [50.0, 0.8])
def test_commands_on_its_own_past_ones_are_those_of_the_law_step_by_step(depths, limit):
    H, rng = 10, np.random.default_rng(1)
    one = policy(H, depths=depths, low=np.full(2, -limit), high=np.full(2, limit))
    states = rng.normal(size=(4, H, 2))
    found = one.commands(states, one.past)
    for run, expected in zip(states, found, strict=True):
        sent = [one.past] * max(depths)
        for t in range(H):
            z = [*run[t], *(sent[-1 - i][j] for j in (0, 1) for i in range(depths[j]))]
            off = z_difference(np.array(z), one.reference[t], one.angles)
            sent.append(np.clip(one.feedforward[t] + one.gain[t] @ off, one.low, one.high))
        np.testing.assert_allclose(expected, sent[max(depths) :], rtol=1e-9)
    first = one.until(4)
    np.testing.assert_array_equal(first.commands(states[:, :4], one.past), found[:, :4])
    assert first.after(1).horizon == 3


H, DT = 5, 0.1


def short(**changes):
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
    np.savez(path, **to_arrays(short(), task="t"))
    return path


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
    runner = Runner(short())
    assert runner.action(0.0, state) == pytest.approx([0.1])
    assert runner.blind == 1


def test_a_masked_state_without_a_masked_value_is_a_state():
    runner, masked = Runner(short()), np.ma.masked_array([0.2, 0.0], mask=False)
    assert runner.action(0.0, masked) == pytest.approx([-0.1]) and runner.blind == 0


def test_time_runs_forward_or_stays():
    runner = Runner(short(gain=None, reference=None))
    assert runner.action(0.2, [0, 0]) == pytest.approx([0.3])
    assert runner.action(0.05, [0, 0]) == pytest.approx([0.3])  # backwards: the latest step
    for t in (np.nan, None, "soon"):
        assert runner.action(t, [0, 0]) == pytest.approx([0.3])
    assert runner.blind == 3
    assert runner.action(-np.inf, [0, 0]) == pytest.approx([0.3])
    assert not runner.done(np.nan) and not runner.done(0.44)


def test_a_run_that_is_over_stays_over_where_the_time_begins_anew():
    runner, state = Runner(short()), [0.0, 0.0]
    dt = short().dt
    for k in range(H):
        assert not runner.done(k * dt)
        runner.action(k * dt, state)
    assert runner.action((H - 1.4) * dt, state) != pytest.approx([0.45])  # a little early
    assert runner.done(0.0) and runner.action(0.0, state) == pytest.approx([0.45])
    assert not Runner(short()).done(0.0)


def test_what_is_held_after_the_end_is_inside_the_limits():
    runner = Runner(short())
    for t in (0.5, 1e300, np.inf):
        assert runner.done(t) and runner.action(t, [0, 0]) == pytest.approx([0.45])
    assert Runner(short()).action(np.nan, [0, 0]) == pytest.approx([0.45])


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
        (SimpleNamespace(policy=short()), "pass its policy"),
        (None, "NoneType"),
    ):
        with pytest.raises(ValueError, match=told):
            Runner(given)
