"""After an effect was adopted: what is left is diagnosed, not the same effect again."""

import json
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cli import grounded
from grounded import Model, Trial
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.parts import Estimate
from grounded.diagnosis.validation.decide import Doubtful, one_group
from grounded.diagnosis.validation.limits import knowable, limits
from grounded.diagnosis.validation.ruler import Ruler
from grounded.diagnosis.writer import unconfirmed
from grounded.effects import Library, LossFamily, RateFamily, memory_of, wrap
from grounded.errors import NextCommand
from grounded_trials.store.documents import write_document
from grounded_trials.workspace.adoption import to_adopt
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import read_diagnosis
from small_tasks import DT, pushed_cart

LAG = 0.12


def lagging(friction, trials=4):
    """Trials of a cart whose push lags and that has dry friction; its crude model."""
    model, found = pushed_cart(trials=1, steps=2)
    true = wrap(Library().effect("first_order_lag:u", model), {"tau": LAG}, DT)
    effect = Library().effect("coulomb_friction:v", true)
    true = wrap(effect, {"c": friction, "width": 0.01}, DT)
    rng, runs = np.random.default_rng(1), []
    for _ in range(trials):
        t = np.arange(240) * DT
        u = 0.6 * np.sin(rng.uniform(1, 3) * t) + 0.4 * np.sign(np.sin(rng.uniform(2, 4) * t))
        x, states = np.zeros(true.n), [np.zeros(true.n)]
        for value in u:
            x = true.system.step(x[None], np.array([[value]]), true.values, DT)[0]
            x[:2] += np.array([0.0003, 0.003]) * rng.standard_normal(2)
            states.append(x)
        y = np.array(states)[:, :2]
        y = y + np.array([0.002, 0.01]) * rng.standard_normal(y.shape)
        runs.append(replace(found[0], states=y, inputs=u[:, None]))
    return model, runs


def adopted(model, runs, name="first_order_lag:u", **values):
    """The model with an effect, trials with its memory beside, the memory's name."""
    better = wrap(Library().effect(name, model), values or {"tau": LAG}, DT)
    lifted = [
        replace(
            run,
            states=np.hstack([run.states, memory_of(better, model, run)]),
            state_names=better.state_names,
        )
        for run in runs
    ]
    return better, lifted, better.state_names[model.n :]


@pytest.mark.slow
def test_what_is_left_beside_an_adopted_lag_is_named():
    model, runs = lagging(0.4, trials=2)
    better, lifted, memory = adopted(model, runs)
    assert len(memory) == 1
    families = ("coulomb_friction", "viscous_friction", "delay", "input_gain", "first_order_lag")
    library = Library(tuple(map(Library().family, families)))
    options = DiagnosisOptions(library=library, hidden=memory, but={"first_order_lag:u"})
    found = diagnose(better, lifted, options)
    assert found.effects == ("coulomb_friction:v",)
    assert found.ranking[0].params["c"].value == pytest.approx(0.4, rel=0.05)
    assert 0.8 < found.gap.after < 1.2
    text = json.dumps(found.to_json())
    assert memory[0] not in text.replace("first_order_lag_u_tau", "")


def test_an_effect_of_every_run_is_not_unconfirmed_because_one_log_is_long():
    model, runs = lagging(0.0)
    better, lifted, memory = adopted(model, [runs[0], *(run.until(12) for run in runs[1:])])
    data = prepare(better, lifted, hidden=memory)
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
    once = replace(lifted[0], inputs=0 * lifted[0].inputs)
    data = claims.data = prepare(better, [once, once, once, lifted[1]], hidden=memory)
    search = HypothesisSearch(data, ())
    claims.predictor = search.predictor
    (gain,) = seen("input_gain:u", {"g": 0.3})
    assert gain.trials == ("4",)
    assert seen("input_gain:u", {"g": 0.3}, [("parameter:k", "input_gain:u")]) == ()


