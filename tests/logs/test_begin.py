"""A workspace from somebody else's log: what is found, what is asked, and that it then works."""

import json
import math
import re

import numpy as np
import pytest

import workspaces
from cli import grounded
from facts import of_code
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.logs.inspection.joint_names import from_base
from grounded_trials.starting.begin import begin
from grounded_trials.starting.kinds import KINDS
from grounded_trials.starting.shapes import Drive, path_target
from grounded_trials.workspace.user_files.task_file import read_target
from ros_bags import (
    arm_bag,
    boat_bag,
    car_bag,
)
from shared_data import data


def test_from_a_bag_to_the_first_candidate_in_four_commands(tmp_path):
    log, w = car_bag(tmp_path / "bag"), tmp_path / "car"
    made = grounded("init", w, "--from", log, "--json").json
    assert made["kind"] == "car" and made["dt"] == 0.05
    paths = {one["name"]: one["path"] for one in made["signals"]}
    assert paths == {
        "v": "/odom.twist.twist.linear.x",
        "x": "/odom.pose.pose.position.x",
        "y": "/odom.pose.pose.position.y",
        "psi": "/odom.pose.pose.orientation.@rpy.yaw",
        "steering": "/drive.drive.steering_angle",
        "speed": "/drive.drive.speed",
    }
    assert all(one["sure"] and one["reasons"] for one in made["signals"])
    assert grounded("-C", w, "ingest", "--data", log).code == 0
    fitted = grounded("-C", w, "fit", "--apply", "--json").json["params"]
    assert fitted["L"]["value"] == pytest.approx(0.32, abs=0.01)
    proposed = grounded("-C", w, "propose", "--json").json
    assert proposed["candidate"] == "c0001"


def test_the_joints_of_an_arm_by_name(tmp_path):
    found = begin(tmp_path / "arm", arm_bag(tmp_path / "bag"))
    paths = {guess.name: guess.path for guess in (*found.states, *found.inputs)}
    assert found.kind == "arm" and not found.unsure
    assert paths["elbow_velocity"] == "/joint_states.velocity[1]"
    assert paths["shoulder_effort"] == "/joint_states.effort[0]"
    assert any(r.code == "start.follows" for g in found.states for r in g.reasons)


@pytest.mark.parametrize(
    "joints, ordered",
    [
        (("elbow_joint", "shoulder_joint"), (1, 0)),
        (("elbow", "shoulder_lift", "shoulder_pan", "wrist_2", "wrist_1"), (2, 1, 0, 4, 3)),
        (("joint1", "joint10", "joint2"), (0, 2, 1)),
    ],
)
def test_joints_are_counted_from_the_base(joints, ordered):
    assert from_base(joints) == tuple(joints[i] for i in ordered)


MODEL = """from grounded import Model, Param
def f(s, a, p):
    return {"q1": s.w1, "q2": s.w2, "w1": a.tau1 / p.J, "w2": a.tau2 / p.J}
model = Model(
    states={"q1": "rad", "q2": "rad", "w1": "rad/s", "w2": "rad/s"},
    inputs={"tau1": "N m", "tau2": "N m"}, params={"J": Param(0.2, "kg m^2", 0.01, 1)},
    derivative=f)
"""


