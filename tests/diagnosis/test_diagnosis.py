"""The diagnosis: its filter against dense algebra, its verdicts on known answers."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded import GroundedError, Trial
from grounded.diagnosis.diagnose import diagnose
from grounded.diagnosis.error_report import Credit, Remainder
from grounded.diagnosis.excitation import probe
from grounded.diagnosis.hypotheses.leftover import whiteness
from grounded.diagnosis.levels import NATS
from grounded.diagnosis.parts import Ranked
from grounded.diagnosis.validation.blame import fewest, loss, still
from grounded.diagnosis.writer import MOST_EFFECTS, Writer
from grounded.filter import kalman
from grounded.models.pendulum import model as pendulum
from small_tasks import DT, plain_task, pushed_cart


def random_filter(rng, L=4, B=2, n=2):
    A = 0.5 * rng.standard_normal((L, B, n, n)) + np.eye(n)
    Q, R = rng.uniform(0.5, 2, (L, B, n)), rng.uniform(0.5, 2, (L + 1, B, n))
    d, r = rng.standard_normal((L, B, n, 1)), rng.standard_normal((L + 1, B, n, 1))
    return A, Q, R, d, r


def dense_loglik(A, Q, R, d, r, b):
    """log p(r_1 .. r_L | r_0) by the joint covariance of everything, one run."""
    L, n = len(A), A.shape[-1]
    blocks = L * n
    mean, cov = np.zeros(blocks), np.zeros((blocks, blocks))
    m, maps = r[0, b, :, 0], [np.eye(n)]
    P = [np.diag(R[0, b])]
    for t in range(L):
        m = A[t, b] @ m + d[t, b, :, 0]
        P.append(A[t, b] @ P[-1] @ A[t, b].T + np.diag(Q[t, b]))
        mean[t * n : t * n + n] = m
        maps.append(A[t, b])
    for i in range(1, L + 1):
        C = P[i]
        for j in range(i, L + 1):
            if j > i:
                C = C @ A[j - 1, b].T
            cov[(i - 1) * n : i * n, (j - 1) * n : j * n] = C
            cov[(j - 1) * n : j * n, (i - 1) * n : i * n] = C.T
        cov[(i - 1) * n : i * n, (i - 1) * n : i * n] += np.diag(R[i, b])
    e = r[1:, b, :, 0].reshape(-1) - mean
    return -0.5 * (e @ np.linalg.solve(cov, e) + np.linalg.slogdet(cov)[1])


def filter_loglik(A, Q, R, d, r):
    L, B, n, _ = A.shape
    g = kalman.gains(kalman.LinearSystem(A, Q, R, np.ones((L + 1, B, n)), R[0]))
    white, _ = kalman.innovations(g, d, r)
    return -0.5 * ((white**2).sum() + g.logdet.sum()), g, white


def test_the_filter_is_the_joint_normal_law():
    A, Q, R, d, r = random_filter(np.random.default_rng(0))
    whole = sum(dense_loglik(A, Q, R, d, r, b) for b in range(2))
    assert filter_loglik(A, Q, R, d, r)[0] == pytest.approx(whole, rel=1e-9)


def test_the_smoother_is_the_gradient_of_the_likelihood():
    A, Q, R, d, r = random_filter(np.random.default_rng(1))
    _, g, white = filter_loglik(A, Q, R, d, r)
    back = kalman.smoother(g, white[..., 0])
    h = 1e-5
    for t, b, i in ((0, 0, 0), (2, 1, 1), (3, 0, 1)):
        for which, score in (
            (Q, 0.5 * (back.r**2 - back.N)[t, b, i]),
            (R[1:], 0.5 * (back.u**2 - back.D)[t, b, i]),
        ):
            which[t, b, i] += h
            up = filter_loglik(A, Q, R, d, r)[0]
            which[t, b, i] -= 2 * h
            down = filter_loglik(A, Q, R, d, r)[0]
            which[t, b, i] += h
            assert score == pytest.approx((up - down) / (2 * h), rel=1e-5, abs=1e-7)


def test_whiteness_is_the_chance_that_white_noise_is_as_correlated():
    white = np.random.default_rng(0).standard_normal((200, 5, 2))
    white[1:, :, 1] += 0.3 * white[:-1, :, 1]
    found = whiteness(SimpleNamespace(white=white), np.ones((201, 5, 2)))
    assert 0.01 < found["0"] <= 1 and found["1"] < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("truth", "name", "quantity", "value"), [({"friction": 0.4}, "coulomb_friction:v", "c", 0.4)]
)
def test_one_effect_is_named_with_its_size(truth, name, quantity, value):
    model, trials = pushed_cart(**truth)
    found = diagnose(model, trials)
    assert found.ranking[0].effect == name
    assert found.kind == "effect", found.sentence
    estimate = found.ranking[0].params[quantity]
    assert estimate.value == pytest.approx(value, rel=0.1)
    assert found.gap.after < 1.25 < found.gap.before
    assert found.where.channels[0].name == "v"


def test_a_parameter_that_did_not_move_is_not_blamed_for_those_that_did():
    ratios = np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])  # K, m, I: K / m and K / I are known
    H, b = 3000 * ratios.T @ ratios + np.eye(3), np.array([-0.02, 1.8, 2.1])
    free, _ = fewest(H, b, range(3))
    assert {*free} == {0, 1, 2} and still(H, b, free) == [0]  # K alone would do most of it
    free, left = fewest(H, b, [1, 2])
    assert {*free} == {1, 2} and left < NATS and still(H, b, free) == []
    assert still(np.eye(2), np.array([0.2, 1.2]), [0]) == []  # the other may be none, too


def test_of_two_parameters_that_are_one_only_one_is_blamed():
    H = np.array([[100.0, 99.0], [99.0, 100.0]])
    b = np.array([0.5, 0.5])
    assert loss(H, b, [0, 1]) == 0
    assert loss(H, b, [0]) < 1 < 40 < loss(H, b, [])


@pytest.mark.slow
def test_one_trial_names_no_cause():
    model, trials = pushed_cart(friction=0.5, trials=1)
    found = diagnose(model, trials)
    assert found.kind == "unknown"
    assert found.effects == ()


@pytest.mark.slow
def test_a_constant_input_is_not_blamed():
    model, trials = pushed_cart(friction=0.5)
    flat = [
        Trial(t.states, np.full_like(t.inputs, 0.3), t.dt, t.state_names, t.input_names)
        for t in trials
    ]
    found = diagnose(model, flat)
    assert found.kind == "unknown"
    assert "model.still" in {one.code for one in found.findings}
    assert not any(r.effect.endswith(":u") for r in found.ranking)


def test_no_trials_and_foreign_trials_are_refused():
    model, trials = pushed_cart()
    with pytest.raises(GroundedError, match="no trial"):
        diagnose(model, [])
    with pytest.raises(GroundedError, match="states"):
        diagnose(pendulum, trials)


@pytest.mark.slow
def test_a_probe_tells_two_explanations_apart():
    model, trials = pushed_cart(dead=0.1, steps=60, trials=3)
    H = 100
    task = plain_task(model, DT, np.zeros((H + 1, 2)), 1.0, 1.0)
    found = diagnose(task, trials)
    tied = replace(
        found,
        verdict=replace(found.verdict, effects=("dead_zone:u",)),
        indistinguishable=(("dead_zone:u", found.ranking[1].effect),),
    )
    base = task.policy(0.3 * np.ones((H, 1)), None, None)
    best = probe(task, base, tied, trials)
    assert best is not None
    assert best.expected > 3
    assert (best.policy.feedforward >= -1).all()
    assert (best.policy.feedforward <= 1).all()
    alone = probe(task, base, replace(found, indistinguishable=()), trials)
    assert alone is not None and alone.expected > 0 and len(alone.about) == 1
    assert (np.abs(alone.policy.feedforward) <= 1).all()
    assert not alone.little
    surely = probe(task, base, replace(found, indistinguishable=()), trials * 40)
    assert surely.little and surely.about == alone.about
    none = replace(found, verdict=replace(found.verdict, effects=()), parameters={})
    assert probe(task, base, replace(none, indistinguishable=()), trials) is None


def test_the_diagnosis_does_not_reach_the_simulated_truth():
    import subprocess
    import sys

    code = (
        "import sys, grounded.diagnosis.diagnose, grounded.diagnosis.excitation;"
        "bad = [m for m in sys.modules if m.startswith(('grounded.models', 'grounded.plant',"
        " 'grounded.experiments', 'grounded.challenge'))]; assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("most", "error", "more"),
    [(3, 0.056, 5), (6, 0.056, 8), (11, 0.056, 12), (12, 0.056, 0), (2, 0.056, 0), (3, 0.033, 0)],
)
def test_where_as_many_as_were_looked_for_leave_more_than_noise_more_are_looked_for(
    most, error, more
):
    claimed = [f"viscous_friction:{k}" for k in range(max(most, 3))]
    rows = tuple(Ranked(name, {}, {}, 50.0, claimed=True) for name in claimed)
    claims = SimpleNamespace(
        known=SimpleNamespace(no_cause=False),
        blamed=(),
        moved=(),
        names=claimed,
        data=SimpleNamespace(model=pendulum),
        best=SimpleNamespace(hypothesis=SimpleNamespace(effects=())),
        parameters=dict,
    )
    credit = (Credit("calibration", 1.0),)
    left = (Remainder("u", 0.1, "m/s^2", 9.0, None, error, 0.032, 1.0, "m/s", True),)
    writer = SimpleNamespace(claims=claims, adopted=(), most=most, causes=lambda *args: ())
    writer.data = claims.data
    found = Writer.verdict(writer, rows, left, (), credit)
    assert found.look_for == more and found.again is (most == MOST_EFFECTS)
