"""The diagnosis: its filter against dense algebra, its verdicts on known answers."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded import GroundedError, Trial
from grounded.diagnosis.diagnose import diagnose
from grounded.diagnosis.error_report import Remainder
from grounded.diagnosis.levels import NATS
from grounded.diagnosis.parts import Diagnosis, Ranked, Verdict
from grounded.diagnosis.validation.claims import fewest
from grounded.diagnosis.writer import Writer
from grounded.models.pendulum import model as pendulum
from grounded.search.design import probe
from small_tasks import DT, plain_task, pushed_cart


@pytest.mark.slow
def test_one_effect_is_named_with_its_size():
    model, trials = pushed_cart(friction=0.4)
    found = diagnose(model, trials)
    assert found.ranking[0].effect == "coulomb_friction:v"
    assert found.kind == "effect", found.sentence
    assert found.ranking[0].params["c"].value == pytest.approx(0.4, rel=0.1)
    assert found.gap.after < 1.25 < found.gap.before
    assert found.where.channels[0].name == "v"


def test_as_few_parameters_are_selected_as_leave_nothing_to_the_others():
    ratios = np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])  # K, m, I: K / m and K / I are known
    H, b = 3000 * ratios.T @ ratios + np.eye(3), np.array([-0.02, 1.8, 2.1])
    free, _ = fewest(H, b, range(3))
    assert {*free} == {0, 1, 2}  # the first alone would do most of it
    free, left = fewest(H, b, [1, 2])
    assert {*free} == {1, 2} and left < NATS


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
    assert not best.little
    assert probe(task, base, replace(tied, equivalent=tied.indistinguishable), trials) is None


def test_the_diagnosis_does_not_reach_the_simulated_truth():
    import subprocess
    import sys

    code = (
        "import sys, grounded.diagnosis.diagnose, grounded.search.design;"
        "bad = [m for m in sys.modules if m.startswith(('grounded.models', 'grounded.plant',"
        " 'grounded.experiments', 'grounded.challenge'))]; assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("most", "error", "more"),
    [(3, 0.056, True), (2, 0.056, False), (3, 0.033, False)],
)
def test_where_as_many_as_were_looked_for_leave_more_than_noise_more_are_looked_for(
    most, error, more
):
    claimed = [f"viscous_friction:{k}" for k in range(max(most, 3))]
    rows = tuple(Ranked(name, {}, {}, 50.0, claimed=True) for name in claimed)
    claims = SimpleNamespace(
        moved=(),
        names=claimed,
    )
    left = (Remainder("u", 0.1, "m/s^2", 9.0, None, error, 0.032, 1.0, "m/s", True),)
    writer = SimpleNamespace(claims=claims, adopted=(), most=most, causes=lambda *args: ())
    writer.known = SimpleNamespace(no_cause=False)
    found = Writer.verdict(writer, Diagnosis(Verdict("several"), ranking=rows, leftover=left))
    assert found.again is more
