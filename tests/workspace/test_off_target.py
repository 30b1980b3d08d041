"""How far a run is off its target, in units: the numbers that a utility does not say."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cli import grounded
from facts import holds
from grounded import Model, Task, Trial
from grounded.task import Reward
from grounded_trials import Workspace
from grounded_trials.report.findings import AT_END, improvements_in
from grounded_trials.report.gathering import gather
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.off_target import (
    off_target_of,
    position_axes,
    reaches,
    traded,
)
from reported import cart, copied

__all__ = ["cart"]

ROVER = Model(
    states={"x": "m", "y": "m", "psi": "rad", "v": "m/s"},
    inputs={"turn": "rad/s", "push": "m/s^2"},
    params={},
    angles=("psi",),
    roles={"position": ("x", "y")},
    derivative=lambda s, a, p: {
        "x": s.v * np.cos(s.psi),
        "y": s.v * np.sin(s.psi),
        "psi": a.turn,
        "v": a.push,
    },
)
H, DT = 20, 0.1


def task(**weights):
    target = np.zeros((H + 1, 4))
    target[:, 3] = np.nan  # the speed is free
    none = {"state": np.zeros(4), "input": np.ones(2), "input_change": np.ones(2)}
    none["terminal"] = np.zeros(4)
    return Task(
        ROVER,
        DT,
        target,
        Reward(**none | weights),
        start=np.zeros(4),
        past=np.zeros(2),
        low=np.full(2, -1.0),
        high=np.ones(2),
    )


def run(states):
    names = (ROVER.state_names, ROVER.input_names)
    return Trial(states, np.zeros((len(states) - 1, 2)), DT, *names)


def test_a_height_that_is_part_of_the_position_counts_once():
    """A quadrotor in a plane: (x, z) and the altitude z were sqrt(x^2 + 2 z^2)."""
    plane = replace(ROVER, roles={"position": ("x", "y"), "altitude": "y"})
    assert position_axes(plane) == position_axes(ROVER) == [0, 1]
    assert position_axes(replace(ROVER, roles={**ROVER.roles, "altitude": "v"})) == [0, 1, 3]


def off(x=0.0, y=0.0, psi=0.0, steps=H):
    states = np.zeros((steps + 1, 4))
    states[:, 0], states[:, 1], states[:, 2] = x, y, psi
    return states


ALONG = {"state": np.array([1.0, 1.0, 0.1, 0.0])}


def test_the_position_is_one_distance_and_angles_are_wrapped():
    states = off(0.003, 0.004, 2 * np.pi - 0.01)
    states[15, :2] = (0.03, 0.04)
    position, psi = off_target_of(task(**ALONG), [run(states)])
    assert (position.what, position.unit) == ("position", "m")
    assert position.most == pytest.approx(0.05) and position.at_s == pytest.approx(1.5)
    assert position.rms == pytest.approx(math.sqrt((20 * 0.005**2 + 0.05**2) / 21))
    assert math.isnan(position.end)
    assert (psi.what, psi.most) == ("psi", pytest.approx(0.01))
    assert holds(position.summary(), "position", "12 mm rms", "50 mm at most", "at 1.5 s")


def test_repeats_count_together_and_the_worst_of_all_is_told():
    runs = [run(off(0.01)), run(off(0.03))]
    position, _ = off_target_of(task(**ALONG), runs)
    assert position.rms == pytest.approx(math.sqrt((0.01**2 + 0.03**2) / 2))
    assert position.most == pytest.approx(0.03)


def test_what_only_the_end_weighs_is_told_there():
    states = off(0.5)
    states[-1, 0] = 0.002
    (position,) = off_target_of(task(terminal=np.array([1.0, 1.0, 0.0, 0.0])), [run(states)])
    assert math.isnan(position.rms) and position.end == pytest.approx(0.002)
    assert holds(position.summary(), "2.0 mm at the end")
    both = off_target_of(task(terminal=np.array([1.0, 1.0, 0.1, 0.0]), **ALONG), [run(states)])[0]
    assert both.rms > 0.4 and both.end == pytest.approx(0.002)


def test_an_error_at_the_end_has_its_standard_error():
    """The same boat ended "65 mm", "131 mm" and "87 mm" off: single samples with 16 mm of noise."""
    weights = {"terminal": np.array([1.0, 1.0, 0.0, 0.0])}
    noise = np.random.default_rng(0).normal(0.0, 0.016, (3, H + 1, 2))
    runs = []
    for one in noise:
        states = off(0.1)
        states[:, :2] += one
        runs.append(run(states))
    (alone,) = off_target_of(task(**weights), runs[:1])
    assert alone.end_std == pytest.approx(0.016, rel=0.4) and alone.runs == 1
    assert holds(alone.summary(), "at the end (+- ", "mm by noise alone, from one run)")
    (several,) = off_target_of(task(**weights), runs)
    ends = [np.hypot(*one.states[-1, :2]) for one in runs]
    least = float(np.std(ends, ddof=1)) / 3**0.5
    assert several.end_std >= least * 0.999 and several.runs == 3
    assert holds(several.summary(), "by 3 runs)")
    (exact,) = off_target_of(task(**weights), [run(off(0.1))])
    assert exact.end_std == pytest.approx(0.0, abs=1e-12) and "+-" not in exact.summary()


def test_an_encoder_that_rests_on_one_count_is_known_no_better_than_that():
    count, states = 0.002, off(0.1)
    states[:, 0] = count * np.round(np.minimum(np.linspace(0.0, 15.0, H + 1), 12.0))
    (told,) = off_target_of(task(terminal=np.array([1.0, 0.0, 0.0, 0.0])), [run(states)])
    assert told.noise >= 0.99 * count / 12**0.5


ARM = Model(
    states={"shoulder": "rad", "elbow": "rad", "d_shoulder": "rad/s", "d_elbow": "rad/s"},
    inputs={"a": "1", "b": "1"},
    params={},
    derivative=lambda s, a, p: {
        "shoulder": s.d_shoulder,
        "elbow": s.d_elbow,
        "d_shoulder": a.a,
        "d_elbow": a.b,
    },
)


def test_angles_are_told_before_their_rates_whatever_those_cost():
    """Of an arm that stopped 5 degrees off, only how fast it still turned was told.

    And of one whose elbow swung, only angles, though the swing was most of what it cost.
    """
    arm = replace(task(), model=ARM, target=np.zeros((H + 1, 4)))
    states = off(0.09, 0.02)
    states[:, 2:] = 3.0, 4.0
    trial = replace(run(states), state_names=ARM.state_names, input_names=ARM.input_names)

    def told(**weights):
        reward = replace(arm.reward, **{k: np.array(v, float) for k, v in weights.items()})
        return [one.what for one in off_target_of(replace(arm, reward=reward), [trial])]

    assert told(terminal=[1, 1, 1, 1]) == ["shoulder", "elbow", "d_elbow"]
    assert told(terminal=[1, 1, 1, 0.5]) == ["shoulder", "elbow", "d_shoulder"]
    assert told(terminal=[1, 1, 1e-6, 1e-6]) == ["shoulder", "elbow"]
    assert told(terminal=[1, 0, 1, 1]) == ["shoulder", "d_elbow"]
    assert told(terminal=[0, 0, 1, 1]) == ["d_shoulder", "d_elbow"]


def test_where_something_is_to_be_reached_the_end_is_told_without_a_weight_of_its_own():
    """The page of a task to get somewhere gave the rms over the way, and not where it ended."""
    goal = replace(task(**ALONG), start=np.array([-1.0, 0.0, 0.0, 0.0]))
    states = off(0.5)
    states[-1, :2] = 0.003, 0.004
    position, _ = off_target_of(goal, [run(states)])
    assert position.rms > 0.4 and position.end == pytest.approx(0.005)
    s = np.linspace(0, 1, H + 1)
    way = np.zeros((H + 1, 4))
    way[:, 0] = 10 * s**3 - 15 * s**4 + 6 * s**5
    assert reaches(goal) and not reaches(task(**ALONG))  # which is to stay
    assert not reaches(replace(goal, target=np.outer(s, [1.0, 0, 0, 0])))  # and one to go on
    assert reaches(replace(goal, start=np.zeros(4), target=way))


def test_a_run_that_ended_early_has_no_end_and_a_lost_one_no_line():
    states = off(0.5, steps=10)
    (position,) = off_target_of(task(terminal=np.array([1.0, 1.0, 0.0, 0.0])), [run(states)])
    assert position.rms == pytest.approx(0.5) and math.isnan(position.end)
    assert off_target_of(task(**ALONG), [run(np.full((11, 4), np.nan))]) == ()
    free = replace(task(), target=np.full((H + 1, 4), np.nan))
    assert off_target_of(free, [run(off(0.5))]) == () == off_target_of(task(**ALONG), [])


def test_status_and_the_page_name_the_states_in_one_order(cart):
    """A ball's page began with its speed, `status` with its place."""
    findings = gather(Folder(cart))
    reward = replace(findings.task.reward, state=np.array([1.0, 1e4]))  # the speed costs most
    target = np.where(np.isfinite(findings.task.target), findings.task.target, 0.0)
    task = replace(findings.task, reward=reward, target=target)
    findings = replace(findings, task=task)
    told = off_target_of(findings.task, [run.trial for run in findings.runs])
    shown = [one.what.removeprefix(AT_END)[0] for one in improvements_in(findings)]
    assert [one.what for one in told] == ["x", "v"] == list(dict.fromkeys(shown))


