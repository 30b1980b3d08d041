"""What `propose` says of earlier predictions is the number of the column `predicted`."""

import math
from types import SimpleNamespace

import pytest

from grounded.search.candidate import Candidate, Tried
from grounded.search.standing import Standing
from grounded_cli.propose import _by_itself, _came_true, _predicted, _samples, _so_far, _what
from grounded_trials import Workspace
from workspaces import make


def test_a_prediction_has_one_value_and_the_noise_of_its_log_is_named():
    """-0.01340 and -0.01330 were both called the last prediction."""
    made = SimpleNamespace(id="c0001", grounded=False, predicted_utility=-0.0133)
    run = SimpleNamespace(id="t0001")
    tried = Tried(made, (run,), (-0.02,), True, noise_missed=1e-4)
    said = _came_true(made, [tried], SimpleNamespace(incumbent=None, history=(tried,)))
    assert said.index("-0.01330") < said.index("or -0.01340 with sensor noise")
    twice = _came_true(made, [tried, tried], SimpleNamespace(incumbent=None, history=(tried,)))
    assert "with sensor noise, missed the utility by 0.0066" in twice


@pytest.mark.parametrize(("cost", "told"), [(0.45, True), (0.1, False), (float("nan"), False)])
def test_where_a_run_began_is_no_error_of_its_prediction(cost, told):
    """0.48 were missed, it said, beside the same run predicted to 0.03 from where it began."""
    made = SimpleNamespace(id="c0001", grounded=False, predicted_utility=-0.2)
    run, starts = SimpleNamespace(id="t0001"), SimpleNamespace(cost=lambda tried: cost)
    tried = Tried(made, (run,), (-0.68,), True, starts=starts)
    now = SimpleNamespace(incumbent=None, history=(tried,))
    said = _came_true(made, [tried], now)
    assert ("or -0.6500 from where its run began, the real run gave -0.6800" in said) == told
    twice = _came_true(made, [tried, tried], now)
    assert ("from where runs began, missed the utility by 0.03" in twice) == told
    assert ("missed the utility by 0.48" in twice) != told


def test_gentler_gains_promise_no_gain_and_steps_from_them_say_why_they_are_gentle():
    """Those of an arm "promised a gain of 0.8135", all of its cost, and lost as much."""
    made = SimpleNamespace(id="c0002", way="gentler gains", predicted_utility=-1e-3)
    best = SimpleNamespace(candidate=made, utility=-0.8, promised=-1e-3)
    best.trials, best.utilities, best.starts = (SimpleNamespace(id="t0001"),), (-0.8,), None
    next_one = SimpleNamespace(id="c0003", way="gentler gains", promised_over=lambda best: 0.8)
    said = _came_true(next_one, [best], SimpleNamespace(incumbent=best, history=(best,)))
    assert "promises" not in said and "does not swing with any gains" in said
    step = SimpleNamespace(base="c0001", way="", damping=1.0, alpha=1.0, iteration=1)
    step.of_corrected = step.of_original = False
    task = SimpleNamespace(horizon=100, dt=0.01)
    for step.caution, told in ((0.0, False), (0.4, True)):
        assert ("as low as ran without oscillating" in _what(step, None, task)) == told


@pytest.mark.parametrize(
    ("replayed", "runs", "told"), [(0.007, 1, True), (0.003, 1, False), (0.007, 2, False)]
)
def test_a_gain_below_the_noise_that_a_plan_replays_is_told_as_that(replayed, runs, told):
    """A rover's model was right; its first step promised 0.0049, and lost by 0.004 each time."""
    made = SimpleNamespace(
        id="c0001", base="", model="m", predicted_utility=-0.0117, doubtful=False
    )
    trials = tuple(SimpleNamespace(id=f"t000{k}") for k in range(1, runs + 1))
    best = Tried(made, trials, (-0.0144,) * runs, True)
    step = SimpleNamespace(
        id="c0002", way="", predicted_utility=-0.0097, likely_off=0.0, doubtful=False
    )
    step.promised_over = lambda other: 0.0049
    now = SimpleNamespace(incumbent=best, history=(best,))
    said = _came_true(step, [best], now, 0.002, replayed)
    assert ("less than the sensor noise that it replays costs, 0.007000" in said) == told