def late(trials, steps=400, delay=1.5 * DT):
    """Runs of a cart whose place is logged late and whose speed is not; its model with the delay.

    The cart moves on and on, so that its place where a run begins is no place where a trial began.
    """
    model, runs = pushed_cart(trials=trials, steps=steps, noise=0.0)
    rng, found = np.random.default_rng(3), []
    for run in runs:
        t, u = np.arange(steps + 1) * DT, run.inputs + 0.5
        x, true = np.zeros(2), [np.zeros(2)]
        for value in u:
            x = model.system.step(x[None], value[None], model.values, DT)[0]
            x[1] += 0.003 * rng.standard_normal()
            true.append(x)
        place = np.interp(t - delay, t, np.array(true)[:, 0]) + 0.002 * rng.standard_normal(len(t))
        states = np.column_stack([place, np.full(len(t), np.nan)])
        found.append((replace(run, states=states, inputs=u), np.array(true)))
    better = wrap(Library().effect("sensor_delay:x", model), {"d": delay}, DT)
    return model, better, found


def test_true_values_behind_a_late_log_begin_where_the_log_is(trials=2):
    model, better, found = late(trials)
    memory = better.state_names[model.n :]
    lifted = [
        replace(
            run,
            states=np.hstack([run.states, memory_of(better, model, run)]),
            state_names=better.state_names,
        )
        for run, _ in found
    ]
    data = prepare(better, lifted, hidden=memory)
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
    assert np.abs(begun[:, 0]).max() > 5.0 and len(begun) > trials
    assert np.abs(fit.track[0, :, now] - begun[:, 0]).max() < 0.01
    assert np.abs(fit.track[0, :, speed] - begun[:, 1]).max() < 0.05
    ruler = Ruler(search.predictor)
    assert ruler.errors(fit).rms[ruler.steps.index(round(1 / DT)), place] < 0.02


def workspace(folder, effects, diagnosed, ranking):
    """A pendulum's workspace with adopted effects and a diagnosis that claims `ranking`."""
    made = grounded("init", folder, "--example", "pendulum")
    assert made.code == 0, made.err
    config = folder / "grounded.toml"
    rows = "\n".join(f"    {row}," for row in effects)
    text = config.read_text().replace("[model]\n", f"[model]\neffects = [\n{rows}\n]\n", 1)
    config.write_text(text)
    names = [row["effect"] for row in ranking]
    document = {
        "verdict": {"kind": "effect", "effects": names, "sentence": "It is so."},
        "ranking": ranking,
        "diagnosed": diagnosed,
        "where": {"channels": [], "times": [], "regions": []},
        "gap": {"before": 2.0, "after": 1.0, "floor": 1.0, "horizon_s": 1.0, "held_out": True},
        "indistinguishable": [],
        "next_trial": "",
        "parameters": {},
    }
    (folder / "reports").mkdir(exist_ok=True)
    write_document(folder / "reports" / "diagnosis.json", document)
    return config


def row(effect, **values):
    params = {
        k: {"value": v, "std": 0.0, "unit": "1", "interval": [v, v]} for k, v in values.items()
    }
    return {
        "effect": effect,
        "params": params,
        "fixed": {},
        "evidence": 9.0,
        "gap_after": 1.0,
        "claimed": True,
    }


def effects_of(config):
    return tomllib.loads(config.read_text())["model"]


def test_more_of_an_adopted_effect_changes_its_numbers(tmp_path):
    friction = '{name = "viscous_friction:omega", k = 0.3}'
    known = {"viscous_friction_omega_k": 0.3, "l": 0.5}
    config = workspace(
        tmp_path / "ws",
        [friction],
        {"trials": [], "adopted": [{"name": "viscous_friction:omega", "k": 0.3}], "nominal": known},
        [row("parameter:viscous_friction_omega_k", d=0.05), row("parameter:l", d=0.01)],
    )
    names = ["parameter:viscous_friction_omega_k", "parameter:l"]
    read = read_diagnosis(tmp_path / "ws" / "reports")
    assert read is not None
    advice = to_adopt(Folder(tmp_path / "ws"), read)
    assert advice == NextCommand("adopt", tuple(names))  # fit knows the model's own numbers only
    for _ in range(2):  # twice is once
        done = grounded("-C", tmp_path / "ws", "adopt", *names)
        assert done.code == 0, done.err
        model = effects_of(config)
        assert model["effects"] == [{"name": "viscous_friction:omega", "k": 0.35}]
        assert model["params"]["l"] == pytest.approx(0.51)
    assert grounded("-C", tmp_path / "ws", "status").code == 0


