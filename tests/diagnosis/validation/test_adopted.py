"""After an effect was adopted: what is left is diagnosed, not the same effect again."""

import json
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cli import grounded
from grounded import Model, Param
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.diagnosis.causes import meaning
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.parts import Diagnosis, Estimate, Made, Ranked, Verdict
from grounded.diagnosis.validation.decide import Doubtful, one_group
from grounded.diagnosis.validation.limits import knowable, limits
from grounded.diagnosis.validation.ruler import Ruler
from grounded.diagnosis.writer import unconfirmed
from grounded.effects import Library, LossFamily, RateFamily, wrap
from grounded.effects.actuator import delay_again
from grounded.errors import NextCommand
from grounded_trials.store.documents import write_document
from grounded_trials.workspace.adoption import joined, to_adopt
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import read_diagnosis
from small_tasks import DT, plain_task, pushed_cart
from stepped import library, lifted, logged, stepped
from workspaces import edit


def axis(gain):
    return Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "1"},
        params={"gain": Param(gain, "m/s^2", 0.2, 5.0), "drag": Param(0.3, "1/s")},
        roles={"position": ("x",), "speed": "v"},
        derivative=lambda s, a, p: {"x": s.v, "v": p.gain * a.u - p.drag * s.v},
        name="axis",
    )


def runs(gain, steps=200):
    """Two trials of an axis."""
    rng, found, model, t = np.random.default_rng(3), [], axis(gain), np.arange(steps) * 0.05
    for _ in range(2):
        a, b = rng.uniform(0.7, 3, 2)
        u = 0.6 * np.sin(a * t) + 0.4 * np.sin(b * t)
        states = stepped(model, u, 0.05)
        found.append(logged(model, states, u, 0.05, [1e-4, 5e-4], rng, start_inputs=u[:1]))
    return found


@pytest.mark.slow
def test_after_adoption_what_is_too_little_to_matter_is_not_claimed():
    """A gain of 1.0 that is 1.5: adopted as 1.502, its last 0.13 % are above the noise."""
    trials, few = runs(1.5, 120), library("input_gain", "viscous_friction", "delay")
    alone = diagnose(axis(1.502), trials, DiagnosisOptions(library=few))
    assert alone.effects  # seen, where nothing tells what the crude model missed
    origin = plain_task(axis(1.0), 0.05, np.zeros((121, 2)), 1.0, 2.0)
    first, found = (
        diagnose(axis(gain), trials, DiagnosisOptions(library=few, origin=origin))
        for gain in (1.0, 1.502)
    )
    assert found.effects == () and not found.credit and first.effects
    (then, now) = ([r for r in d.prediction_error if not r.whole_trial][-1] for d in (first, found))
    assert now.outset == pytest.approx(then.crude, rel=0.05)  # one ruler, before and after
    assert alone.prediction_error[0].outset == {}
    assert {c.name: c.rms for c in found.where.channels} == now.crude


@pytest.mark.parametrize("adopted", [0.095, 0.104])
def test_an_adopted_delay_is_made_longer_or_shorter(adopted, whole=0.1):
    sent = [(run, np.concatenate([run.inputs[2:], np.zeros((2, 1))])) for run in runs(1.0)]
    late = [replace(run, inputs=u).until(198) for run, u in sent]  # two steps
    model = axis(1.0)
    data = prepare(model, late, np.array([adopted]))
    effect = delay_again(Library().effect("delay:u", model, data.scales), adopted, adopted)
    predictor, change = Predictor(data), whole - adopted
    h = Hypothesis().plus(effect, {"d": change})
    all_of_it = Predictor(replace(data, latency=np.array([whole])))
    assert predictor.received(h) == pytest.approx(all_of_it.received(Hypothesis()))
    assert min(effect.free[0].grid) < 0 < max(effect.free[0].grid)
    search = HypothesisSearch(data, [effect])
    assert search.price(effect, {"d": change}) < 10.0  # a tenth of a step is no matter of stamps
    search.nulls()
    search.extended(search.exact_null(), 1)
    (best,) = search.of_size(1)
    assert best.hypothesis.values[0]["d"] == pytest.approx(change, abs=5e-4)
    said = meaning(effect, {"d": Estimate(change, 1e-4, unit="s")})
    assert said.startswith("delay:u = 0.1") and ", was " in said


