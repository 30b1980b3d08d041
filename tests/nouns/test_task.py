"""Models, tasks, rewards and trials: their checks, a hash of what a utility depends on, by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from facts import holding
from grounded.checks import near
from grounded.errors import GroundedError
from grounded.frozen import readonly
from grounded.model import Model, Param
from grounded.rollout import simulate
from grounded.share import share_of
from grounded.solve.bias import ground
from grounded.trial import Trial, interpolate_gaps
from grounded.utility import Reward, step_rewards
from small_tasks import black_box, cart, cart_dynamics, cart_task, other, rover, rover_task

REWARD = Reward(np.array([10.0, 0.0]), np.zeros(2), np.array([0.01]), np.array([0.01]))
NAN = float("nan")
WRONG = {  # a field, what it may not be, and what the message names
    "dt": ([0.0, NAN, -0.1, "0.05"], ["dt"]),
    "start": ([np.zeros(3), np.array([NAN, 0.0])], ["start"]),
    "low": ([np.zeros(2), np.array([5.0]), np.array([NAN]), None], []),
    "past": ([np.array([9.0]), np.array([NAN])], ["before the start"]),
    "latency": ([np.array([-0.1]), np.array([2.6]), np.array([NAN])], ["latency of force"]),
    "target": ([np.zeros((1, 2)), np.zeros((0, 2)), None, np.zeros(41), np.zeros((2, 41))], []),
    "feedback": (["no"], ["feedback", "'no'"]),
    "input_target": ([np.zeros((41, 1))], ["input_target", "(40, 1)"]),
    "safety_low": ([np.array([1.0, 0.0])], ["[safety] x"]),
    "smoothing": ([-1.0], ["smoothing"]),
    "reward": ([{"x": 1.0}], ["reward", "dict"]),
    "model": ([cart_task], ["model", "function"]),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_does_not_fit_is_refused(name):
    values, named = WRONG[name]
    for value in values:
        with pytest.raises(GroundedError, match=holding(*named)):
            cart_task(**{"safety_high": np.array([-1.0, 1.0])} | {name: value})


def test_a_weighted_state_needs_a_target():
    target = np.array(cart_task().target)
    target[5, 0] = np.nan
    with pytest.raises(GroundedError, match=holding("x", "step 5")):
        cart_task(target=target)


HASHED = {
    "dt": 0.06,
    "feedback": False,
    "start": np.array([0.0, 0.1]),
    "past": np.array([0.1]),
    "low": np.array([-4.0]),
    "high": np.array([4.0]),
    "target": cart_task().target + 0.001,
    "reward": replace(REWARD, terminal=np.array([1.0, 0.0]), state=np.array([10.0, 0.0])),
    "input_target": np.full((40, 1), 0.1),
}


@pytest.mark.parametrize("name", HASHED)
def test_the_hash_changes_with_what_a_utility_depends_on(name):
    assert cart_task(**{name: HASHED[name]}).hash != cart_task().hash


def test_the_hash_stays_with_what_plans_only():
    task = cart_task()
    assert task.hash == cart_task().hash and len(task.hash) == 16
    assert task.with_model(other(cart)).hash == task.hash
    for change in (
        {"latency": np.array([0.1])},
        {"smoothing": 0.2},
        {"safety_low": np.array([-1.0, -1.0])},
    ):
        assert cart_task(**change).hash == task.hash


def test_an_open_loop_task_has_policies_without_gains():
    task = cart_task(feedback=False)
    made = task.policy(np.zeros((40, 1)), np.ones((40, 1, 3)), np.zeros((40, 3)))
    assert made.gain is None and made.reference is None


def test_nouns_with_arrays_are_shown_in_one_short_line():
    found = cart_task()
    policy = found.policy(np.zeros((found.horizon, found.model.m)), None, None)
    run = simulate(found.problem(), policy)
    for noun in (found, policy, run):
        shown = repr(noun)
        assert "\n" not in shown and len(shown) < 120, shown
        assert shown.startswith(f"{type(noun).__name__}(") and str(found.horizon) in shown


def by_hand(task, trial):
    """- sum W (s - target)^2 + R (a - a_target)^2 + S (a_t - a_{t-1})^2, in plain loops."""
    names, total = task.model.state_names, 0.0
    held = task.past if trial.start_inputs is None else trial.start_inputs
    for t in range(trial.steps + 1):
        for i, name in enumerate(names):
            if math.isnan(task.target[t, i]):
                continue
            d = trial.states[t, i] - task.target[t, i]
            if name in task.model.angles:
                d = math.atan2(math.sin(d), math.cos(d))
            weight = task.reward.state[i]
            if t == task.horizon:
                weight += task.reward.terminal[i]
            total -= weight * d * d
    for t in range(trial.steps):
        for j in range(task.model.m):
            before = held[j] if t == 0 else trial.inputs[t - 1, j]
            now = trial.inputs[t, j]
            total -= task.reward.input[j] * (now - task.input_target[t, j]) ** 2
            total -= task.reward.input_change[j] * (now - before) ** 2
    return total


def random_trial(task, seed=0, **changes):
    rng = np.random.default_rng(seed)
    H, n, m = task.horizon, task.model.n, task.model.m
    return Trial(
        states=10 * rng.normal(size=(H + 1, n)),
        inputs=rng.normal(size=(H, m)),
        dt=task.dt,
        state_names=task.model.state_names,
        input_names=task.model.input_names,
        **changes,
    )


@pytest.mark.parametrize("make", [cart_task, rover_task])
def test_utility_by_hand(make):
    task = make()
    task = replace(
        task, input_target=np.random.default_rng(1).normal(size=(task.horizon, task.model.m))
    )
    for seed in range(5):
        trial = random_trial(task, seed)
        assert task.utility(trial) == pytest.approx(by_hand(task, trial), rel=1e-12)
        assert task.rewards(trial).shape == (task.horizon + 1,)
        assert (task.rewards(trial) <= 0).all()


def test_the_input_held_before_the_start_is_the_trials():
    task = cart_task()
    plain, held = random_trial(task), random_trial(task, start_inputs=np.array([3.0]))
    assert task.utility(held) == pytest.approx(by_hand(task, held), rel=1e-12)
    assert task.utility(held) != task.utility(plain)


def test_the_model_judges_as_reality_does():
    task = rover_task()
    u = np.clip(np.random.default_rng(2).normal(size=(60, 2)), task.low, task.high)
    run = simulate(task.problem(exact=True), task.policy(u, None, None))
    trial = Trial(run.states, run.inputs, task.dt, ("x", "y", "psi"), ("speed", "turn"))
    assert run.utility == pytest.approx(task.utility(trial), rel=1e-12)


def test_short_and_unfinite_trials_have_no_utility():
    task = cart_task()
    whole = random_trial(task)
    cut = replace(whole, states=whole.states[:31], inputs=whole.inputs[:30])
    assert task.utility(cut) == -np.inf
    assert task.rewards(cut).shape == (31,) and np.isfinite(task.rewards(cut)).all()
    for where in (0, 17, 40):
        states = np.array(whole.states)
        states[where] = np.nan
        assert task.utility(replace(whole, states=states)) == -np.inf
    inputs = np.array(whole.inputs)
    inputs[39] = np.inf
    assert task.utility(replace(whole, inputs=inputs)) == -np.inf


def test_a_change_is_paid_where_it_happens():
    reward = Reward(np.zeros(1), np.zeros(1), np.zeros(1), np.array([2.0]))
    u = np.array([[0.0], [0.0], [3.0], [3.0]])
    found = step_rewards(reward, np.zeros((5, 1)), u, np.zeros((4, 1)), np.zeros(1))
    np.testing.assert_array_equal(found, [0, 0, -18, 0, 0])


def test_what_follows_the_horizon_is_not_judged():
    task = cart_task()
    whole = random_trial(task)
    longer = replace(
        whole,
        states=np.vstack([whole.states, np.full((3, 2), np.nan)]),
        inputs=np.vstack([whole.inputs, np.full((3, 1), 9.0)]),
    )
    assert task.utility(longer) == task.utility(whole)
    np.testing.assert_array_equal(ground(task, longer).bias, ground(task, whole).bias)


def model(**changes):
    fields = {
        "name": "toy",
        "states": {"x": "m", "v": "m/s"},
        "inputs": {"force": "N"},
        "params": {"mass": Param(1.0), "drag": Param(0.2)},
        "derivative": cart_dynamics,
    }
    return Model(**fields | changes)


def test_names_are_in_the_order_of_declaration():
    assert (rover.n, rover.m) == (3, 2)
    assert rover.state_names == ("x", "y", "psi") and rover.input_names == ("speed", "turn")
    assert rover.param_names == ("gain", "yaw", "dead")
    np.testing.assert_array_equal(rover.values, [1.0, 1.0, 0.05])
    np.testing.assert_array_equal(rover.angle_mask, [False, False, True])


def test_differences_of_angles_wrap_and_the_arguments_stay():
    a, b = np.array([[1.0, 0.0, 3.1]]), np.array([[0.0, 0.0, -3.1]])
    kept = a.copy()
    np.testing.assert_allclose(rover.difference(a, b), [[1.0, 0.0, 6.2 - 2 * np.pi]])
    np.testing.assert_array_equal(a, kept)
    np.testing.assert_allclose(rover.difference(a + 4 * np.pi, a)[0, 2], 0.0, atol=1e-12)
    assert np.isnan(rover.difference(np.array([0, 0, np.nan]), b[0])[2])


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"derivative": None}, holding("exactly one", "derivative=")),
        ({"step": cart_dynamics}, holding("exactly one", "derivative=")),
        ({"integrator": "heun"}, holding("rk4", "euler", "'heun'")),
        ({"states": {}}, holding("state")),
        ({"inputs": {}}, holding("input", "free motion", "column of zeros")),
        ({"inputs": {"x": "N"}}, holding("'x'", "twice")),
        ({"params": {"mass": 1.0}}, holding("'mass'", "Param", "float")),
        ({"params": {"v": Param(1.0)}}, holding("'v'", "state", "parameter")),
        ({"states": {"my state": "m"}}, holding("'my state'")),
        ({"angles": ("psi",)}, holding("angle", "'psi'", "x and v")),
        ({"angles": ("vv",)}, holding("angle", "'vv'", "'v'")),
        ({"roles": {"position": ("x", "y")}}, holding("position", "'y'")),
        ({"roles": {"position": ("x", "x", "x", "x")}}, holding("position", "three")),
        ({"roles": {"positon": "x"}}, holding("positon", "did you mean", "position")),
    ],
    ids=lambda v: " ".join(v) if isinstance(v, dict) else str(v)[:40],
)
def test_a_wrong_declaration_says_what_is_wrong(change, match):
    with pytest.raises(GroundedError, match=match):
        model(**change)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        *((lambda bad=bad: Param(bad), "finite") for bad in (np.nan, np.inf, -np.inf)),
        (lambda: Param(2.0, "1", 0.0, 1.0), holding("2.0", "0 to 1")),
        (lambda: Param(0.5, "1", 1.0, 0.0), holding("1.0", "0.0")),
        (lambda: Param(0.5, std=0.0), None),
        *(
            (lambda bad=bad: replace(REWARD, input=np.array([bad])), holding("[reward] input"))
            for bad in (-1.0, np.nan, np.inf)
        ),
    ],
)
def test_parameters_and_weights_are_numbers_within_their_bounds(make, match):
    with pytest.raises(GroundedError, match=match):
        make()


def test_a_parameter_says_where_it_stops_and_how_far_it_reaches():
    two = Param(0.5, "1", 0.0, 1.0)
    assert two.at_bound(0.0) and two.at_bound(1.0) and not two.at_bound(0.999)
    assert not Param(0.5, std=0.1).at_bound(0.5) and not Param(0.5).at_bound(0.5)
    assert not two.stopped(0.9) and two.stopped(1.0) == "bound" and not Param(0.5).stopped(0.5)
    prior = Param(0.5, std=0.1)
    assert prior.reach == pytest.approx((0.2, 0.8)) and prior.stopped(prior.reach[1]) == "prior"
    assert not prior.stopped(0.799) and Param(-0.5, std=1.0).reach == (-3.5, -0.1)
    assert Param(0.5, "1", 0.0, 1.0, std=0.1).stopped(0.8) == "prior"
    assert not Param(0.5).uncertain and not Param(0.5, "1", 0.5, 0.5).uncertain
    assert Param(0.5, "1", 0.0, 1.0).spread == pytest.approx(1 / 12**0.5)
    assert Param(0.5, std=0.1).spread == 0.1 and Param(0.5, std=0.1).uncertain


def test_other_values_make_a_copy_and_widen_bounds():
    changed = cart.with_values({"mass": 20.0})
    assert cart.params["mass"].value == 1.0 and changed.params["mass"].value == 20.0
    assert changed.params["mass"].high == 20.0 and changed.params["mass"].low == 0.1
    assert changed.params["mass"].unit == "kg" and changed.values[0] == 20.0
    with pytest.raises(GroundedError, match=holding("'mas'", "'cart'", "'mass'")):
        cart.with_values({"mas": 1.0})


def test_what_was_declared_cannot_be_changed():
    with pytest.raises(TypeError):
        cart.states["z"] = "m"  # type: ignore[index]
    with pytest.raises(ValueError, match="read-only"):
        cart.values[0] = 3.0


def test_rk4_and_euler_by_hand():
    x, u = np.array([[0.5, 2.0]]), np.array([[3.0]])
    rate = np.array([2.0, 3.0 - 0.2 * 2.0])
    euler = model(integrator="euler")
    np.testing.assert_allclose(
        euler.system.step(x, u, euler.values, 0.1)[0], x[0] + 0.1 * rate, atol=1e-15
    )
    # v' = f - d v has the solution v(t) = f/d + (v0 - f/d) exp(-d t); RK4 is exact to h^5
    rk4 = model()
    v = 15.0 + (2.0 - 15.0) * np.exp(-0.2 * 0.1)
    assert rk4.system.step(x, u, rk4.values, 0.1)[0, 1] == pytest.approx(v, abs=1e-9)


def test_a_black_box_step_is_a_model_too():
    x, u = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.zeros((2, 1))
    v = [-0.1, 0.2]
    found = black_box.system.step(x, u, black_box.values, 0.1)
    np.testing.assert_allclose(found, [[1 - 0.01, v[0]], [-1 + 0.02, v[1]]], atol=1e-12)
    f_x, f_u = black_box.system.linearise(x, u, black_box.values, 0.1)
    np.testing.assert_allclose(f_x[0], [[1 - 0.01, 0.1], [-0.1, 1.0]], atol=1e-6)
    np.testing.assert_allclose(f_x[1], [[1 - 0.02, 0.1], [-0.2, 1.0]], atol=1e-6)
    np.testing.assert_allclose(f_u[:, :, 0], [[0.01, 0.1]] * 2, atol=1e-6)


def test_the_nearest_name():
    assert near("steerng", ["steering", "throttle"]) == {"near": "steering"}
    assert near("zzz", ["a", "b"]) == {"known": ("a", "b")}


def trial(T=5, **changes):
    fields = {
        "states": np.arange(2.0 * (T + 1)).reshape(T + 1, 2),
        "inputs": np.zeros((T, 1)),
        "dt": 0.1,
        "state_names": ("x", "v"),
        "input_names": ("u",),
    }
    return Trial(**fields | changes)


UNFIT = {  # a field, and what it may not be
    "states": [np.zeros((6, 3)), np.zeros(6), None, np.zeros((2, 6)), [[0.0, 0.0], [1.0]]],
    "inputs": [np.zeros((6, 1)), np.zeros((5, 2)), np.zeros(5), np.zeros((1, 5))],
    "start_inputs": [0.0, np.zeros(2)],
    "input_names": ["u"],
    "dt": [0.0, "0.1"],
}


@pytest.mark.parametrize("name", UNFIT)
def test_arrays_must_fit(name):
    for value in UNFIT[name]:
        with pytest.raises(GroundedError, match=name):
            trial(**{name: value})


def test_names_in_a_list_are_as_good():
    assert trial(state_names=["x", "v"]).state_names == ("x", "v")


def test_a_trial_is_a_copy_that_stays():
    states = np.zeros((6, 2))
    made = trial(states=states)
    states[:] = 7.0
    assert made.states.max() == 0.0
    with pytest.raises(ValueError, match="read-only"):
        made.states[0, 0] = 1.0
    assert readonly(made.states) is made.states


@pytest.mark.parametrize("T", [0, 1, 5])
def test_steps(T):
    made = trial(T)
    assert made.steps == T and made.finite_steps == T


def test_a_recording_that_stops_a_step_or_two_early_goes_on():
    states = np.column_stack([0.1 * np.arange(41.0), np.ones(41)])
    run = trial(40, states=states, inputs=np.linspace(0, 1, 40)[:, None])
    short = run.until(38).whole(40)
    np.testing.assert_allclose(short.states, run.states)
    assert short.inputs[-2:, 0] == pytest.approx([run.inputs[37, 0]] * 2)
    assert run.until(37).whole(40).steps == 37  # three steps short: it ended early
    assert run.whole(38).steps == 38 and trial(5).whole(6).steps == 5
    lost = np.where(np.arange(39)[:, None] == 38, np.nan, states[:39])
    assert trial(38, states=lost).whole(40).steps == 38


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e200])
def test_finite_steps_end_before_the_first_bad_number(bad):
    for k in range(6):
        states = np.zeros((6, 2))
        states[k, 1] = bad
        assert trial(states=states).finite_steps == k - 1  # s_{k-1} is the last state known
    for k in range(5):
        inputs = np.zeros((5, 1))
        inputs[k] = bad
        assert trial(inputs=inputs).finite_steps == k  # s_k is known, and what led to it


def test_a_trial_is_shown_in_one_short_line():
    long = Trial(np.zeros((501, 2)), np.zeros((500, 1)), 0.02, ("q", "w"), ("u",), id="t0007")
    shown = repr(long)
    assert "\n" not in shown
    assert len(shown) < 100
    assert all(part in shown for part in ("t0007", "500", "0.02", "q, w"))


def gappy(gaps=(), T=60, dt=0.05):
    t = dt * np.arange(T + 1)
    states = np.column_stack([t, np.sin(t)])
    for first, last, column in gaps:
        states[first:last, column] = np.nan
    return Trial(states, np.zeros((T, 1)), dt, ("x", "v"), ("u",))


def test_short_gaps_are_straight_lines():
    found = interpolate_gaps(gappy([(5, 9, 0), (30, 40, 1)]))
    np.testing.assert_allclose(found.trial.states[:, 0], gappy().states[:, 0], atol=1e-12)
    assert np.abs(found.trial.states[:, 1] - gappy().states[:, 1]).max() < 0.05
    assert (found.samples, found.state) == (14, "v")
    assert found.longest_s == pytest.approx(0.5) and found.at_s == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("gaps", "filled", "steps"),
    [
        ([(10, 30, 0)], 20, 60),  # a second
        ([(10, 31, 0)], 0, 9),  # longer
        ([(56, 61, 1)], 0, 55),  # to the end
        ([(0, 2, 0), (10, 12, 1)], 0, -1),  # the first state must be known
    ],
)
def test_gaps_of_up_to_a_second_between_known_states_are_filled(gaps, filled, steps):
    found = interpolate_gaps(gappy(gaps))
    assert (found.samples, found.trial.finite_steps) == (filled, steps)


def test_inputs_are_never_invented():
    whole = gappy([(5, 6, 0)])
    inputs = np.array(whole.inputs)
    inputs[20] = np.nan
    found = interpolate_gaps(Trial(whole.states, inputs, 0.05, ("x", "v"), ("u",)))
    assert found.samples == 1 and found.trial.finite_steps == 20


def many(*steps):
    return [
        Trial(np.zeros((T + 1, 1)), np.zeros((T, 1)), 0.1, ("x",), ("u",), id=f"t{i}")
        for i, T in enumerate(steps)
    ]


@pytest.mark.parametrize("steps", [[10] * 1000, [1000], [5, 400, 5, 5], [90, 90, 90]])
def test_a_share_stays_within_the_budget_and_says_which_it_is(steps):
    found = share_of(many(*steps), 100)
    assert 0 < sum(trial.steps for trial in found.trials) <= 100
    assert found.finding is not None and found.finding.facts["total"] == sum(steps)


def test_whole_trials_are_taken_at_equal_distances():
    found = share_of(many(*[10] * 100), 110)
    numbers = [int(trial.id[1:]) for trial in found.trials]
    assert numbers[0] == 0 and numbers[-1] == 99 and np.ptp(np.diff(numbers)) <= 1
    assert all(trial.steps == 10 for trial in found.trials)


def test_a_share_is_all_that_fits_or_as_many_trials_as_are_asked_for():
    given = many(10, 20)
    found = share_of(given, 30)
    assert found.trials == given and found.finding is None
    assert len(share_of(many(*[2] * 50), 1000, 10).trials) == 10
