"""Runs of nearly equal candidates: an honest noisy run is never refused as another's.

0.1 compared nothing; a ratio of the errors, which came first, refused 10 to 20 % of such runs.
"""

import re
from dataclasses import replace

import numpy as np
import pytest

from grounded.trial import Trial
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace.intake.ingest import ingest_log
from grounded_trials.workspace.intake.who_drove import evidence, follows, suspicion
from grounded_trials.workspace.proposing import propose_in
from grounded_trials.workspace.running import run_candidate
from workspaces import CONFIG, make

FULL = CONFIG.replace("[search]", '[search]\nstep = "full"\nrerun_incumbent = false')
SEEDS = range(50)


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
    """Why the run is not this candidate's, "" where it is taken for it."""
    return suspicion(w.task, replace(trial, candidate=made.id), made, [*candidates.values()]).why


@pytest.mark.parametrize("other", [False, True])
@pytest.mark.parametrize("share", [0.003, 0.01])
def test_no_honest_run_of_nearly_equal_candidates_is_refused(ladder, share, other):
    """200 runs of alpha = 1/8 or 1/16, whose commands differ by 0.6 % of their size."""
    w, by_alpha = ladder
    for seed in SEEDS:
        made = by_alpha[1 / 8 if seed % 2 else 1 / 16]
        assert refused(w, noisy(made, share, seed, other=other), made, by_alpha) == "", seed


@pytest.mark.parametrize("share, other", [(0.003, False), (0.003, True), (0.01, False)])
@pytest.mark.parametrize("ran, said", [(1, 1 / 4), (1 / 4, 1)])
def test_a_run_of_another_candidate_is_refused_and_named(ladder, ran, said, share, other):
    w, by_alpha = ladder
    for seed in SEEDS:
        why = refused(w, noisy(by_alpha[ran], share, seed, other=other), by_alpha[said], by_alpha)
        named = re.search(r"those of (c\d+)$", why)
        assert named and named[1] != by_alpha[said].id, seed


@pytest.mark.parametrize("share", [0.0, 0.01])
def test_manual_driving_is_refused(ladder, share):
    """A person swings the cart, other than the manoeuvre does; its states follow."""
    w, by_alpha = ladder
    model, made, dt = w.task.model, by_alpha[1 / 8], w.config.task.dt
    for swings in (0.5, 1.5, 2.0, 3.0):
        for phase in (0.0, 1.5, 3.0, 4.5):
            u = 3 * np.sin(np.linspace(0, 2 * np.pi * swings, 40) + phase)[:, None]
            x = [w.task.start]
            for k in range(40):
                x.append(model.system.step(x[-1][None], u[k : k + 1], model.values, dt)[0])
            noise = np.random.default_rng(0).normal(size=(41, 2)) * share
            driven = replace(noisy(made, 0.0, 0, other=False), states=x + noise, inputs=u)
            assert "force" in refused(w, driven, made, by_alpha), (swings, phase)


def test_evidence_is_nats_that_grow_with_the_run_and_are_none_for_the_same_policy(ladder):
    _, by_alpha = ladder
    trial = noisy(by_alpha[1], 0.01, 0, other=False)
    own, other = (follows(by_alpha[alpha].policy, trial) for alpha in (1 / 4, 1))
    half = [follows(by_alpha[alpha].policy, trial.until(20)) for alpha in (1 / 4, 1)]
    assert evidence(own, other) > evidence(*half) > 0
    assert evidence(other, other) <= 0 and evidence(other, own) < 0