def test_adopting_a_change_of_a_delay_replaces_it():
    made = Made(adopted=({"name": "delay:u", "d": 0.104},))
    row = Ranked("delay:u", {"d": Estimate(-0.004)}, claimed=True)
    found = Diagnosis(Verdict("effect", ("delay:u",)), ranking=(row,), made=made)
    _, effects = joined(found, ["delay:u"], {"delay:u": {"d": 0.104}}, {}, {})
    assert effects == {"delay:u": {"d": 0.1}}


LAG = 0.12


def lagging(friction, trials=4):
    """Trials of a cart whose push lags and that has dry friction; its crude model."""
    model, _ = pushed_cart(trials=1, steps=2)
    true = wrap(Library().effect("first_order_lag:u", model), {"tau": LAG}, DT)
    effect = Library().effect("coulomb_friction:v", true)
    true = wrap(effect, {"c": friction, "width": 0.01}, DT)
    rng, runs, t = np.random.default_rng(1), [], np.arange(240) * DT
    for _ in range(trials):
        u = 0.6 * np.sin(rng.uniform(1, 3) * t) + 0.4 * np.sign(np.sin(rng.uniform(2, 4) * t))
        x = stepped(true, u, DT, disturbed=np.array([3e-4, 3e-3, 0.0]), rng=rng)
        runs.append(logged(model, x[:, :2], u, DT, [2e-3, 0.01], rng))
    return model, runs


def adopted(model, runs, name="first_order_lag:u", **values):
    """The model with an effect, trials with its memory beside, the memory's name."""
    better = wrap(Library().effect(name, model), values or {"tau": LAG}, DT)
    return better, [lifted(better, model, run) for run in runs], better.state_names[model.n :]


@pytest.mark.slow
def test_what_is_left_beside_an_adopted_lag_is_named():
    model, runs = lagging(0.4, trials=2)
    better, with_memory, memory = adopted(model, runs)
    assert len(memory) == 1
    families = ("coulomb_friction", "viscous_friction", "delay", "input_gain", "first_order_lag")
    library = Library(tuple(map(Library().family, families)))
    options = DiagnosisOptions(library=library, hidden=memory, but={"first_order_lag:u"})
    found = diagnose(better, with_memory, options)
    assert found.effects == ("coulomb_friction:v",)
    assert found.ranking[0].params["c"].value == pytest.approx(0.4, rel=0.05)
    assert 0.8 < found.gap.after < 1.2
    text = json.dumps(found.to_json())
    assert memory[0] not in text.replace("first_order_lag_u_tau", "")


def test_an_effect_of_every_run_is_not_unconfirmed_because_one_log_is_long():
    model, runs = lagging(0.0)
    better, with_memory, memory = adopted(model, [runs[0], *(run.until(12) for run in runs[1:])])
    data = prepare(better, with_memory, hidden=memory)
    search = HypothesisSearch(data, ())
    claims = SimpleNamespace(known=SimpleNamespace(no_cause=False), data=data)
    claims.predictor = search.predictor
    claims.estimates = lambda fit: [{"b": Estimate(0.3, 0.01)}]

    def fitted(name, values):
        effect = Library().effect(name, better, data.scales)
        (fit,) = search.refined([search.fresh(Hypothesis().plus(effect, values))], 1)
        return fit

    def seen(name, values, groups=()):
        return unconfirmed(claims, [Doubtful(name, 50.0, fitted(name, values), (3,))], groups)

    assert one_group(search, fitted("sensor_bias:v", {"b": 0.3}), "sensor_bias:v") == ()
    once = replace(with_memory[0], inputs=0 * with_memory[0].inputs)
    data = claims.data = prepare(better, [once, once, once, with_memory[1]], hidden=memory)
    search = HypothesisSearch(data, ())
    claims.predictor = search.predictor
    (gain,) = seen("input_gain:u", {"g": 0.3})
    assert gain.trials == ("4",)
    assert seen("input_gain:u", {"g": 0.3}, [("parameter:k", "input_gain:u")]) == ()