@pytest.fixture
def mine(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(MODEL)
    return path


def test_joints_that_a_model_does_not_name_are_taken_in_order_and_unsure(tmp_path, mine):
    found = begin(tmp_path / "arm", arm_bag(tmp_path / "bag"), model=mine)
    assert [g.path[-11:] for g in found.states] == [
        *("position[0]", "position[1]", "velocity[0]", "velocity[1]")
    ]
    assert {g.name for g in found.unsure} >= {"q1", "q2", "tau1", "tau2"}
    assert (tmp_path / "arm" / "model.py").read_text() == MODEL


def test_degrees_and_signs_are_noticed(tmp_path, mine, scale=180 / np.pi, expected=np.pi / 180):
    found = begin(tmp_path / "arm", arm_bag(tmp_path / "bag", scale), model=mine)
    by = {g.name: g for g in found.states}
    scales = [by["q1"].scale, by["w1"].scale]
    assert any(s == pytest.approx(expected) for s in scales), scales


@pytest.mark.parametrize("kind", KINDS)
def test_every_skeleton_is_a_model(tmp_path, kind):
    found = begin(tmp_path / "w", arm_bag(tmp_path / "bag"), kind=kind)
    model = Workspace(tmp_path / "w").base_model
    assert found.kind == kind and model.system.how == "compiled"
    assert np.isfinite(
        model.system.step(np.zeros((1, model.n)), np.zeros((1, model.m)), model.values, 0.01)
    ).all()


def test_nothing_is_overwritten_and_nothing_half_made_is_left(tmp_path, mine):
    log = arm_bag(tmp_path / "bag")
    begin(tmp_path / "w", log)
    with pytest.raises(GroundedError, match=r"grounded\.toml"):
        begin(tmp_path / "w", log)
    mine.write_text("model = 3\n")
    with pytest.raises(GroundedError, match=r"mine\.py"):
        begin(tmp_path / "new", log, model=mine)
    assert not (tmp_path / "new").exists()
    for words in (["--kind", "submarine"], ["--model", "nowhere.py"]):
        done = grounded("init", tmp_path / "new", "--from", log, *words)
        assert done.code == 1 and words[1] in done.err
    assert not (tmp_path / "new").exists()
    own = grounded("init", tmp_path / "p", "--example", "pendulum").code
    grounded("-C", tmp_path / "p", "propose")
    refused = grounded("init", tmp_path / "x", "--from", tmp_path / "p/candidates/c0001.mcap")
    assert own == 0 and refused.code == 1 and "c0001.mcap" in refused.err


def test_the_real_car_of_a_laboratory(tmp_path):
    """DART: the speed has no name, and is found; what two topics hold is asked."""
    folder = data("dart_small_car")
    found = begin(tmp_path / "w", folder / "dart_4_sept_random_driving_slow_ros2.mcap")
    by = {g.name: g for g in (*found.states, *found.inputs)}
    assert by["x"].path == "/vicon/jetracer1.pose.pose.position.x" and by["x"].sure
    assert by["throttle"].path == "/throttle_1.data"
    both = {"/arduino_data_1.data[3]", "/sensors_and_input_1.data[6]"}
    assert both <= {by["v"].path, *by["v"].others} and not by["v"].sure
    assert by["steering"].path == "/steering_1.data"  # in parts of the lock, as the input is
    assert by["steering"].others == ("/steering_angle_1.data",)


@pytest.fixture
def wheels(tmp_path):
    """A table of a robot on two wheels, its columns with units; psi wraps."""
    rng, t = np.random.default_rng(0), 0.02 * np.arange(1500)
    left, right = (np.repeat(rng.uniform(0.1, 0.6, 60), 25) for _ in range(2))
    v, omega, pwm = np.zeros(len(t)), np.zeros(len(t)), (left + right) / 2
    for k in range(1, len(t)):
        v[k] = v[k - 1] + 0.1 * (pwm[k - 1] - v[k - 1])
        omega[k] = omega[k - 1] + 0.1 * (4 * (right - left)[k - 1] + 1 - omega[k - 1])
    psi = 0.02 * np.cumsum(omega)
    x, y = 0.02 * np.cumsum(v * np.cos(psi)), 0.02 * np.cumsum(v * np.sin(psi))
    seen = np.column_stack([x, y, psi, v, omega]) + rng.normal(0, 0.002, (len(t), 5))
    seen[:, 2] = np.mod(seen[:, 2] + np.pi, 2 * np.pi) - np.pi
    assert np.abs(np.diff(seen[:, 2])).max() > 6

    def write(names="left,right"):
        head = f"t,x [m],y [m],psi [rad],v (m/s),omega [rad/s],{names}"
        rows = np.column_stack([t, seen, left, right])
        path = tmp_path / "drive.csv"
        np.savetxt(path, rows, "%.5f", ",", header=head, comments="")
        return path

    return write


TWO_WHEELS = """import numpy as np
from grounded import Model, Param
def f(s, a, p):
    return {"v": p.k * (a.left + a.right - s.v), "omega": p.k * (a.right - a.left - s.omega),
            "x": s.v * np.cos(s.psi), "y": s.v * np.sin(s.psi), "psi": s.omega}
model = Model(
    states={"v": "m/s", "omega": "rad/s", "x": "m", "y": "m", "psi": "rad"},
    inputs={"left": "1", "right": "1"}, params={"k": Param(5, "1/s", 1, 20)}, angles=("psi",),
    roles={"position": ("x", "y"), "heading": "psi", "speed": "v", "heading_rate": "omega"},
    derivative=f)
"""


def test_a_heading_that_wraps_has_a_derivative(wheels, tmp_path, turn=180 / np.pi):
    (tmp_path / "model.py").write_text(TWO_WHEELS)
    log = wheels()
    rows = np.loadtxt(log, delimiter=",", skiprows=1)
    rows[:, 3] *= turn
    head = log.read_text().splitlines()[0].replace(" [rad]", "")
    np.savetxt(log, rows, "%.5f", ",", header=head, comments="")
    found = begin(tmp_path / "w", log, model=tmp_path / "model.py")
    by = {guess.name: guess for guess in found.states}
    assert by["omega"].sure and by["psi"].scale == pytest.approx(1 / turn)
    assert "your model" in (tmp_path / "w/grounded.toml").read_text().splitlines()[0]


def test_a_boat_with_two_thrusters_is_no_drone(tmp_path):
    """The word thrust in a topic's name made it a drone, with z, roll and pitch."""
    found = begin(tmp_path / "w", boat_bag(tmp_path / "bag"))
    assert found.kind == "boat" and not found.unsure
    paths = {guess.name: guess.path for guess in found.states}
    assert paths["u"].endswith("linear.x") and paths["v"].endswith("linear.y")
    assert [guess.path for guess in found.inputs] == ["/thruster_left.data", "/thruster_right.data"]
    model = Workspace(tmp_path / "w").base_model
    x = model.system.step(np.zeros((1, 6)), np.array([[0.0, 1.0]]), model.values, 0.01)[0]
    moved = dict(zip(model.states, x, strict=True))
    assert moved["u"] > 0 and moved["r"] > 0  # the right thruster alone turns it to the left


@pytest.mark.parametrize(
    ("names", "inputs"),
    [
        ("x,y,psi,u,r,rudder,thruster", ["rudder", "thruster"]),  # u is the speed ahead
        ("a,b,c,d,e,u,aileron", ["u", "aileron"]),
        ("a,b,c,d,u,fan,e", ["u"]),
    ],
)
def test_the_inputs_of_a_generic_model_are_named_like_commands(tmp_path, names, inputs):
    t, log = 0.05 * np.arange(300), tmp_path / "log.csv"
    rows = np.column_stack([t, *(np.sin((1 + k / 3) * t + k) for k in range(7))])
    np.savetxt(log, rows, "%.5f", ",", header=f"t,{names}", comments="")
    found = begin(tmp_path / "w", log, kind="generic")
    assert [one.name for one in found.inputs] == inputs and not found.unsure
    assert ",".join(inputs) in found.why


def test_what_is_left_out_is_said_and_inputs_can_be_named(wheels, tmp_path):
    log = wheels("aa,bb")
    rows = np.loadtxt(log, delimiter=",", skiprows=1)
    rows[:, 6:] += np.random.default_rng(0).normal(0, 1e-3, (len(rows), 2))  # nothing is held
    np.savetxt(log, rows, "%.5f", ",", header=log.read_text().splitlines()[0], comments="")
    found = begin(tmp_path / "w", log)
    assert any("bb" in one.about for one in of_code(found, "start.unused"))
    assert of_code(found, "given.no_input")
    assert grounded("-C", tmp_path / "w", found.then.verb, *found.then.arguments).code == 0
    done = grounded("init", tmp_path / "v", "--from", log, "--inputs", "aa,bb", "--json").json
    assert [one["name"] for one in done["signals"]][-2:] == ["aa", "bb"]
    assert len(done["notes"]) == 1 and "model.py" in done["notes"][0]  # its equations are missing
    wrong = grounded("init", tmp_path / "u", "--from", log, "--inputs", "aa,cc")
    assert wrong.code == 1 and "cc" in wrong.err and not (tmp_path / "u").exists()


@pytest.fixture
def swung(tmp_path):
    """A table of one joint, its columns called as its owner likes."""
    rng, t = np.random.default_rng(0), 0.02 * np.arange(800)
    u = 0.5 * np.sin(0.7 * t) + 0.3 * np.sin(2.1 * t)
    q = np.cumsum(np.convolve(u, np.ones(20) / 20)[: len(t)]) * 0.05

    def write(names="q,w,u", linked=True):
        w = np.gradient(q, 0.02) if linked else rng.normal(0, 1, len(t))
        rows = np.column_stack([t, q, w, u]) + rng.normal(0, 1e-4, (len(t), 4)) * (0, 1, 1, 0)
        path = tmp_path / "swing.csv"
        np.savetxt(path, rows, "%.5f", ",", header=f"t,{names}", comments="")
        return path

    return write


def test_a_joint_by_its_behaviour_where_no_name_fits(swung, tmp_path):
    found = begin(tmp_path / "w", swung(), kind="pendulum")
    assert len(found.unsure) == 3
    paths = [g.path for g in (*found.states, *found.inputs)]
    assert paths == ["/csv.q", "/csv.w", "/csv.u"]
    assert Workspace(tmp_path / "w").status().then.verb == found.then.verb == "ingest"
    done = grounded("-C", tmp_path / "w", found.then.verb, *found.then.arguments)
    assert found.then.verb == "ingest" and done.code == 0


def test_who_is_asked_decides_which_number_a_signal_is(tmp_path, mine):
    asked = []

    def ask(guess):
        asked.append(guess.name)
        return guess.others[0] if guess.name == "q1" and guess.others else guess.path

    log = arm_bag(tmp_path / "bag")
    plain = {g.name: g for g in begin(tmp_path / "plain", log, model=mine).states}
    found = {g.name: g for g in begin(tmp_path / "arm", log, model=mine, ask=ask).states}
    assert set(asked) == {"q1", "q2", "w1", "w2", "tau1", "tau2"} - {
        name for name, guess in plain.items() if guess.sure
    }
    assert all(found[name].sure for name in ("q1", "q2"))
    if plain["q1"].others:
        assert found["q1"].path == plain["q1"].others[0]


def test_numbers_without_a_fitting_name_are_found_by_their_unit_or_listed(swung, tmp_path):
    model = tmp_path / "boom.py"
    model.write_text(workspaces.MODEL.replace('"m"', '"rad"').replace('"m/s"', '"rad/s"'))
    log = swung("Ausleger [deg],Strom [A],Ventil [%]", linked=False)
    found = begin(tmp_path / "w", log, model=model)
    assert [g.path for g in found.states] == ["/csv.Ausleger", ""]
    assert found.states[0].scale == pytest.approx(np.pi / 180) and len(found.unsure) == 3
    bare = begin(tmp_path / "v", swung("Ausleger,Strom,Ventil", linked=False), model=model)
    every = {"/csv.Ausleger", "/csv.Strom", "/csv.Ventil"}
    assert all(set(g.others) == every and not g.path for g in (*bare.states, *bare.inputs))
    text = (tmp_path / "v/grounded.toml").read_text()
    assert '# path = "/csv.Ausleger"' in text
    said = grounded("-C", tmp_path / "v", "ingest", "--data", log)
    assert said.code == 1 and all(path in said.err for path in every)


# targets


def test_a_velocity_beside_a_line_ends_at_rest(tmp_path):
    w = tmp_path / "w"
    grounded("init", w, "--example", "car-circle")
    done = grounded("-C", w, "target", "line", "--to", "x=2", "--to", "v=0", "--json")
    assert done.json["columns"]["x"] == [0.0, 2.0] and "v" in done.json["free"]
    moving = grounded("-C", w, "target", "line", "--to", "x=2", "--to", "v=1")
    assert moving.code == 1 and "--to v=0" in moving.err
    nowhere = grounded("-C", w, "target", "line", "--to", "v=0")
    assert nowhere.code == 1 and "x=1.0" in nowhere.err


def test_a_path_keeps_to_its_speeds_and_starts_from_rest(tmp_path):
    grounded("init", tmp_path / "w", "--example", "car-circle")
    w = Workspace(tmp_path / "w")
    limits = Drive(size=1.5, speed=2.0, accel=1.0, lateral=1.5)
    for shape in ("line", "circle", "figure-8"):
        columns = path_target(shape, limits, w.base_model, 0.05)
        step = np.hypot(np.diff(columns["x"]), np.diff(columns["y"])) / 0.05
        assert columns["v"][0] == 0 and step.max() < 2.01
        assert np.abs(np.diff(columns["v"])).max() / 0.05 < 1.1
        across = np.abs(np.diff(np.unwrap(columns["psi"]))) / 0.05 * step
        assert across.max() < 1.6
        turned = np.arctan2(np.diff(columns["y"]), np.diff(columns["x"]))
        error = np.angle(np.exp(1j * (turned - columns["psi"][:-1])))[step > 0.1]
        assert np.abs(error).max() < 0.2


def test_a_line_takes_the_seconds_that_are_given(tmp_path):
    made = workspaces.make(tmp_path / "w")
    words = ("target", "line", "--to", "x=2", "--seconds", "4")
    done = grounded("-C", made.folder, *words, "--json").json
    assert done["horizon"] == 80 and done["columns"]["x"] == [0.0, 2.0]
    assert done["columns"]["v"][1] == pytest.approx(0.586, abs=0.03)
    names, rows = read_target(made.folder / "target.csv")
    x, v = rows[:, names.index("x")], rows[:, names.index("v")]
    assert x[-1] == 2.0 and v[-1] == 0.0 and x[-2] < 2.0


@pytest.mark.parametrize(
    "words, said",
    [
        (("line", "--to", "x=2", "--speed", "1"), "--seconds"),
        (("circle",), "--seconds"),
        (("run.csv",), "--seconds"),
    ],
)
def test_seconds_that_a_target_can_t_take_are_refused(tmp_path, words, said):
    made = workspaces.make(tmp_path / "w")
    before = (made.folder / "target.csv").read_text()
    refused = grounded("-C", made.folder, "target", *words, "--seconds", "4")
    assert refused.code and said in refused.err
    assert (made.folder / "target.csv").read_text() == before


def test_a_robot_with_one_axis_has_a_line_and_a_step_from_its_start(tmp_path):
    cart = workspaces.MODEL.replace(', "speed": "v"', "").replace('"position": ("x",)', "")
    config = workspaces.CONFIG.replace('"target.csv"\n', '"target.csv"\nstart = { x = 0.5 }\n', 1)
    made = workspaces.make(tmp_path / "w", model=cart, config=config)
    done = grounded("-C", made.folder, "target", "line", "--to", "x=-1", "--speed", "0.5", "--json")
    assert done.json["columns"] == {"x": [-1.0, 0.5], "v": [-0.5, 0.0]}
    names, rows = read_target(made.folder / "target.csv")
    x, v = rows[:, names.index("x")], rows[:, names.index("v")]
    assert x[0] == 0.5 and v[0] == v[-1] == 0 and len(rows) == done.json["horizon"] + 1
    np.testing.assert_allclose(np.diff(x) / 0.05, (v[1:] + v[:-1]) / 2, atol=0.02)
    further = grounded("-C", made.folder, "target", "line", "--size", "2", "--json").json
    assert further["columns"]["x"] == [0.5, 2.5]
    step = grounded("-C", made.folder, "target", "step", "--to", "x=1", "--json").json
    assert step["columns"] == {"x": [0.5, 1.0]}
    for words in (("circle",), ("line", "--to", "x=0.5")):
        assert grounded("-C", made.folder, "target", *words).code == 1


def test_the_target_of_a_workspace_is_drawn_and_the_old_one_kept(tmp_path):
    grounded("init", tmp_path / "w", "--example", "pendulum")
    old = (tmp_path / "w/target.csv").read_text()
    done = grounded(
        "-C", tmp_path / "w", "target", "step", "--to", "theta=3.1416", "--seconds", 2, "--json"
    ).json
    w = Workspace(tmp_path / "w")
    assert w.task.horizon == done["horizon"] and w.task.target[1:, 0] == pytest.approx(3.1416)
    assert (tmp_path / "w/target.csv.bak").read_text() == old
    done = grounded("-C", tmp_path / "w", "target", "step", "--to", "theta=0.5", "--json").json
    assert done["columns"]["theta"] == [0.0, 0.5]
    for words in (["circle"], ["step", "--to", "x=1"], ["nowhere.mcap"]):
        done = grounded("-C", tmp_path / "w", "target", *words)
        assert done.code == 1 and done.err.startswith("error: ")


def test_a_recorded_run_becomes_the_target(tmp_path):
    log, w = car_bag(tmp_path / "bag"), tmp_path / "car"
    grounded("init", w, "--from", log)
    done = grounded("-C", w, "target", log, "--json").json
    assert done["horizon"] > 150 and set(done["columns"]) == {"v", "x", "y", "psi"}
    (tmp_path / "run.csv").write_text("t,x\n0,0\n1,2\n")
    done = grounded("-C", w, "target", tmp_path / "run.csv", "--json").json
    assert done["horizon"] == 20 and done["columns"] == {"x": [0.0, 2.0]}


def test_logs_are_fitted_and_diagnosed_without_a_task(tmp_path):
    """A model, a [log] table and a log: no target, no reward."""
    log, w = car_bag(tmp_path / "bag"), tmp_path / "car"
    grounded("init", w, "--from", log)
    mapping = (w / "grounded.toml").read_text().partition("[log]")[2]
    (w / "grounded.toml").write_text(
        f'[model]\nfile = "model.py"\n[task]\ndt = 0.05\n[log]{mapping}'
    )
    (w / "target.csv").unlink()
    assert grounded("-C", w, "ingest", "--data", log).code == 0
    assert grounded("-C", w, "fit", "--json").json["params"]["L"]["value"] < 0.34
    assert grounded("-C", w, "status").code == 0
    refused = grounded("-C", w, "propose")
    assert refused.code == 1 and "grounded -C" in refused.err and "target" in refused.err
    assert grounded("-C", w, "target", "circle").code == 0
    assert grounded("-C", w, "propose", "--json").json["candidate"] == "c0001"


# the loop at the track


def test_next_ingests_proposes_and_exports(tmp_path):
    grounded("init", tmp_path / "w", "--example", "pendulum")
    grounded("-C", tmp_path / "w", "propose")
    trial = grounded("-C", tmp_path / "w", "run", "--json").json["trial_file"]
    done = grounded("-C", tmp_path / "w", "next", trial, "--json")
    found = json.loads(done.out)
    assert found["trials"][0]["candidate"] == "c0001" and found["propose"]["candidate"] == "c0002"
    assert (tmp_path / "w/c0002.npz").exists() and (tmp_path / "w/grounded_runner.py").exists()


def test_a_target_beyond_safety_is_told_when_it_is_drawn(tmp_path):
    made = workspaces.make(tmp_path / "w")
    file = made.folder / "grounded.toml"
    file.write_text(re.sub(r"(?m)^\[safety\]\n(?:\w.*\n)*", "", file.read_text()))
    file.write_text(file.read_text() + "\n[safety]\nx = [-2.0, 2.0]\n")
    near = grounded("-C", made.folder, "target", "step", "--to", "x=1.5")
    far = grounded("-C", made.folder, "target", "step", "--to", "x=60")
    assert near.code == far.code == 0
    assert "[safety]" not in near.err and "[safety]" in far.err and "60" in far.err


@pytest.mark.parametrize(
    ("rows", "words"),
    [("0.1,1.5", ()), ("{sine:.4f},1.5", ("--inputs", "force"))],
    ids=["nothing changes", "the input is constant"],
)
def test_a_log_in_which_nothing_to_learn_from_changes_is_refused(tmp_path, rows, words):
    lines = [f"{0.05 * k:.2f},{rows.format(sine=math.sin(k))}" for k in range(100)]
    (tmp_path / "off.csv").write_text("\n".join(["t,x,force", *lines]) + "\n")
    done = grounded("init", tmp_path / "w", "--from", tmp_path / "off.csv", *words)
    assert done.code == 1 and not (tmp_path / "w").exists()
