"""docs/robot.md as printed: its ROS node runs with stubs of ROS, its C++ compiles and agrees.

And docs/own-program.md, whose rig runs in time that only its sleeping moves.
"""

import json
import random
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import grounded.policy
from cli import grounded as command
from ros_bags import car_bag, odometry

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "robot.md").read_text("utf-8")


def block(language, containing):
    """The one block of the page in a language that has a text."""
    blocks = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    (found,) = (text for text in blocks if containing in text)
    return found


def named_file(name):
    """A file that docs/own-program.md gives in full."""
    page = (DOCS / "own-program.md").read_text("utf-8")
    return re.search(rf"<!-- file: {name} -->\n```python\n(.*?)```", page, re.DOTALL)[1]


@pytest.fixture(scope="module")
def car(tmp_path_factory):
    """A workspace from a bag, its first candidate exported with the runner."""
    top = tmp_path_factory.mktemp("page")
    log, w = car_bag(top / "drive"), top / "robot"
    for words in (
        ["init", w, "--from", log],
        ["-C", w, "propose"],
        ["-C", w, "export", "c0001", "--runner", "-o", top / "c0001.npz"],
        ["-C", w, "export", "c0001", "--format", "json", "-o", top / "c0001.json"],
    ):
        done = command(*words)
        assert done.code == 0, done.err
    return top


class Node:
    """What the page's node uses of rclpy's."""

    def __init__(self, name):
        self.now, self.sent, self.timers = 5.0, [], []

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=lambda message: self.sent.append((topic, message)))

    def create_subscription(self, kind, topic, callback, depth):
        self.heard = (topic, callback)

    def create_timer(self, period, callback):
        self.timers.append((period, callback))

    def get_clock(self):
        stamp = SimpleNamespace(nanoseconds=round(self.now * 1e9), to_msg=lambda: self.now)
        return SimpleNamespace(now=lambda: stamp)


def drive_message():
    return SimpleNamespace(header=SimpleNamespace(stamp=None), drive=SimpleNamespace())


def test_the_ros_node_of_the_page_sends_what_the_policy_says(car, monkeypatch):
    stubs = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "ackermann_msgs": {},
        "ackermann_msgs.msg": {"AckermannDriveStamped": drive_message},
        "nav_msgs": {},
        "nav_msgs.msg": {"Odometry": object},
    }
    for name, inside in stubs.items():
        module = ModuleType(name)
        vars(module).update(inside)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "grounded_runner", raising=False)
    monkeypatch.chdir(car)
    monkeypatch.syspath_prepend(str(car))
    (car / "node.py").write_text(block("python", "class Drive(Node)"))
    node = runpy.run_path(str(car / "node.py"))["Drive"]("c0001.npz")
    ((period, tick),) = node.timers
    tick()
    assert period == 0.05 and node.sent == []  # it waits for a state
    same = grounded.policy.load(car / "c0001.npz")
    with pytest.raises(SystemExit):
        for k in range(1000):
            state = (0.5 + 0.01 * k, 0.02 * k, 0.1, -3.0 + 0.01 * k)
            v, x, y, psi = state
            node.heard[1](odometry(10**9, x, y, psi, v, 0.0))
            tick()
            expected = same.action(0.05 * k, np.array(state))
            topic, message = node.sent[-1]
            found = (message.drive.steering_angle, message.drive.speed)
            assert topic == "/drive" and np.allclose(found, expected, atol=1e-9), k
            node.now += 0.05
    assert k == same.policy.horizon


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")
def test_the_cpp_of_the_page_agrees_with_the_policy(car, tmp_path):
    made = json.loads((car / "c0001.json").read_text())
    made["angle"] = [int(name in made["angles"]) for name in made["z_names"]]

    def array(name):
        values = np.array(made[name])
        inside = re.sub(r"\[", "{", json.dumps(values.tolist())).replace("]", "}")
        sizes = "".join(f"[{n}]" for n in values.shape)
        return f"const double {name}{sizes} = {inside};"

    names = ("feedforward", "gain", "reference", "low", "high", "angle")
    steps, m, nz = np.shape(made["gain"])
    rng = np.random.default_rng(0)
    z = np.array(made["reference"]) + rng.normal(size=(len(made["reference"]), nz)) * 0.1
    z[:, 3] += 2 * np.pi * rng.integers(-2, 3, len(z))
    made["zs"] = z[:steps].tolist()
    (tmp_path / "main.cpp").write_text(
        "\n".join(
            [
                "#include <algorithm>\n#include <cmath>\n#include <cstdio>",
                f"const int m = {m}, nz = {nz}, steps = {steps};",
                *map(array, (*names, "zs")),
                block("cpp", "void act"),
                "int main() { double u[m]; for (int t = 0; t < steps; ++t) { act(t, zs[t], u);",
                'for (double one : u) { printf("%.17g ", one); } printf("\\n"); } }',
            ]
        )
    )
    build = ["g++", "-std=c++17", "-Wall", "-Werror", "-o", tmp_path / "act", tmp_path / "main.cpp"]
    subprocess.run(build, check=True)
    out = subprocess.run([tmp_path / "act"], check=True, capture_output=True, text=True).stdout
    found = np.array([list(map(float, line.split())) for line in out.splitlines()])
    off = z[:steps] - np.array(made["reference"])[:steps]
    off[:, 3] = np.angle(np.exp(1j * off[:, 3]))
    expected = np.array(made["feedforward"]) + np.einsum("tij,tj->ti", np.array(made["gain"]), off)
    assert np.allclose(found, np.clip(expected, made["low"], made["high"]), atol=1e-9)


