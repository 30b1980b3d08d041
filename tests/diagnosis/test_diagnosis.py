"""The diagnosis: its filter against dense algebra, its verdicts on known answers."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded import GroundedError, Model, Param, Trial
from grounded.challenge import judge, make, oracle, sealed, summary
from grounded.diagnosis.cause_words import meaning
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.error_report import Credit, Remainder, RulerRow
from grounded.diagnosis.excitation import probe
from grounded.diagnosis.hypotheses.leftover import whiteness
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.report import Estimate, Ranked
from grounded.diagnosis.ruler_words import rest
from grounded.diagnosis.validation.blame import ENOUGH, Blame, fewest, loss, still
from grounded.diagnosis.validation.claims import has_size
from grounded.diagnosis.validation.prediction_error import _stump, by_time
from grounded.diagnosis.verdict import MOST_EFFECTS, _moved, sentence, verdict
from grounded.effects import Library, wrap
from grounded.effects.memory import shifted
from grounded.filter import kalman
from grounded.models.pendulum import model as pendulum
from grounded.policy import Policy
from grounded.task import Task
from grounded.utility import Reward
from small_tasks import DT, pushed_cart


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


def test_a_missing_measurement_says_nothing():
    A, Q, R, d, r = random_filter(np.random.default_rng(2))
    L, B, n, _ = A.shape
    seen = np.ones((L + 1, B, n))
    seen[2, 0, 1] = 0
    ends = []
    for value in (0.0, 100.0):
        r[2, 0, 1] = value
        g = kalman.gains(kalman.LinearSystem(A, Q, R, seen, R[0]))
        white, _ = kalman.innovations(g, d, r)
        ends.append((white**2).sum() + g.logdet.sum())
    assert ends[0] == pytest.approx(ends[1])


def test_a_delay_of_any_fraction():
    u = np.arange(1.0, 6.0)[None]
    np.testing.assert_allclose(shifted(u, np.zeros(1), 1.0)[0], [0, 1, 2, 3, 4])
    np.testing.assert_allclose(shifted(u, np.zeros(1), 1.25)[0], [0, 0.75, 1.75, 2.75, 3.75])


def test_whiteness_is_the_chance_that_white_noise_is_as_correlated():
    white = np.random.default_rng(0).standard_normal((200, 5, 2))
    white[1:, :, 1] += 0.3 * white[:-1, :, 1]
    found = whiteness(SimpleNamespace(white=white), np.ones((201, 5, 2)))
    assert 0.01 < found["0"] <= 1 and found["1"] < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("truth", "name", "quantity", "value"),
    [
        ({"friction": 0.4}, "coulomb_friction:v", "c", 0.4),
        ({"dead": 0.15}, "dead_zone:u", "c", 0.15),
    ],
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


@pytest.mark.slow
def test_no_effect_is_claimed_where_there_is_none():
    for seed in range(3):
        model, trials = pushed_cart(seed=seed)
        found = diagnose(model, trials)
        assert found.kind == "none", found.sentence
        assert found.effects == ()
        assert found.gap.before == pytest.approx(1.0, abs=0.25)


@pytest.mark.slow
def test_a_parameter_that_is_off_is_blamed_as_a_parameter():
    model, trials = pushed_cart()
    found = diagnose(model.with_values({"tau": 1.2}), trials)
    assert "parameter:tau" in [r.effect for r in found.ranking[:3]]
    assert found.gap.after < 1.2


@pytest.mark.slow
def test_parameters_that_are_off_are_named_most_important_first():
    model, trials = pushed_cart(trials=6)
    found = diagnose(model.with_values({"k": 1.9, "tau": 0.88}), trials)
    named = {f"parameter:{name}" for name in ("k", "tau")}
    assert set(found.effects) & named, found.sentence
    assert set(found.effects) <= named
    assert found.kind == ("effect" if len(found.effects) == 1 else "several")
    claimed = [row for row in found.ranking if row.claimed]
    assert tuple(row.effect for row in claimed) == found.effects
    assert [row.effect for row in found.ranking[: len(claimed)]] == list(found.effects)
    evidences = [row.evidence for row in claimed]
    assert evidences == sorted(evidences, reverse=True)
    for row in claimed:
        assert f"{row.effect.partition(':')[2]} " in found.sentence
    # a gain of the input and the parameter behind it are one thing, and that is said
    same = {group[0]: group[1:] for group in found.indistinguishable}
    assert "input_gain:u" in same.get("parameter:k", ()), found.sentence
    assert "viscous_friction:v" in same.get("parameter:tau", ()), found.sentence


def test_a_parameter_that_did_not_move_is_not_blamed_for_those_that_did():
    ratios = np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])  # K, m, I: K / m and K / I are known
    H, b = 3000 * ratios.T @ ratios + np.eye(3), np.array([-0.02, 1.8, 2.1])
    free, _ = fewest(H, b, range(3))
    assert {*free} == {0, 1, 2} and still(H, b, free) == [0]  # K alone would do most of it
    free, left = fewest(H, b, [1, 2])
    assert {*free} == {1, 2} and left < ENOUGH and still(H, b, free) == []
    assert still(np.eye(2), np.array([0.2, 1.2]), [0]) == []  # the other may be none, too


def test_of_two_parameters_that_are_one_only_one_is_blamed():
    H = np.array([[100.0, 99.0], [99.0, 100.0]])
    b = np.array([0.5, 0.5])
    assert loss(H, b, [0, 1]) == 0
    assert loss(H, b, [0]) < 1 < 40 < loss(H, b, [])


def test_sentences_are_english():
    model = Model(
        states={"x": "m", "v": "m/s", "w": "1"},
        inputs={"steering": "1", "throttle": "1", "u": "N"},
        params={"k": Param(1.0, "1/s", std=0.3)},
        roles={"position": ("x",), "speed": "v"},
        derivative=lambda s, a, p: {"x": s.v, "v": a.throttle + a.u, "w": p.k * a.steering},
    )

    def said(name, **values):
        effect = Library().effect(name, model)
        units = {q.name: q.unit for q in effect.quantities}
        known = {n: Estimate(v, 0.0, (v, v), units[n]) for n, v in values.items()}
        return sentence([meaning(effect, known)])

    assert said("delay:steering+throttle+u", d=0.04) == (
        "The steering, the throttle and the input u arrive 0.04 s later than modelled."
    )
    assert said("delay:u", d=0.04) == "The input u arrives 0.04 s later than modelled."
    assert said("offset:v", c=0.1) == "The speed v drifts by 0.1 m/s^2."
    assert said("offset:w", c=0.1) == "The state w drifts by 0.1 1/s."
    assert said("input_gain:throttle", g=-0.2) == "The throttle acts 20 % weaker than modelled."
    assert said("input_gain:throttle", g=-1.5) == (
        "The throttle acts the other way round (with 50 % of the modelled strength)."
    )
    assert said("input_gain:throttle", g=-2.1) == (
        "The throttle acts the other way round: flip its sign in model.py, or, if only the log "
        "has it so, multiply the scale in [log.input.throttle] by -1 (a missing one is 1), and "
        "[limits] if they were taken from the log, discard the trials and ingest their logs again."
    )
    assert said("rate_gain:v", g=-2.0) == "The speed v changes the other way round."
    assert said("input_fade:throttle", k=-0.05) == (
        "The gain of the throttle gets 5 % higher every second."
    )
    assert said("input_fade:throttle", k=0.05) == (
        "The gain of the throttle gets 5 % lower every second (for example a battery that sags)."
    )
    assert said("parameter:k", d=0.1) == "The parameter k should be 1.1 1/s instead of 1 1/s."
    assert said("patch:v", c=0.05, x0=0.112, radius=0.086) == (
        "The rate of the speed v differs by 0.05 m/s^2 around x = 0.112 m, within about 0.086 m."
    )
    bent = "40 % lower at 1, its largest command in the log, than near zero"
    curve = f"The gain of the throttle is {bent}."
    assert said("input_curve:throttle", a=0.0, b=-0.5) == curve  # 0.75 of 1.25
    assert f"is 50 % higher for positive commands than for negative ones and {bent}" in (
        said("input_curve:throttle", a=0.2, b=-0.5)  # 1.2 of 0.8
    )
    dry, sticky = "0.4 N to dry friction", "0.1 N s/m times the speed v to viscous friction"
    for c, b, told in ((0.4, 0.1, f"{dry} and {sticky}"), (0.4, 0.0, dry), (0.0, 0.1, sticky)):
        assert said("joint_friction:u<-v", c=c, b=b) == f"The input u loses {told}."
    for effect in Library().candidates(model):
        known = {q.name: Estimate(0.1, 0, (0.1, 0.1), q.unit) for q in effect.quantities}
        text = meaning(effect, known)
        assert "{" not in text and ":" not in text, text


@pytest.mark.slow
def test_what_no_effect_explains_is_left_over():
    model, trials = pushed_cart(asymmetric=0.6, trials=6)
    found = diagnose(model, trials, DiagnosisOptions(library=Library().without(["input_curve"])))
    assert found.leftover or found.gap.after < 1.3
    if found.leftover:
        assert "v" in [left.channel for left in found.leftover]


def errors(of, **more):
    return RulerRow(1.0, False, {"omega": "rad/s"}, "trials", {"omega": of}, **more)


@pytest.mark.parametrize("effect_first", [True, False])
def test_the_cause_that_makes_most_is_named_first(effect_first):
    effect = Library().effect("viscous_friction:omega", pendulum)
    values = {q.name: Estimate(0.1, 0.0, (0.1, 0.1), q.unit) for q in effect.quantities}
    row = Ranked(effect.name, values, {}, 50.0, claimed=True)
    best = SimpleNamespace(hypothesis=SimpleNamespace(effects=(effect,)))
    known = SimpleNamespace(no_cause=False)
    claims = SimpleNamespace(
        known=known, blamed=(), best=best, parameters=lambda: {"m": Estimate(1.2, 0.01, None, "kg")}
    )
    claims.data, claims.one_clock = SimpleNamespace(model=pendulum), ()
    claims.with_rivals = dict
    claims.moved = (Blame(pendulum.param_names.index("m"), 9.0),)
    credit = [Credit(effect.name, 0.9), Credit("calibration", 0.004)]
    credit = credit if effect_first else [Credit("calibration", 0.9), Credit(effect.name, 0.1)]
    table = errors(0.5, with_effects={"omega": 0.1}, noise_floor={"omega": 0.09})
    found = verdict(claims, (row,), (), (), (table,), tuple(credit))
    damped = found.sentence.find("damped")
    moved = found.sentence.find("m should be 1.200 +- 0.010 kg")
    assert found.kind == "effect" and min(damped, moved) >= 0
    assert (damped < moved) is effect_first
    assert "omega by 0.10 rad/s instead of 0.50 rad/s (noise: 0.090 rad/s)" in found.sentence


def test_values_of_adopted_effects_that_are_off_are_told_in_their_own_words():
    """A car's: `The model's own parameters are off: sensor_delay_psi_d should be 0.0507`."""
    model = wrap(Library().effect("viscous_friction:omega", pendulum), {"k": 0.2}, DT)
    off = ["viscous_friction_omega_k", "m"]
    known = {off[0]: Estimate(0.3, 0.01, None, "1/s"), "m": Estimate(1.2, 0.01, None, "kg")}
    claims = SimpleNamespace(data=SimpleNamespace(model=model), parameters=lambda: known)
    claims.with_rivals = dict
    claims.moved = tuple(Blame(model.param_names.index(name), 9.0) for name in off)
    told = _moved(claims, ["viscous_friction:omega"])
    assert "omega is damped by 0.3 1/s (viscous_friction:omega: k = 0.300 +- 0.010 1/s" in told
    assert "instead of 0.2 (+50 %)" in told and off[0] not in told
    assert "; the model's own parameters are off: m should be 1.200 +- 0.010 kg" in told
    assert "should be" in _moved(claims, []) and "adopted" not in _moved(claims, [])


@pytest.mark.parametrize(
    ("name", "known", "listed"),
    [
        ("patch:v", {"c": (5e5, 4.5e8), "x0": (15.4, 143), "radius": (2.31, 1.8)}, False),
        ("patch:v", {"c": (0.4, 0.5), "x0": (0.01, 143), "radius": (2.31, 1.8)}, True),
        ("saturation:u", {"c": (0.0, 0.026)}, False),
        ("saturation:u", {"c": (0.3, 0.026)}, True),
        ("periodic:v", {"A": (1e-4, 0.1), "B": (0.3, 0.1), "omega": (2.0, 0.1)}, True),
        ("offset:v", {"c": (-0.1, float("inf"))}, False),
    ],
)
def test_an_explanation_without_a_size_is_not_listed(name, known, listed):
    model = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "m/s^2"},
        roles={"position": ("x",)},
        derivative=lambda s, a, p: {"x": s.v, "v": a.u},
    )
    effect = Library().effect(name, model)
    assert has_size(effect, {n: Estimate(*one) for n, one in known.items()}) is listed


def test_leftovers_that_are_not_named_are_counted():
    claims = SimpleNamespace(known=SimpleNamespace(no_cause=False), blamed=(), names=())
    off = tuple(Remainder(name, 0.1, "m/s", 9.0, None) for name in "abcd")
    said = {k: verdict(claims, (), (), off[:k], (), ()).sentence for k in (1, 3)}
    assert said[1].endswith("a is off by 0.1 m/s rms.")
    assert said[3].endswith("a is off by 0.1 m/s rms, and 2 more states are off.")
    assert verdict(claims, (), (), off[:1], (), ()).kind == "unknown"
    assert verdict(claims, (), (), (), (errors(0.1),), ()).kind == "none"


@pytest.mark.parametrize(
    ("most", "error", "more"),
    [(3, 0.056, 5), (6, 0.056, 8), (11, 0.056, 12), (12, 0.056, 0), (2, 0.056, 0), (3, 0.033, 0)],
)
def test_where_as_many_as_were_looked_for_leave_more_than_noise_more_are_looked_for(
    most, error, more
):
    """Of `most` or 3 effects; 0.033 m/s is within what noise alone may leave."""
    claimed = [f"viscous_friction:{k}" for k in range(max(most, 3))]
    rows = tuple(Ranked(name, {}, {}, 50.0, claimed=True) for name in claimed)
    claims = SimpleNamespace(
        known=SimpleNamespace(no_cause=False),
        blamed=(),
        moved=(),
        names=claimed,
        data=SimpleNamespace(model=pendulum),
        with_rivals=dict,
        one_clock=(),
        best=SimpleNamespace(hypothesis=SimpleNamespace(effects=())),
        parameters=dict,
    )
    credit = (Credit("calibration", 1.0),)
    left = (Remainder("u", 0.1, "m/s^2", 9.0, None, error, 0.032, 1.0, "m/s", True),)
    found = verdict(claims, rows, (), left, (), credit, most=most)
    assert found.look_for == more and found.again is (most == MOST_EFFECTS)
    assert ("diagnose again" in found.sentence) is found.again


def test_a_rest_above_the_noise_that_is_no_leftover_is_said_with_its_reason():
    floor = {"omega": 0.001}
    row = errors(10.0, with_effects={"omega": 0.012}, noise_floor=floor)
    assert "12 times" in rest([row]) and "0.1 %" in rest([row])
    small = rest([errors(0.013, with_effects={"omega": 0.012}, noise_floor=floor)])
    assert "%" not in small and "12 times" in small
    assert not small.startswith("omega")  # a name keeps its small letter at the head of a sentence
    assert "too little to look for a cause" in rest([row])
    assert "too little compared with how far omega moves, or differs too much by trial" in small
    assert not rest([errors(10.0, with_effects={"omega": 0.0012}, noise_floor=floor)])


@pytest.mark.parametrize("scale", [1e-6, 1.0])
def test_a_threshold_that_is_zero_but_for_rounding_reads_zero(scale):
    sides = np.linspace(0.1, 1, 25)
    y = scale * np.concatenate([-sides, np.full(50, 1.58e-7), sides])[:, None]
    gain = (y < 0).astype(float)
    row = _stump("y", y, gain, np.ones_like(y, bool), float(gain.sum()))
    assert row is not None and row.when == "y < 0" and row.share == 1
    other = (y > 0.5 * scale).astype(float)
    row = _stump("y", y, other, np.ones_like(y, bool), float(other.sum()))
    assert (
        row is not None and float(row.when.split()[-1]) > 1e-3 * scale
    )  # others are told as they are


@pytest.mark.parametrize(("within", "named"), [(0.71, False), (0.92, True)])
def test_a_part_of_what_was_driven_is_no_place_unless_the_gap_is_clearly_denser_there(
    within, named
):
    """A robot's `mostly where x < 2.38 m`, with 71 % of the gap in 50 % of the time."""
    x = np.linspace(0.0, 1.0, 1000)[:, None]
    gain = np.where(x < 0.5, within, 1 - within)
    row = _stump("x", x, gain, np.ones_like(x, bool), float(gain.sum()))
    assert (row is not None) is named
    few = np.where(x < 0.2, 4.0, 1.0)  # half of it in a fifth of the time
    row = _stump("x", x, few, np.ones_like(x, bool), float(few.sum()))
    assert row is not None and row.share == pytest.approx(0.5) and row.when == "x < 0.2"


@pytest.mark.slow
def test_without_the_family_a_look_alike_is_marked_by_what_it_leaves():
    model, trials = pushed_cart(dead=0.25, trials=6)
    library = Library().without(["dead_zone", "stall", "backlash", "stiction", "coulomb_friction"])
    found = diagnose(model, trials, DiagnosisOptions(library=library))
    assert found.kind == "unknown" or found.leftover or found.gap.after < 1.3


@pytest.mark.slow
def test_one_trial_names_no_cause():
    model, trials = pushed_cart(friction=0.5, trials=1)
    found = diagnose(model, trials)
    assert found.kind == "unknown"
    assert found.effects == ()
    assert "one trial" in found.sentence


@pytest.mark.slow
def test_a_constant_input_is_not_blamed():
    model, trials = pushed_cart(friction=0.5)
    flat = [
        Trial(t.states, np.full_like(t.inputs, 0.3), t.dt, t.state_names, t.input_names)
        for t in trials
    ]
    found = diagnose(model, flat)
    assert found.kind == "unknown"
    assert any("never changed" in s for s in found.unknowable)
    assert not any(r.effect.endswith(":u") for r in found.ranking)


def test_no_trials_and_foreign_trials_are_refused():
    model, trials = pushed_cart()
    with pytest.raises(GroundedError, match="no trials"):
        diagnose(model, [])
    with pytest.raises(GroundedError, match="states"):
        diagnose(pendulum, trials)


@pytest.mark.slow
def test_gaps_in_the_log_are_bridged_by_the_filter():
    model, trials = pushed_cart(friction=0.4)
    holed = []
    for t in trials:
        states = t.states.copy()
        states[30:40] = np.nan
        states[60:63, 1] = np.nan
        holed.append(Trial(states, t.inputs, t.dt, t.state_names, t.input_names))
    assert prepare(model, holed).steps == prepare(model, trials).steps
    found = diagnose(model, holed)
    assert found.ranking[0].effect == "coulomb_friction:v"


@pytest.mark.slow
def test_the_document_is_plain_json():
    model, trials = pushed_cart(friction=0.4, trials=2, steps=80)
    document = diagnose(model, trials).to_json()
    again = json.loads(json.dumps(document, allow_nan=False))
    for key in ("verdict", "where", "ranking", "indistinguishable", "gap", "next_trial"):
        assert key in again
    assert set(again["gap"]) >= {"horizon_s", "unit", "before", "after", "floor", "held_out"}
    assert {"effect", "params", "evidence", "gap_after", "shrinkage"} <= set(again["ranking"][0])
    assert {"value", "std", "unit"} <= set(next(iter(again["ranking"][0]["params"].values())))


@pytest.mark.slow
def test_a_probe_tells_two_explanations_apart(monkeypatch):
    model, trials = pushed_cart(dead=0.1, steps=60, trials=3)
    H = 100
    task = Task(
        model=model,
        dt=DT,
        target=np.zeros((H + 1, 2)),
        reward=Reward(np.ones(2), np.zeros(2), np.zeros(1), np.zeros(1)),
        start=np.zeros(2),
        past=np.zeros(1),
        low=np.array([-1.0]),
        high=np.array([1.0]),
    )
    found = diagnose(task, trials)
    tied = replace(
        found,
        verdict=replace(found.verdict, effects=("dead_zone:u",)),
        indistinguishable=(("dead_zone:u", found.ranking[1].effect),),
    )
    base = Policy(
        feedforward=0.3 * np.ones((H, 1)),
        low=task.low,
        high=task.high,
        dt=DT,
        state_names=model.state_names,
        input_names=model.input_names,
        depths=(1,),
        angles=(False, False),
        past=np.zeros(1),
    )
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
    monkeypatch.setattr("grounded.diagnosis.excitation.WELL", 1.0)
    left = (Remainder("v", error=0.2, floor=0.1),)  # nothing else is to be known, beside a gap
    for gap, told in ((left, True), ((), False)):
        known = replace(found, indistinguishable=(), leftover=gap)
        made = probe(task, base, known, trials)
        assert ("well known already" in made.sentence) == told == made.little
    none = replace(found, verdict=replace(found.verdict, effects=()), parameters={})
    assert probe(task, base, replace(none, indistinguishable=()), trials) is None


@pytest.mark.slow
def test_blind_cases_follow_from_their_seed_and_are_judged():
    (case,) = make("single", 1, 4, only="pendulum")
    (again,) = make("single", 1, 4, only="pendulum")
    assert sealed(case.label) == sealed(again.label)
    np.testing.assert_array_equal(case.trials[0].states, again.trials[0].states)
    known = oracle(case.model, case.trials, case.latency, case.label)
    marks = judge(case.label, diagnose(case.model, case.trials).to_json(), known)
    row = summary([marks])["single"]
    assert row["cases"] == 1
    with pytest.raises(GroundedError, match="single, double"):
        next(make("triple", 1, 0))


def test_the_diagnosis_does_not_reach_the_simulated_truth():
    import subprocess
    import sys

    code = (
        "import sys, grounded.diagnosis.diagnose, grounded.diagnosis.excitation;"
        "bad = [m for m in sys.modules if m.startswith(('grounded.models', 'grounded.plant',"
        " 'grounded.experiments', 'grounded.challenge'))]; assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_small_gain_that_comes_and_goes_is_in_no_region():
    """Of 20 nats, "100 % in the 50 % of the time in which |left| < 0.469", and as much in time."""
    rng = np.random.default_rng(3)
    time = np.tile(np.arange(400.0)[:, None], (1, 1))
    noise = rng.normal(0.0, 0.5, time.shape)
    gain = noise - noise.mean() + 20.0 / time.size  # 20 nats
    gain += np.where(time < 200, 0.04, -0.04)  # about all of it in the first half
    valid = np.ones_like(time, bool)
    whole = float(gain.sum())
    assert gain[time < 200].sum() > 0.9 * whole
    assert _stump("t", time, gain, valid, whole) is None
    told = by_time(gain, SimpleNamespace(time=time, dt=1.0))
    assert sum(part.share for part in told) == pytest.approx(1.0)
    assert min(part.share for part in told) == 0.0
    row = _stump("t", time, gain + np.where(time < 200, 1.0, 0.0), valid, whole + 200.0)
    assert row is not None and row.when == "t < 200"  # a gain that is clearly there