def late(steps=400, delay=1.5 * DT):
    """Runs of a cart whose place is logged late and whose speed is not; its model with the delay.

    The cart moves on and on, so that its place where a run begins is no place where a trial began.
    """
    model, runs = pushed_cart(trials=2, steps=steps, noise=0.0)
    rng, found, t = np.random.default_rng(3), [], np.arange(steps + 1) * DT
    for run in runs:
        u = run.inputs + 0.5
        true = stepped(model, u, DT, disturbed=np.array([0.0, 3e-3]), rng=rng)
        place = np.interp(t - delay, t, true[:, 0]) + 0.002 * rng.standard_normal(len(t))
        states = np.column_stack([place, np.full(len(t), np.nan)])
        found.append((replace(run, states=states, inputs=u), true))
    return model, wrap(Library().effect("sensor_delay:x", model), {"d": delay}, DT), found


def test_true_values_behind_a_late_log_begin_where_the_log_is():
    model, better, found = late()
    memory = better.state_names[model.n :]
    data = prepare(better, [lifted(better, model, run) for run, _ in found], hidden=memory)
    place, speed, now = (better.state_names.index(n) for n in ("x", "v", "x_true"))
    assert sorted(data.behind) == sorted(data.hidden) and set(data.behind.values()) == {place}
    np.testing.assert_array_equal(data.y[..., now], data.y[..., place])
    assert not data.seen[..., now].any() and data.told[now] and not data.told[speed]
    assert [(one.code, one.about) for one in limits(data).findings] == [
        ("model.unmeasured", ("v",))
    ]
    offered = Library().candidates(better, data.scales)
    names = [effect.name for effect in knowable(data, offered)]
    assert "coulomb_friction:v" in names and "sensor_delay:x" in names
    moving = Library().candidates(model, data.scales)
    acts = {e.name for e in moving if isinstance(e.family, RateFamily | LossFamily)}
    assert acts <= {*names}  # on the true values
    search = HypothesisSearch(data, ())
    fit, true = search.nulls(), np.concatenate([states for _, states in found])
    begun = true[data.state_at[:, 0]]
    assert np.abs(begun[:, 0]).max() > 5.0 and len(begun) > 2
    assert np.abs(fit.track[0, :, now] - begun[:, 0]).max() < 0.01
    assert np.abs(fit.track[0, :, speed] - begun[:, 1]).max() < 0.05
    ruler = Ruler(search.predictor)
    assert ruler.errors(fit).rms[ruler.steps.index(round(1 / DT)), place] < 0.02


def workspace(folder, effects, diagnosed, **values):
    """A pendulum's workspace with adopted effects and a diagnosis that claims some values more."""
    made = grounded("init", folder, "--example", "pendulum")
    assert made.code == 0, made.err
    edit(folder, effects=", ".join(effects))
    params = {name: {"d": Estimate(d, 0.0, (d, d), "1")} for name, d in values.items()}
    ranking = [Ranked(f"parameter:{n}", p, {}, 9.0, 1.0, claimed=True) for n, p in params.items()]
    verdict = Verdict("effect", tuple(row.effect for row in ranking))
    found = Diagnosis(verdict, ranking=tuple(ranking)).to_json() | {"diagnosed": diagnosed}
    (folder / "reports").mkdir(exist_ok=True)
    write_document(folder / "reports" / "diagnosis.json", found)
    return ["adopt", *verdict.effects]


