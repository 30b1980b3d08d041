"""The state of the search is a pure function of candidates and stored trials."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from grounded.errors import NextCommand
from grounded.model import Model
from grounded.plant import Noise, Plant
from grounded.search.ask_tell import learn
from grounded.search.improve import propose
from grounded.search.planner import model_fingerprint
from grounded.search.standing import MAX_CAUTION, standing
from grounded.search.step_size import SearchOptions
from grounded.trial import mean_trial
from grounded.utility import Reward
from small_tasks import cart_task, drive, other

TASK = cart_task()
PLANT = Plant(other(TASK.model, 1.6), latency={"force": 0.02})


def bad(trial, value=30.0):
    """Return the run with a state far off the target: a trial without improvement."""
    states = np.array(trial.states)
    states[1:, 0] += value
    return replace(trial, states=states)


class Story:
    """A search with prescribed trials."""

    def __init__(self, task=TASK, plant=PLANT, **options):
        self.task, self.plant = task, plant
        self.options = SearchOptions(**{"rerun_incumbent": False} | options)
        self.candidates, self.trials = [], []

    def propose(self):
        proposal = propose(self.task, self.candidates, self.trials, self.options)
        if proposal.is_new:
            self.candidates.append(proposal.candidate)
        return proposal

    def add(self, how=lambda trial: trial):
        proposal = self.propose()
        assert proposal.candidate is not None, proposal.standing.sentence
        trial = drive(self.task, self.plant, proposal.candidate, seed=len(self.trials))
        self.trials.append(how(trial))
        return self

    @property
    def now(self):
        fingerprint = model_fingerprint(self.task)
        return standing(self.task, self.candidates, self.trials, self.options, fingerprint)


def test_an_empty_search_proposes_the_models_own_policy():
    now = Story().now
    assert (now.phase, now.iteration, now.incumbent, now.utilities) == ("propose", 0, None, [])
    assert now.sentence


def test_a_candidate_without_a_trial_is_named_again():
    story = Story()
    first, again = story.propose(), story.propose()
    assert first.is_new and not again.is_new and again.candidate is first.candidate
    assert story.now.phase == "await-trial" and story.now.missing == 1
    assert story.now.outstanding is not None and story.now.outstanding.id == "c0001"


def test_an_improvement_is_accepted_and_the_next_starts_from_it():
    story = Story().add().add()
    now = story.now
    assert now.iteration == 1 and now.incumbent.candidate.id == "c0002"
    assert now.utilities == [story.task.utility(t) for t in story.trials]
    third = story.propose().candidate
    assert (third.id, third.iteration, third.base) == ("c0003", 2, "c0002")


@pytest.mark.parametrize(
    ("options", "steps"),
    [
        ({"step": "full", "max_halvings": 3}, [(0.0, a) for a in (1.0, 0.5, 0.25, 0.125)]),
        ({"method": "policy-gradient", "max_halvings": 0}, [(0.0, 1.0)]),
    ],
    ids=["full", "gradient"],
)
def test_trials_that_do_not_improve_shorten_the_step_then_end_the_search(options, steps):
    if options.get("method") == "policy-gradient":
        pytest.importorskip("grounded.solve.policy_gradient")
    story = Story(**options, tolerance=0.0).add()
    for _ in steps:
        story.add(bad)
    made = [(c.damping, c.alpha) for c in story.candidates[1:]]
    assert made == steps and all(c.base == "c0001" for c in story.candidates[1:])
    last = story.propose()
    assert last.candidate is None and last.standing.phase == "converged"
    assert last.standing.incumbent is not None
    assert last.standing.incumbent.candidate.id == "c0001"


def test_trials_that_do_not_improve_raise_the_damping_until_nothing_is_promised():
    story = Story(tolerance=1e-9).add()
    while story.propose().candidate is not None:
        story.add(bad)
    made = [((c.way, c.slopes), c.damping, -c.alpha) for c in story.candidates[1:]]
    assert made[0] == (("", ""), 1.0, -1.0) and len(set(made)) == len(made) > 2
    for kind in {one for one, *_ in made}:
        own = [step for one, *step in made if one == kind]
        assert own == sorted(own)
    assert len(made) == len(story.candidates) - 1
    ended = story.propose().standing
    assert (ended.phase, ended.ending) == ("converged", "no step improved")


@pytest.mark.parametrize(("off", "asks"), [(0.5, False), (50.0, True)])
def test_a_step_that_costs_a_hundred_times_what_was_predicted_asks_for_a_diagnosis(off, asks):
    story = Story().add().add(lambda trial: bad(trial, off))
    now = story.now
    assert now.phase == "propose" and now.step is not None
    assert (now.then == NextCommand("diagnose")) is asks


@pytest.mark.parametrize(
    ("lag", "most", "asks"), [(0.6, 40, True), (0.6, 6, True), (0.02, 40, False)]
)
def test_an_end_far_from_the_models_own_optimum_asks_for_a_diagnosis(lag, most, asks):
    lagged = Model(
        states={"x": "m", "v": "m/s", "f": "N"},
        inputs={"force": "N"},
        params=dict(cart_task().model.params),
        derivative=lambda s, a, p: {
            "x": s.v,
            "v": (s.f - p.drag * s.v) / p.mass,
            "f": (a.force - s.f) / lag,
        },
    )
    story = Story(plant=Plant(lagged, substeps=20), max_trials=most)
    while (ended := story.propose()).candidate is not None:
        story.add()
    now = ended.standing
    far = [one.facts for one in now.findings if one.code == "search.within_model"]
    assert bool(far) is asks and (now.then == NextCommand("diagnose")) is asks
    if asks:
        own = now.history[0].candidate.predicted_utility
        assert far[0]["by"] == pytest.approx(own - now.incumbent.utility)
        assert far[0]["by"] > 0.5 * -now.incumbent.utility


def test_a_system_that_repeats_itself_exactly_is_not_asked_again():
    story = Story(rerun_incumbent=True).add().add(worse)
    assert story.now.history[-1].in_doubt and story.now.outstanding.id == "c0001"
    story.add()  # the same policy on a deterministic system: the same trial to the last bit
    again = [t for t in story.trials if t.candidate == "c0001"]
    assert len(again) == 2 and np.array_equal(again[0].states, again[1].states)
    while story.propose().candidate is not None:
        story.add(bad)
    assert sum(t.candidate == "c0001" for t in story.trials) == 2


def test_repeats_are_averaged_and_all_are_needed():
    noisy = Plant(PLANT.model, noise=Noise(process={"v": 0.02}))
    story = Story(plant=noisy, repeats=3)
    for missing in (3, 2, 1):
        story.propose()
        assert story.now.missing == missing and story.now.phase == "await-trial"
        story.add()
    story.add().add().add()
    tried = story.now.history[0]
    assert len(tried.trials) == 3 and tried.accepted is True
    each = [story.task.utility(t) for t in tried.trials]
    assert tried.utility == pytest.approx(np.mean(each)) and len(set(each)) == 3
    assert 0.3 < tried.standard_error / (np.std(each, ddof=1) / np.sqrt(3)) < 3  # see scatter
    mean = mean_trial(tried.trials, TASK.model.angle_mask)
    np.testing.assert_allclose(mean.states, np.mean([t.states for t in tried.trials], axis=0))
    np.testing.assert_allclose(mean.inputs, np.mean([t.inputs for t in tried.trials], axis=0))


# a loss that may be luck


def worse(trial):
    """Return the run with the cart shifted a little: a loss that may be luck."""
    return bad(trial, 0.05)


def test_a_loss_sends_the_incumbent_out_again_before_it_is_believed():
    story = Story(rerun_incumbent=True, tolerance=0.0).add().add(worse)
    now = story.now
    assert now.phase == "await-trial" and now.outstanding.id == "c0001" and now.missing == 1
    assert now.history[-1].accepted is None and now.history[-1].in_doubt
    story.add()  # the same result again, so it was not luck
    now = story.now
    assert now.history[-1].accepted is False and now.phase == "propose"
    story.add(worse)  # no scatter is known now: the next loss counts at once
    assert story.now.history[-1].accepted is False and len(story.trials) == 4


def test_losses_are_not_checked_for_ever():
    """At most one additional trial is run for each loss, however much trials scatter."""
    noisy = Plant(PLANT.model, noise=Noise(process={"v": 0.2}))
    story = Story(plant=noisy, rerun_incumbent=True, max_trials=60)
    while story.propose().candidate is not None:
        story.add()
    losses: dict[str, int] = {}
    for tried in story.now.history:
        if not tried.accepted and tried.candidate.base:
            losses[tried.candidate.base] = losses.get(tried.candidate.base, 0) + 1
    for tried in story.now.history:
        if tried.accepted:
            assert len(tried.trials) <= 1 + losses.get(tried.candidate.id, 0)
    assert story.propose().standing.phase in ("converged", "stopped")
    assert len(story.trials) <= 60


def test_a_crash_and_the_last_trial_are_believed_at_once():
    story = Story(rerun_incumbent=True).add().add(cut)
    assert story.now.history[-1].accepted is False and story.now.phase == "propose"
    story = Story(rerun_incumbent=True, max_trials=2).add().add(worse)
    assert story.now.history[-1].accepted is False and story.now.phase == "stopped"
    assert story.propose().candidate is None


# what goes wrong on a robot


def cut(trial, T=20):
    return replace(trial, states=trial.states[: T + 1], inputs=trial.inputs[:T])


def with_nan(trial):
    states = np.array(trial.states)
    states[25:] = np.nan
    return replace(trial, states=states)


def nothing(trial):
    return replace(trial, states=trial.states[:1], inputs=trial.inputs[:0])


FAILURES = {"short": cut, "nan": with_nan, "nothing": nothing}


@pytest.mark.parametrize("how", FAILURES.values(), ids=FAILURES)
def test_a_crashed_candidate_is_one_that_failed(how):
    story = Story().add().add(how)
    assert story.now.history[-1].accepted is False
    assert story.now.incumbent.candidate.id == "c0001"
    story.add()  # a more cautious step from the same base
    made = story.candidates[-1]
    assert (made.damping, made.alpha, made.base) == (10.0, 1.0, "c0001")
    assert story.now.iteration == 1


@pytest.mark.parametrize("how", FAILURES.values(), ids=FAILURES)
def test_a_crash_of_the_first_policy_makes_a_gentler_one(how):
    story = Story()
    efforts = []
    for k in range(MAX_CAUTION + 1):
        story.add(how)
        made = story.candidates[-1]
        assert made.caution == k and made.base == "" and made.iteration == 0
        efforts.append(float(np.abs(np.diff(made.predicted_inputs, axis=0)).sum()))
        asked = story.now.then is not None and story.now.then.verb == "diagnose"
        assert asked == (k > 0)  # not after the first crash
    assert efforts == sorted(efforts, reverse=True) and efforts[1] < 0.7 * efforts[0]
    last = story.propose()
    assert last.candidate is None and last.standing.phase == "stopped"


def test_a_start_away_from_s0_does_not_stop_the_search(off=0.3, repeats=1, least=-1.35):
    """The robot starts slightly (or far) off s_0. With the exact start: from -1.349 to -0.881."""
    rng = np.random.default_rng(0)

    def run(candidate):
        start = {"x": off * rng.standard_normal(), "v": 0.0}
        return PLANT.run(candidate.policy, start, rng)

    found = learn(TASK, run, SearchOptions(max_trials=12 * repeats, repeats=repeats))
    now, candidates = found.standing, found.candidates
    assert now.iteration >= 1 and len(candidates) >= 3
    assert TASK.utility(drive(TASK, PLANT, now.incumbent.candidate)) > least


def test_another_model_starts_again_with_the_first_step_from_the_best_policy():
    story = Story(step="full").add().add(bad).add(bad)
    assert story.candidates[-1].alpha == 0.5
    story.task = story.task.with_model(other(TASK.model, 1.3))  # fitted, say
    made = story.propose().candidate
    assert (made.alpha, made.base, made.id) == (1.0, "c0001", "c0004")
    assert story.now.outstanding is made


EVENTS = {
    "good": lambda trial: trial,
    "bad": bad,
    **FAILURES,
    "held": lambda trial: replace(trial, start_inputs=np.array([2.0])),
    "noise": lambda trial: replace(
        trial, states=trial.states + 0.05 * np.sin(np.arange(82.0)).reshape(41, 2)
    ),
    "huge": lambda trial: replace(trial, states=1e200 * (1 + trial.states)),
    "large": lambda trial: replace(trial, states=1e60 * (1 + trial.states)),
    "far": lambda trial: replace(trial, states=1e5 * (1 + trial.states)),
}


@pytest.mark.slow
@given(
    st.lists(st.sampled_from([*EVENTS, "model", "again", "data"]), max_size=9),
    st.sampled_from([1, 2]),
    st.sampled_from(["damped", "full"]),
)
@settings(max_examples=8, deadline=None)
def test_whatever_happens_the_search_goes_on_or_says_why(events, repeats, step):
    """Crashes, noise, changed models, repeats: no exception, no worse policy."""
    story = Story(repeats=repeats, step=step, max_halvings=2, max_trials=8)
    for event in events:
        proposal = story.propose()
        if event == "model":
            story.task = story.task.with_model(other(story.task.model, 1.1))
        elif event == "data":
            story.trials += [replace(t, candidate="") for t in story.trials[:1]]
        elif event == "again" and story.trials:
            story.trials.append(story.trials[-1])
        elif proposal.candidate is not None and event in EVENTS:
            trial = drive(story.task, story.plant, proposal.candidate)
            story.trials.append(EVENTS[event](trial))
    now = story.now
    assert now.phase in ("propose", "await-trial", "converged", "stopped") and now.sentence
    accepted = now.utilities
    assert accepted == sorted(accepted) and all(np.isfinite(accepted))
    first, second = (
        propose(story.task, story.candidates, story.trials, story.options) for _ in "12"
    )
    assert (first.candidate is None) == (second.candidate is None)
    if first.candidate is not None:
        policy = first.candidate.policy
        assert policy.feedforward.tobytes() == second.candidate.policy.feedforward.tobytes()
        assert np.isfinite(policy.feedforward).all() and np.isfinite(policy.gain).all()
        inside = first.candidate.predicted_inputs
        assert (inside >= TASK.low).all() and (inside <= TASK.high).all()


def weights(state=10.0, terminal=0.0, effort=0.01, change=0.01):
    return Reward(
        np.array([state, 0.0]), np.array([terminal, 0.0]), np.array([effort]), np.array([change])
    )


JUMP = np.column_stack([np.repeat([0.0, 1.0], [20, 21]), np.full(41, np.nan)])
ODD = {
    "no input weights": {"reward": weights(effort=0.0, change=0.0)},
    "nothing bounds the inputs": {
        "reward": weights(effort=0.0, change=0.0),
        "low": np.array([-np.inf]),
        "high": np.array([np.inf]),
    },
    "terminal weights alone": {"reward": weights(state=0.0, terminal=10.0)},
    "one step": {"target": TASK.target[:2]},
    "two steps": {"target": TASK.target[:3]},
    "a target that jumps": {"target": JUMP},
    "a target out of reach": {"target": 1000 * JUMP},
    "huge weights": {"reward": weights(1e12, 0.0, 1e-6, 1e-6)},
    "tiny weights": {"reward": weights(1e-12, 0.0, 1e-14, 1e-14)},
    "one limit": {"low": np.array([0.0]), "high": np.array([np.inf])},
    "latency as long as the manoeuvre": {"latency": np.array([2.5])},
    "open loop": {"feedback": False},
    "a far start": {"start": np.array([100.0, 50.0])},
    "limits that leave no choice": {
        "low": np.array([0.999]),
        "high": np.array([1.0]),
        "past": np.array([1.0]),
    },
    "exact planning": {"smoothing": 0.0},
    "nothing to do": {"target": np.column_stack([np.zeros(41), np.full(41, np.nan)])},
}


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *((name, {}) for name in ODD),
        ("one step", {"step": "full"}),
        ("huge weights", {"step": "full"}),
        ("one step", {"method": "policy-gradient"}),
        ("a target out of reach", {"method": "policy-gradient"}),
    ],
)
def test_odd_tasks_are_searched_or_ended_with_a_sentence(name, options):
    task = cart_task(**ODD[name])
    plant = Plant(other(task.model, 1.5), latency={"force": 0.02})
    found = learn(task, lambda c: drive(task, plant, c), SearchOptions(max_trials=4, **options))
    now = found.standing
    assert now.phase in ("converged", "stopped") and now.sentence and found.trials
    assert now.utilities == sorted(now.utilities) and all(np.isfinite(now.utilities))
    for trial in found.trials:
        assert (trial.inputs >= task.low).all() and (trial.inputs <= task.high).all()
