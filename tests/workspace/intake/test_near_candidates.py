"""Nearly equal candidates and saturated commands: an honest run is never another's."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded import Model
from grounded.accounts.returned import suspicion
from grounded.accounts.sent import evidence, follows
from grounded.errors import GroundedError
from grounded.policy import Policy
from grounded.trial import Trial
from grounded_trials.formats.mcap_writer import McapWriter
from grounded_trials.formats.protobuf import encode_doubles
from grounded_trials.logs.signals import Series, SignalSpec
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace.candidates.proposing import propose_in
from grounded_trials.workspace.candidates.running import run_candidate
from grounded_trials.workspace.intake.ingest import ingest_log
from grounded_trials.workspace.intake.opening.foreign import read_log_file
from grounded_trials.workspace.intake.opening.run_start import recording
from grounded_trials.workspace.intake.recognise import recognised, stories_of_log
from recorded import follow
from small_tasks import plain_task
from workspaces import CONFIG, make

FULL = CONFIG.replace("[search]", '[search]\nstep = "full"\nrerun_incumbent = false') + (
    '[log]\nclock = "publish"\n[log.state.x]\npath = "/place.x"\n[log.state.v]\n'
    'path = "/wheel.v"\n[log.input.force]\npath = "/sent.force"\n'
)
SEEDS = range(6)


@pytest.fixture(scope="module")
def ladder(tmp_path_factory):
    """A cart whose steps with alpha = 1, 1/2 ... 1/16 from one candidate all lost, by alpha."""
    folder = tmp_path_factory.mktemp("ladder")
    w = make(folder / "w", config=FULL)
    ingest_log(w, run_candidate(w, propose_in(w).candidate.id).trial_file)
    first = w.trials()[0].trial
    lost = first.states + np.linspace(0, 1, len(first.states))[:, None]
    for k in range(5):
        made = propose_in(w).candidate
        sent = made.policy.commands(lost[None, :-1], made.policy.past)[0]
        trial = replace(first, states=lost, inputs=sent, candidate=made.id)
        path = folder / f"{k}.mcap"
        write_trial(path, trial, {"kind": "trial", "task": w.task.hash})
        ingest_log(w, path)
    found = {c.alpha: c for c in w.read().candidates if c.base}
    assert list(found) == [1, 1 / 2, 1 / 4, 1 / 8, 1 / 16]
    return w, found


def noisy(made, share, seed, *, other):
    """A run that strays a little, noise of so large a share of each state's range in it.

    The policy acted on what is logged, or on the noise of `other` sensors.
    """
    rng, expected = np.random.default_rng(seed), made.predicted_states
    size, steps = np.ptp(expected, axis=0), made.policy.horizon
    strays = np.cumsum(rng.normal(size=expected.shape), axis=0) / np.sqrt(steps)
    clean = expected + 0.05 * size * strays
    logged, acted = (clean + share * size * rng.normal(size=clean.shape) for _ in range(2))
    felt = (acted if other else logged)[None, :-1]
    return Trial(
        states=logged,
        inputs=made.policy.commands(felt, made.policy.past)[0],
        dt=made.policy.dt,
        state_names=made.policy.state_names,
        input_names=made.policy.input_names,
    )


def refused(w, trial, made, candidates):
    """Why the run is not this candidate's, None where it is taken for it."""
    return suspicion(w.task, replace(trial, candidate=made.id), made, [*candidates.values()]).why


@pytest.mark.parametrize(("share", "other"), [(0.01, True), (0.003, False)])
def test_no_honest_run_of_nearly_equal_candidates_is_refused(ladder, share, other):
    """200 runs of alpha = 1/8 or 1/16, whose commands differ by 0.6 % of their size."""
    w, by_alpha = ladder
    for seed in SEEDS:
        made = by_alpha[1 / 8 if seed % 2 else 1 / 16]
        assert refused(w, noisy(made, share, seed, other=other), made, by_alpha) is None, seed


