"""What is searched, and how far, follows from the model and the log."""

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.validation.limits import knowable
from grounded.effects import InputFamily, Library, MemoryFamily


def only(*names):
    """Options of a diagnosis by a few families."""
    library = Library()
    return DiagnosisOptions(library=Library(tuple(library.family(name) for name in names)))


def logged(model, states, inputs, dt):
    """A trial of a model, with its names."""
    return Trial(np.array(states), np.array(inputs), dt, model.state_names, model.input_names)


def slide(s, a, p, dt):
    """The force of a slide that is dragged past a spring; `was` is where its handle was."""
    return {"f": p.k * np.tanh((a.pull - s.was) / 2e-3), "was": a.pull}


def branching(s, a, p, dt):
    """The same, of a function that can't be traced."""
    return slide(s, a, p, dt) if a.pull < 1e9 else {"f": 0.0, "was": 0.0}


def dragged(step, play, count=160, dt=0.04):
    """Two logs of the slide, whose handle has some play; where it was is in none of them."""
    k = Param(30.0, "N", std=3.0)
    model = Model({"f": "N", "was": "m"}, {"pull": "m"}, {"k": k}, step=step)
    rng, trials = np.random.default_rng(2), []
    for size, rate in ((0.09, 2.1), (0.14, 1.4)):
        pull, at = size * np.sin(rate * np.arange(count) * dt), [0.0]
        for now in pull:
            at.append(min(max(at[-1], now - play / 2), now + play / 2))
        force = np.r_[0.0, 30.0 * np.tanh(np.diff(at) / 2e-3)] + 0.4 * rng.normal(size=count + 1)
        states = np.c_[force, np.full(count + 1, np.nan)]
        trials.append(logged(model, states, pull[:, None], dt))
    return model, trials


@pytest.mark.parametrize("step", [slide, branching])
def test_a_state_that_the_commands_alone_determine_is_an_exact_memory(step):
    model, trials = dragged(step, 0.0, 20)
    data = prepare(model, trials)
    assert data.exact == data.hidden == (1,)
    np.testing.assert_allclose(data.states[1:21, 1], trials[0].inputs[:, 0])


@pytest.mark.slow
def test_a_play_before_a_models_own_memory_is_found(play=0.021):
    model, trials = dragged(slide, play)
    found = diagnose(model, trials, only("backlash", "dead_zone", "input_gain", "parameter"))
    claimed = [row for row in found.ranking if row.claimed]
    assert [row.effect for row in claimed] == ["backlash:pull"] * (play > 0)
    assert all(row.values["b"] == pytest.approx(play, rel=0.1) for row in claimed)


def flushed(late, steps=260, dt=0.5):
    """A bath with a time constant of 40 s; warm water arrives `late` steps after its valve."""
    model = Model(
        {"T": "degC"},
        {"valve": "1"},
        {"k": Param(11.0, "degC", 5.0, 30.0), "tau": Param(40.0, "s")},
        derivative=lambda s, a, p: {"T": (p.k * a.valve - s.T) / p.tau},
    )
    rng, trials = np.random.default_rng(8), []
    for levels in ((0.2, 0.9, 0.4, 0.7), (0.8, 0.1, 0.6, 0.3)):
        valve, T = np.repeat(levels, steps // 4), [0.0]
        for k in range(steps):
            arrives = valve[k - late] if k >= late else 0.0
            T.append(12.0 * arrives + (T[-1] - 12.0 * arrives) * np.exp(-dt / 40.0))
        noisy = np.array(T)[:, None] + 0.02 * rng.normal(size=(steps + 1, 1))
        trials.append(logged(model, noisy, valve[:, None], dt))
    return model, trials


@pytest.mark.slow
def test_a_dead_time_of_many_steps_is_found():
    model, trials = flushed(14)
    found = diagnose(model, trials, only("delay", "first_order_lag", "rate_limit", "input_gain"))
    claimed = [row for row in found.ranking if row.claimed]
    assert [row.effect for row in claimed if row.effect != "input_gain:valve"] == ["delay:valve"]
    assert claimed[0].values["d"] == pytest.approx(7.0, abs=0.2)


def cart(right, turns):
    """Logs of a cart of two wheels under proportional commands, each of which acts 0.3 too far."""
    model = Model(
        {"v": "m/s", "w": "rad/s"},
        {"a": "1", "b": "1"},
        {"k": Param(2.0, "1/s", std=0.02)},
        derivative=lambda s, u, p: {
            "v": p.k * (u.a + u.b - s.v),
            "w": p.k * (turns * (u.a - u.b) - s.w),
        },
    )
    rng, trials = np.random.default_rng(3), []
    for _ in range(2):
        u = np.repeat(rng.uniform(-1, 1, 8), 10)[:, None] * [1.0, right]
        x = [np.zeros(2)]
        for now in u:
            x.append(model.system.step(x[-1][None], now[None] + 0.3, model.values, 0.1)[0])
        trials.append(logged(model, np.array(x) + 4e-3 * rng.normal(size=(81, 2)), u, 0.1))
    return model, trials


@pytest.mark.parametrize(
    ("right", "turns", "single"), [(1.0, 0.0, False), (0.4, 0.0, False), (1.0, 3.0, True)]
)
def test_of_inputs_that_no_trial_tells_apart_only_all_together_are_blamed(right, turns, single):
    """Wheels that also turn the cart are told apart by that, whatever they are sent."""
    model, trials = cart(right, turns)
    data, library = prepare(model, trials), Library()
    offered = knowable(data, library.candidates(model, data.scales))
    acting = [e for e in offered if isinstance(e.family, InputFamily | MemoryFamily)]
    of_all = {e.family.name for e in acting if e.site.targets == ("a", "b")}
    assert len(acting) == len({e.name for e in acting})
    assert of_all == {e.family.name for e in acting}
    assert any(len(e.site.targets) == 1 for e in acting) == single
    for effect in acting:
        assert library.effect(effect.name, model, data.scales).site.targets == effect.site.targets
