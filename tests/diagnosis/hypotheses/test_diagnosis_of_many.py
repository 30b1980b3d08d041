"""Five causes at once: more effects are looked for where the first three leave a gap."""

from types import SimpleNamespace

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.hypotheses.attribution import attribute, promised
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.validation.own_numbers import SURE
from grounded.diagnosis.writer import Writer
from grounded.effects import Library

DT = 0.02
SLED = Model(
    name="sled",
    states={"x": "m", "v": "m/s"},
    inputs={"u": "N"},
    params={"m": Param(1.0, "kg")},
    derivative=lambda s, a, p: {"x": s.v, "v": a.u / p.m},
)
TRUE = {
    "delay:u": ("d", 2 * DT),
    "dead_zone:u": ("c", 0.15),
    "input_bias:u": ("b", -0.3),
    "viscous_friction:v": ("k", 0.5),
    "quadratic_drag:v": ("k", 0.3),
}


def driven(trials=4, steps=250, bias=-0.3, damping=0.5, drag=0.3):
    """Runs of a sled with all five, to and fro, the odd ones with steps."""
    rng, found = np.random.default_rng(4), []
    for k in range(trials):
        t = DT * np.arange(steps)
        u = (1 + 0.4 * k) * np.sin((1.5 + 0.6 * k) * t)
        u += 0.8 * np.sign(np.sin((2.1 + 0.3 * k) * t)) * (k % 2)
        x, rows = np.zeros(2), [np.zeros(2)]
        for late in [0.0, 0.0, *u[:-2]]:
            force = np.sign(late) * max(abs(late) - 0.15, 0.0) + bias
            for _ in range(20):
                v = x[1]
                x = x + DT / 20 * np.array([v, force - damping * v - drag * v * abs(v)])
            rows.append(x)
        states = np.array(rows) + rng.standard_normal((steps + 1, 2)) * [5e-4, 3e-3]
        found.append(Trial(states, u[:, None], DT, ("x", "v"), ("u",)))
    return found


@pytest.mark.slow
def test_more_than_three_effects_are_looked_for_where_three_leave_more_than_noise():
    """It stopped at three with a wrong damping (0.84), and asked for `--max-effects 5`."""
    families = {name.partition(":")[0] for name in TRUE} | {"input_gain", "bias"}
    library = Library(tuple(f for f in Library().families if f.name in families))
    three = diagnose(SLED, driven(), DiagnosisOptions(library=library, max_effects=3)).verdict
    assert three.look_for == 5 and len(three.effects) == 3
    found = diagnose(SLED, driven(), DiagnosisOptions(library=library))
    assert set(found.verdict.effects) == set(TRUE) and not found.verdict.look_for
    for name, (quantity, true) in TRUE.items():
        estimate = found.ranked(name).params[quantity]
        assert abs(estimate.value - true) < max(3 * estimate.std, 0.03 * abs(true)), name
    two, stages = Library(tuple(map(library.family, ("delay", "dead_zone")))), list[str]()
    few = diagnose(SLED, driven(2), DiagnosisOptions(library=two), progress=stages.append)
    assert len(few.verdict.effects) <= 2 and not any("more effects" in one for one in stages)


@pytest.mark.slow
def test_no_effect_is_named_that_predictions_gain_next_to_nothing_by(monkeypatch):
    """A noise-free car's circle: a patch of the ground worth 0.2 % was the sixth cause."""
    monkeypatch.setattr(Writer, "unfinished", True)
    library = Library(
        tuple(map(Library().family, ("delay", "dead_zone", "input_bias", "coupling")))
    )
    stages, trials = list[str](), driven(bias=0.0, damping=0.0, drag=0.002)
    options = DiagnosisOptions(library=library)
    found = diagnose(SLED, trials, options, progress=stages.append)
    assert {"delay:u", "dead_zone:u"} <= set(found.effects)
    assert all(one.share > 0.01 for one in found.credit)
    assert sum("more effects" in one for one in stages) == 1 and not found.verdict.look_for


def test_evidence_tells_what_one_effect_more_promises():
    names = ("delay", "dead_zone", "viscous_friction")
    library = Library(tuple(map(Library().family, names)))
    data = prepare(SLED, driven(2, steps=120, bias=0.0, damping=0.0, drag=0.0))
    candidates = library.candidates(SLED, data.scales)
    found = {}
    for most in (1, 2):
        search, best = attribute(data, candidates, max_effects=most)
        known = dict(search.fits)
        with np.errstate(all="ignore"):
            found[most] = promised(search, best)
        assert len(best.hypothesis.names) == most and search.fits == known
    assert found[1] > SURE > found[2]


@pytest.mark.parametrize(
    ("source", "nats", "more"),
    [("short horizon", 60.0, True), ("short horizon", 5.0, False), ("repeats", 60.0, False)],
)
def test_evidence_is_asked_where_the_noise_floor_is_a_bound_only(monkeypatch, source, nats, more):
    """A ball's camera was 50 ms late, 119 nats: nothing stood above a floor that held the delay."""
    monkeypatch.setattr("grounded.diagnosis.writer.promised", lambda search, fit: nats)
    writer = SimpleNamespace(
        known=SimpleNamespace(no_cause=False),
        claims=SimpleNamespace(names=("a", "b", "c")),
        measured=SimpleNamespace(remainders=tuple, source=source),
        most=3,
        search=SimpleNamespace(
            chosen=lambda most: SimpleNamespace(hypothesis=SimpleNamespace(names=("a", "b", "c")))
        ),
        best=None,
    )
    assert Writer.unfinished.fget(writer) is more
    writer.most = 4  # fewer were claimed than were looked for: evidence was heard
    assert Writer.unfinished.fget(writer) is False