def test_a_run_of_another_candidate_is_refused_and_named(ladder):
    w, by_alpha = ladder
    for seed in SEEDS:
        why = refused(w, noisy(by_alpha[1], 0.003, seed, other=True), by_alpha[1 / 4], by_alpha)
        assert why.code == "log.another", seed
        assert why.facts["other"] != by_alpha[1 / 4].id, seed


def test_evidence_is_nats_that_grow_with_the_run_and_are_none_for_the_same_policy(ladder):
    _, by_alpha = ladder
    trial = noisy(by_alpha[1], 0.01, 0, other=False)
    own, other = (follows(by_alpha[alpha].policy, trial).apart for alpha in (1 / 4, 1))
    half = [follows(by_alpha[alpha].policy, trial.until(20)).apart for alpha in (1 / 4, 1)]
    assert evidence(own, other) > evidence(*half) > 0
    assert evidence(other, other) <= 0 and evidence(other, own) < 0


def drive(path, w, made, seed, *, jitter=0.0):
    """The cart driven by a candidate that acts on samples which are 12 and 4 ms old when they come.

    Args:
        path: of the log, a topic for each sensor and one for the commands.
        w: whose model the cart is.
        made: the candidate; 0.3 s before its run the cart stands still, and nothing is sent.
        seed: of its sensors' noise.
        jitter: of the way to the program [s].
    """
    model, policy = w.task.model, made.policy
    rng, every, begin = np.random.default_rng(seed), round(policy.dt * 1000), 300
    z, force, got, known = np.array(w.task.start, float), 0.0, [], {}
    past = policy.past.copy()
    next_x, next_v = rng.integers(0, 20, 2)
    with path.open("wb") as stream:
        log = McapWriter(stream)
        topics = [log.doubles(f"/{t}", t, [n]) for t, n in TOPICS]

        def say(topic, k, value):
            (line,) = encode_doubles(np.array([[value]]))
            log.message(topics[topic], 10**18 + k * 10**6, line)

        for k in range(begin + every * policy.horizon + 300):
            if k == next_x:
                next_x += 20 + rng.integers(-1, 2)
                x = z[0] + rng.normal(0, 0.01)
                got.append((k + 12 + 1000 * jitter * rng.random(), 0, x))
                say(0, k, x)
            if k == next_v:
                next_v += 20 + rng.integers(-1, 2)
                v = z[1] + rng.normal(0, 0.05)
                got.append((k + 4, 1, v))
                say(1, k, v)
            for one in [one for one in got if one[0] <= k]:
                known[one[1]] = one[2]
                got.remove(one)
            step, part = divmod(k - begin, every)
            if 0 <= step < policy.horizon and part == 0:
                force = float(follow(policy, step, np.array([known[0], known[1]]), past)[0])
                say(2, k, force)
            force = force if step < policy.horizon else 0.0
            if k >= begin and k % 5 == 0:
                z = model.system.step(z[None], np.array([[force]]), model.values, 0.005)[0]
        log.finish()
    return path


TOPICS = (("place", "x"), ("wheel", "v"), ("sent", "force"))


@pytest.mark.parametrize("ran, said, jitter", [(1, 1 / 4, 0.012), (1 / 8, 1 / 4, 0.0)])
def test_the_robot_ran_an_old_candidate_on_samples_of_its_own(ladder, tmp_path, ran, said, jitter):
    w, by_alpha = ladder
    log = drive(tmp_path / "a.mcap", w, by_alpha[ran], 1, jitter=jitter)
    read = read_log_file(w, log, by_alpha[said].id, data=False)
    with pytest.raises(GroundedError) as refused:
        recognised(w, log, read, None)
    told = refused.value.finding
    assert told.code == "log.another" and told.facts["other"] == by_alpha[ran].id
    assert told.facts["mine"] > 2 * told.facts["theirs"]


DT, STEPS, WAITS, LIMIT, NAMES = 0.01, 300, 150, 7.4, (("tilt", "rate"), ("voltage",))
HAND = np.array([38.0, 4.0])