@pytest.mark.parametrize(
    ("alone", "real", "told"),
    [(-0.0055, -0.1364, True), (0.001, -0.1364, False), (-1, -0.2, False)],
)
def test_a_gain_that_a_right_model_does_not_confirm_may_be_the_noise_of_one_run(alone, real, told):
    """A boat's model was right to 1 % of its first run; four runs were spent on a promise."""
    made = SimpleNamespace(id="c0001", base="", predicted_utility=-0.1352, doubtful=False)
    best = Tried(made, (SimpleNamespace(id="t0001"),), (real,), True)
    step = SimpleNamespace(id="c0002", way="", predicted_utility=-0.1171, likely_off=0.0)
    step.promised_over, step.doubtful = lambda other: 0.0149, False
    now = SimpleNamespace(incumbent=best, history=(best,))
    said = _came_true(step, [best], now, 0.0018, 0.0131, alone)
    words = "the model foretold that run, and by itself puts c0002 0.005500 behind c0001"
    assert (words in said) == told
    assert "stop with c0001" in said or not told
    less = _came_true(step, [best], now, 0.0018, 0.002, alone)  # noise is not what it gains
    assert words not in less and "a gain of 0.01490" in less


def test_what_a_step_gains_by_itself_is_asked_of_the_model_without_a_bias(tmp_path):
    w = Workspace(make(tmp_path / "w").folder)
    w.learn(1)
    made = w.propose().proposal
    best = made.standing.incumbent
    alone = _by_itself(made.candidate, best, w)
    assert alone < 0 < made.candidate.predicted_gain  # c0001 is the model's own optimum
    assert math.isnan(_by_itself(best.candidate, best, w)) and math.isnan(
        _by_itself(made.candidate, None, w)
    )


def test_how_old_samples_are_is_one_short_sentence(monkeypatch):
    """Its four clauses took four readings, and one candidate's age was not that of the next run."""
    made = SimpleNamespace(id="c0003", base="c0002", sample_age=0.0093)
    now, task = SimpleNamespace(history=()), SimpleNamespace(dt=0.02)
    ages = list[float]()
    monkeypatch.setattr(
        "grounded.search.feedback.sample_age.run_ages", lambda task, history: [*ages]
    )
    said = "c0002 acted on samples 9.3 ms old; c0003 is planned for that"
    assert _samples(made, now, task) == said
    ages += [0.0093, 0.0085]
    assert _samples(made, now, task) == said
    ages += [0.0027]
    assert _samples(made, now, task) == (
        "c0003 is planned for samples 9.3 ms old; in the runs so far: 2.7 to 9.3 ms"
    )
    made.sample_age, ages[:] = -0.004, []
    assert "4 ms newer than in its log" in _samples(made, now, task)


def test_the_noise_in_a_log_is_told_as_that_of_the_best_one():
    """0.0020 of it, what a prediction lacks, stood beside the 0.0060 of the best one."""
    made = SimpleNamespace(predicted_utility=-0.0056)
    proposed = SimpleNamespace(
        candidate=made, noise_cost=0.002, from_starts=None, noise_in_log=0.006, off_target=()
    )
    assert _predicted(proposed).endswith(
        "about -0.007600 in its log, 0.006000 of it by sensor noise on average (0.004000 is in "
        "-0.005600 too: it replays a log)"
    )
    rest = SimpleNamespace(
        candidate=made, noise_cost=0.002, from_starts=None, noise_in_log=0.001, off_target=()
    )
    assert _predicted(rest).endswith("in its log, including sensor noise")


@pytest.mark.parametrize(("missed", "less"), [(0.105, True), (0.01, False)])
def test_a_gain_beside_a_log_that_is_to_show_a_loss_is_told_on_its_scale(missed, less):
    """A gain of 0.0606 was promised by -1.085 "in its log" over -1.040, without a word why."""
    shape = (None, None, -0.98)
    base = Candidate("c0002", None, 1, 1.0, "c0001", "m", *shape)
    made = Candidate("c0003", None, 2, 1.0, "c0002", "m", *shape, predicted_gain=0.06)
    run = SimpleNamespace(id="t0002")
    best = Tried(base, (run,), (-1.04,), True, noise_cost=0.36)
    waits = Tried(made, (), (), None, noise_cost=0.0, noise_missed=missed)
    told = _so_far(made, best, None, (), missed)
    reason = "In the model, which replays c0002 with the noise in its log, c0003 is 0.06000 better"
    assert (reason in told) == less and ("about -1.085 is expected of its log" in told) == less
    standing = Standing(
        *("await-trial", 1, best, made, 1, None, "", 0, (best, waits), 1),
        "c0003 is waiting for 1 trial",
    )
    assert bool(standing.less_in_log) == less
    now = SimpleNamespace(incumbent=best, history=(best,))
    assert "promises a gain of 0.06000 in the model" in _came_true(made, [best], now, missed)
    assert not _came_true(made, [best], now).endswith("in the model")