@pytest.fixture
def virtual(monkeypatch):
    """A clock that only sleeping moves: twenty seconds of driving take none."""
    now = [100.0]

    def sleep(seconds):
        now[0] += seconds

    monkeypatch.setattr("time.monotonic", lambda: now[0])
    monkeypatch.setattr("time.sleep", sleep)


@pytest.mark.slow
def test_the_page_of_a_program_of_your_own_leads_to_a_run_within_a_centimetre(
    tmp_path, monkeypatch, virtual
):
    for name in ("model.py", "drive.py", "rig.py"):
        (tmp_path / name).write_text(named_file(name))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))

    def drive(*words):
        for name in ("rig", "grounded_runner"):
            monkeypatch.delitem(sys.modules, name, raising=False)  # a new process each
        monkeypatch.setattr(sys, "argv", ["drive.py", *words])
        runpy.run_path("drive.py")

    def told(*words):
        done = command(*words)
        assert done.code == 0, done.err
        return json.loads(done.out) if "--json" in words else done.out

    random.seed(7)
    drive("hand.csv")
    told("init", "ball", "--from", "hand.csv", "--model", "model.py")
    told("-C", "ball", "ingest", "--data", "hand.csv")
    found = told("-C", "ball", "diagnose", "--json")
    true = {"linkage": 0.0015, "lag": 0.12}
    assert set(found["verdict"]["effects"]) == {"offset:v", "coulomb_friction:v"}
    for name, value in true.items():
        assert found["parameters"][name]["value"] == pytest.approx(value, rel=0.06)
    told("-C", "ball", "adopt", "offset:v", "coulomb_friction:v", "sensor_lag:v")

    file = Path("ball/grounded.toml")
    text = file.read_text().replace("start = { }", "start = { x = -0.1 }")
    limited = re.sub(r"servo = \[.*\]\n(#.*\n)*seen_in.*", "servo = [-45, 45]", text)
    assert limited != text
    file.write_text(limited)
    told("-C", "ball", "target", "line", "--to", "x=0.1", "--seconds", "2.5", "--hold", "1")
    told("-C", "ball", "propose")
    told("-C", "ball", "export", "c0001", "--runner", "-o", "c0001.npz")
    drive("r1.csv", "c0001.npz")
    ran = told("-C", "ball", "next", "r1.csv", "--json")
    assert Path("ball/c0002.npz").is_file()
    rows = np.loadtxt("r1.csv", delimiter=",", skiprows=1)
    target = np.loadtxt("ball/target.csv", delimiter=",", skiprows=1)
    off = rows[: len(target), 1] - target[:, 1]
    assert np.sqrt(np.mean(off**2)) < 0.012, ran