def candidate(gain, seed=1, name="c0003"):
    """A policy whose plan and gains change from step to step."""
    rng, k = np.random.default_rng(seed), np.arange(STEPS)
    plan = 0.8 * np.sin(0.05 * k + rng.uniform(0, 6))[:, None]
    gains = np.zeros((STEPS, 1, 3))
    gains[:, 0, :2] = np.asarray(gain) * (1 + 0.2 * np.sin(0.03 * k))[:, None]
    limit, none = np.array([LIMIT]), np.zeros(1)
    reference = np.zeros((STEPS, 3))
    reference[:, 0] = 0.03 * np.sin(0.07 * k)
    policy = Policy(plan, -limit, limit, DT, *NAMES, (1,), (False,) * 2, none, gains, reference)
    predicted = np.stack([reference[:, 0], np.gradient(reference[:, 0], DT)], axis=1)
    return SimpleNamespace(
        id=name, policy=policy, predicted_states=np.vstack([predicted, predicted[-1:]])
    )


def balanced(ran, seed):
    """Balance by hand for 1.5 s, then by a policy with late commands and a loop that jitters."""
    rng, queue, u = np.random.default_rng(seed), [], 0.0
    x, now, rows = np.array([0.0, 0.0]), 0.0, []
    for k in range(WAITS + STEPS + 100):
        t = k * DT + abs(rng.normal(0, 0.0008))
        while now < t:
            while queue and queue[0][0] <= now:
                u = queue.pop(0)[1]
            fell = abs(x[0]) > 0.9
            x = np.array([np.sign(x[0]) * 0.95, 0.0]) if fell else x + 5e-4 * acceleration(x, u)
            now += 5e-4
        felt = x + rng.normal(0, (0.0015, 0.01))
        step = k - WAITS
        if 0 <= step < STEPS:
            one = ran.policy
            sent = one.feedforward[step, 0]
            sent += one.gain[step, 0, :2] @ (felt - one.reference[step, :2])
        else:
            sent = HAND @ felt
        sent = float(np.clip(sent, -LIMIT, LIMIT))
        queue.append((t + 0.025, sent))
        rows.append((t, *felt, sent))
    return np.array(rows)


def acceleration(x, u):
    return np.array([x[1], 45 * np.sin(x[0]) - 9 * u])


def log_of(rows):
    """Return a task and the recording of rows whose commands have stamps of their own."""

    def logged(values, late):
        t = np.round(1e9 * (1000 + rows[:, 0] + late)).astype(np.int64)
        return Series(SignalSpec("/a.b"), t, values, t, len(t), "")

    series = {
        "tilt": logged(rows[:, 1], 0.0),
        "rate": logged(rows[:, 2], 0.0),
        "voltage": logged(rows[:, 3], 0.0006),
    }
    model = Model(
        states={"tilt": "rad", "rate": "rad/s"},
        inputs={"voltage": "V"},
        params={},
        derivative=lambda s, a, p: {"tilt": s.rate, "rate": 45 * np.sin(s.tilt) - 9 * a.voltage},
    )
    late = {"effort": 0.01, "latency": np.array([0.025])}
    task = plain_task(model, DT, np.zeros((STEPS + 1, 2)), [1.0, 0.1], LIMIT, **late)
    return task, recording(series, task, series)


def test_a_run_at_its_limits_begins_where_its_few_other_commands_are_exact(seed=1):
    ran = candidate(30 * HAND)
    rows = balanced(ran, seed)
    assert np.mean(np.abs(rows[WAITS : WAITS + STEPS, 3]) < LIMIT) < 0.05
    _, log = log_of(rows)
    found = log.start_of(ran.policy)
    assert found.alike and found.ran.exact
    assert found.seconds == pytest.approx(WAITS * DT, abs=0.004)


@pytest.mark.parametrize("seed", [0, 3])
def test_another_policy_at_its_limits_is_no_misuse(seed):
    ran, own = candidate(6 * HAND, 2), candidate((2 + 0.5 * seed) * HAND, 3)
    task, log = log_of(balanced(ran, seed))
    assert not stories_of_log(log, task, own, None)