FRICTION = '{name = "viscous_friction:omega", k = 0.3}'
NOMINAL = {"viscous_friction_omega_k": 0.3, "l": 0.5}
MORE = {"viscous_friction_omega_k": 0.05, "l": 0.01}


def test_more_of_an_adopted_effect_changes_its_numbers(tmp_path):
    known = [{"name": "viscous_friction:omega", "k": 0.3}]
    diagnosed = {"trials": [], "adopted": known, "nominal": NOMINAL}
    adopt = workspace(tmp_path / "ws", [FRICTION], diagnosed, **MORE)
    read = read_diagnosis(tmp_path / "ws" / "reports")
    assert read is not None
    advice = to_adopt(Folder(tmp_path / "ws"), read)
    assert advice == NextCommand(
        "adopt", tuple(adopt[1:])
    )  # fit knows the model's own numbers only
    for _ in range(2):  # twice is once
        done = grounded("-C", tmp_path / "ws", *adopt)
        assert done.code == 0, done.err
        model = tomllib.loads((tmp_path / "ws" / "grounded.toml").read_text())["model"]
        assert model["effects"] == [{"name": "viscous_friction:omega", "k": 0.35}]
        assert model["params"]["l"] == pytest.approx(0.51)
    assert grounded("-C", tmp_path / "ws", "status").code == 0


def test_adopt_lists_the_values_of_adopted_effects_that_it_rewrites(tmp_path):
    effects = [FRICTION, '{name = "delay:torque", d = 0.02}']
    diagnosed = {"trials": [], "adopted": [], "nominal": NOMINAL}
    adopt = workspace(tmp_path / "ws", effects, diagnosed, **MORE)
    out = " ".join(grounded("-C", tmp_path / "ws", *adopt).out.split())
    assert "0.3000 -> 0.3500" in out and "delay:torque" not in out
    out = " ".join(grounded("-C", tmp_path / "ws", "adopt", "--undo").out.split())
    assert "0.3500 -> 0.3000" in out


def seen_late(steps=260, back=2):
    """A disturbed cart behind a motor, seen by a late camera; its speed from differences."""
    model = Model(
        name="motor",
        states={"x": "m", "v": "m/s", "f": "m/s^2"},
        inputs={"u": "m/s^2"},
        roles={"position": ("x",), "speed": "v"},
        derivative=lambda s, a, p: {"x": s.v, "v": s.f - 0.8 * s.v, "f": (a.u - s.f) / 0.2},
    )
    rng, runs, t = np.random.default_rng(2), [], np.arange(steps + back) * DT
    for _ in range(2):
        u = 0.6 * np.sin(rng.uniform(1, 3) * t) + 0.4 * np.sign(np.sin(rng.uniform(2, 4) * t))
        true = stepped(model, u, DT, disturbed=np.array([0.0, 0.01, 0.0]), rng=rng)
        x = true[: steps + 1, 0] + 0.002 * rng.standard_normal(steps + 1)
        v = (x - np.r_[np.full(3, x[0]), x[:-3]]) / (3 * DT)
        f = true[back:, 2] + 0.01 * rng.standard_normal(steps + 1)
        states = np.column_stack([x, v, f])
        runs.append(logged(model, states, u[back:], DT, start_inputs=u[back - 1 : back]))
    return model, runs


def test_a_mean_that_was_left_out_is_left_out_once_its_delay_is_adopted():
    model, runs = seen_late()
    looked = preflight(model, runs)
    assert {f.kind for f in looked.findings if f.signal == "v"} >= {"delay", "smoothed"}
    (late,) = (f.delay_s for f in looked.findings if f.signal == "v" and f.kind == "delay")
    better, with_memory, hidden = adopted(model, runs, "sensor_delay:v", d=late)
    again = preflight(better, with_memory, hidden)
    assert [(f.signal, f.kind) for f in again.findings] == [("v", "smoothed")]
    data = prepare(better, list(again.trials), None, None, hidden)
    assert not limits(data, again.left_out).findings
    assert not limits(data, again.left_out).no_cause