def test_status_and_ingest_say_the_number_of_the_page(cart, tmp_path):
    """Five commands gave `utility -0.155`, and no metre."""
    folder = copied(cart, tmp_path / "cart")
    w = Workspace(folder)
    (told, *_) = w.status().off_target
    shown = next(one for one in improvements_in(gather(Folder(folder))) if told.what in one.what)
    assert told.rms == pytest.approx(shown.after)
    out = grounded("-C", folder, "status").out
    assert f"off target {told.summary()}" in " ".join(out.split())
    document = w.status().to_json()["best"]["off_target"][0]
    assert (document["what"], document["rms"]) == (told.what, pytest.approx(told.rms))
    best = w.trials()[-1]
    again = w.ingest(best.stored.path)
    assert again.off_target == off_target_of(w.task, [best.trial])
    assert again.to_json()["off_target"][0]["unit"] == told.unit
    out = grounded("-C", folder, "ingest", best.stored.path).out
    assert again.off_target[0].summary() in " ".join(out.split())


def test_propose_says_how_far_the_predicted_run_is_off(cart, tmp_path):
    """It gave a predicted utility alone, beside which nobody could set ingest's centimetres."""
    folder = copied(cart, tmp_path / "cart")
    w = Workspace(folder)
    way = np.linspace(0, 1, w.task.horizon + 1)
    w.target({"x": 0.3 * way**2 * (3 - 2 * way)})
    proposed = w.propose()
    target = w.task.target[:, 0]
    error = np.abs(proposed.candidate.predicted_states[:, 0] - target)
    told = next(one for one in proposed.off_target if one.what == "x")
    assert told.rms == pytest.approx(np.sqrt(np.mean(error**2))) and told.most == error.max() > 0
    out = " ".join(grounded("-C", folder, "propose").out.split())
    assert f"off target: {told.summary()}" in out
    assert proposed.to_json()["off_target"][0]["what"] == "x"