def test_adopt_lists_the_values_of_adopted_effects_that_it_rewrites(tmp_path):
    friction = '{name = "viscous_friction:omega", k = 0.3}'
    workspace(
        tmp_path / "ws",
        [friction, '{name = "delay:torque", d = 0.02}'],
        {"trials": [], "adopted": [], "nominal": {"viscous_friction_omega_k": 0.3, "l": 0.5}},
        [row("parameter:viscous_friction_omega_k", d=0.05), row("parameter:l", d=0.01)],
    )
    adopt = ["adopt", "parameter:viscous_friction_omega_k", "parameter:l"]
    out = " ".join(grounded("-C", tmp_path / "ws", *adopt).out.split())
    assert "0.3000 -> 0.3500" in out and "delay:torque" not in out
    out = " ".join(grounded("-C", tmp_path / "ws", "adopt", "--undo").out.split())
    assert "0.3500 -> 0.3000" in out


LATE, FILTER = 0.1, 0.07


def seen_late(trials=3, steps=260):
    """A disturbed cart behind a motor, seen by a late camera; its program filters the speed."""
    model = Model(
        name="motor",
        states={"x": "m", "v": "m/s", "f": "m/s^2"},
        inputs={"u": "m/s^2"},
        roles={"position": ("x",), "speed": "v"},
        derivative=lambda s, a, p: {"x": s.v, "v": s.f - 0.8 * s.v, "f": (a.u - s.f) / 0.2},
    )
    rng, runs, back = np.random.default_rng(2), [], round(LATE / DT)
    for _ in range(trials):
        t = np.arange(steps + back) * DT
        u = 0.6 * np.sin(rng.uniform(1, 3) * t) + 0.4 * np.sign(np.sin(rng.uniform(2, 4) * t))
        x, states = np.zeros(3), [np.zeros(3)]
        for value in u:
            x = model.system.step(x[None], np.array([[value]]), model.values, DT)[0]
            x = x + np.array([0.0, 0.01, 0.0]) * rng.standard_normal(3)
            states.append(x)
        y = np.array(states)[back:]
        y[:, :2] = np.array(states)[: steps + 1, :2]  # what was so long ago
        for k in range(1, len(y)):
            y[k, 1] = y[k - 1, 1] + DT / (FILTER + DT) * (y[k, 1] - y[k - 1, 1])
        y += np.array([0.002, 0.004, 0.01]) * rng.standard_normal(y.shape)
        names = (model.state_names, model.input_names)
        runs.append(Trial(y, u[back:, None], DT, *names, start_inputs=u[back - 1 : back]))
    return model, runs


def test_a_mean_that_was_left_out_is_left_out_once_its_delay_is_adopted():
    model, runs = seen_late(trials=2)
    back, differences = 3, []
    for run in runs:
        x = run.states[:, 0]
        v = (x - np.r_[np.full(back, x[0]), x[:-back]]) / (back * DT)
        differences.append(replace(run, states=np.column_stack([x, v, run.states[:, 2]])))
    looked = preflight(model, differences)
    assert {f.kind for f in looked.findings if f.signal == "v"} >= {"delay", "smoothed"}
    (late,) = (f.delay_s for f in looked.findings if f.signal == "v" and f.kind == "delay")
    better, lifted, hidden = adopted(model, differences, "sensor_delay:v", d=late)
    again = preflight(better, lifted, hidden)
    assert [(f.signal, f.kind) for f in again.findings] == [("v", "smoothed")]
    data = prepare(better, list(again.trials), None, None, hidden)
    assert not limits(data, again.left_out).findings
    assert not limits(data, again.left_out).no_cause