def test_a_better_candidate_that_is_farther_off_says_what_it_gained_by():
    """The path went from 0.5 to 0.85 cm, and the candidate was the best so far: no word why."""
    here = task(state=np.array([1.0, 1.0, 0.0, 0.0]))
    rough = np.tile([[1.0, 0.0], [0.0, 1.0]], (H // 2, 1))

    def tried(name, off, inputs, start=0.0):
        states = np.zeros((H + 1, 4))
        states[1:, 0], states[0, 1] = off, start
        trial = Trial(states, inputs, DT, ROVER.state_names, ROVER.input_names)
        utility = here.utility(trial)
        made = SimpleNamespace(id=name, predicted_states=np.zeros((H + 1, 4)))
        return SimpleNamespace(candidate=made, trials=(trial,), utility=utility)

    before, best = tried("c0001", 0.01, rough), tried("c0002", 0.02, 0 * rough)
    assert best.utility > before.utility
    assert holds(traded(here, best, before), "c0002", "c0001", "inputs cost less", "20 mm")
    assert traded(here, tried("c0003", 0.01, 0 * rough), before) == ""
    # 3.3 mm and 4.5 mm, after a start 10 mm beside the path: the plan was no worse
    assert traded(here, tried("c0002", 0.02, 0 * rough, start=0.03), before) == ""


def test_a_better_candidate_that_is_farther_off_names_the_state_that_came_nearer():
    """`because other states are nearer to theirs` named none: a crane's speed at the end."""
    here = task(state=np.array([1.0, 1.0, 1.0, 0.0]), terminal=np.array([0.0, 0.0, 1e3, 0.0]))

    def tried(name, off, psi, end):
        states = np.zeros((H + 1, 4))
        states[1:, 0], states[1:-1, 2], states[-1, 2] = off, psi, end
        own = run(states)
        candidate = SimpleNamespace(id=name, predicted_states=np.zeros((H + 1, 4)))
        return SimpleNamespace(candidate=candidate, trials=(own,), utility=here.utility(own))

    ends = traded(here, tried("c0002", 0.02, 0.1, 0.11), tried("c0001", 0.01, 0.1, 0.23))
    assert holds(ends, "psi is nearer to its target (0.11 rad at the end instead of 0.23 rad)")
    way = traded(here, tried("c0002", 0.02, 0.1, 0.0), tried("c0001", 0.01, 0.3, 0.0))
    assert "rms instead of 0.29 rad)" in way


def test_an_error_at_the_end_below_the_noise_of_a_sample_is_called_that():
    """2.4 mm -> 0.41 mm, single readings of a sensor with 2 mm noise, while nothing improved."""
    rng, weights = np.random.default_rng(5), np.array([1.0, 1.0, 0.0, 0.0])
    mine = task(state=weights, terminal=weights)
    states = 0.002 * rng.standard_normal((H + 1, 4)) + np.linspace(0.05, 0.0, H + 1)[:, None]
    states[-1, :2] = 2e-4
    (position,) = off_target_of(mine, [run(states)])[:1]
    assert position.noise == pytest.approx(0.0028, rel=0.5) and position.end < position.noise
    assert "at the end within its noise of" in position.summary()
    smooth = np.linspace(0.05, 2e-4, H + 1)[:, None] * np.ones(4)
    (position,) = off_target_of(mine, [run(smooth)])[:1]
    assert position.summary().endswith("mm at the end")
