"""Several effects together: diagnosis and adopted model agree on what acts on what, and when."""

import numpy as np
import pytest

from grounded import Model, Trial
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.linearise import step_jacobian
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Library, memory_start, scales_of, wrap
from grounded.effects.memory import shifted
from grounded.models.car import model as car
from grounded_trials.workspace.adopted import in_order, planner_of
from small_tasks import plain_task
from stepped import lifted, logged, slopes, stepped

DT, STEPS = 0.05, 60
LIMIT = ("rate_limit:steering", {"r": 2.0})
DELAY = ("delay:steering", {"d": 2 * DT})
PART = ("delay:steering", {"d": 2.6 * DT})
LAG = ("first_order_lag:steering", {"tau": 0.1})
ZONE = ("dead_zone:steering", {"c": 0.1})
WEAK = ("input_gain:throttle", {"g": -0.2})
THROTTLE = ("first_order_lag:throttle", {"tau": 0.1})
BIAS = ("input_bias:steering", {"b": 0.05})
PULL = ("offset:delta", {"c": 0.1})
HELD = np.array([0.0, 0.3])  # a dead zone leaves it as it is


def commands():
    """Jumps and waves, (STEPS, 2)."""
    t = np.arange(STEPS) * DT
    return np.stack([0.7 * np.sign(np.sin(4 * t)) * np.cos(t), 0.5 + 0.2 * np.sin(3 * t)], axis=1)


def task():
    rest = {"start": np.full(car.n, 0.1), "past": HELD}
    weights = dict.fromkeys(("terminal", "effort", "change"), 1.0)
    return plain_task(car, DT, np.zeros((STEPS + 1, car.n)), 1.0, 1.0, **weights, **rest)


def hypothesis(parts, model=car):
    start = np.full((2, car.n), 0.1)
    scales = scales_of(car, start, commands(), DT, STEPS * DT)
    h = Hypothesis()
    for name, values in parts:
        h = h.plus(Library().effect(name, model, scales), values)
    return h


START = np.full(car.n, 0.1)


def predicted(parts, model=car, leads=False):
    """The diagnosis' own prediction from the start, (STEPS + 1, n)."""
    empty = logged(car, np.tile(START, (STEPS + 1, 1)), commands(), DT, start_inputs=HELD)
    predictor, h = Predictor(prepare(model, [empty])), hypothesis(parts, model)
    received, x = predictor.received(h, leads=leads)[0], [START]
    for t in range(STEPS):
        x.append(predictor.advance(h, x[-1], received[t], np.array(t * DT)))
    return np.array(x)


def arriving(plan):
    """What arrives of the commands after the latency of a plan, (STEPS, m)."""
    late = [shifted(commands()[None, :, j], HELD[[j]], plan.latency[j] / DT)[0] for j in range(2)]
    return np.stack(late, axis=1)


def planned(parts):
    return planner_of(task(), dict(parts))


def adopted(parts):
    """What the adopted model plans with: a delay is latency, the rest is in the model."""
    plan = planned(parts).plan
    still = logged(car, np.tile(START, (2, 1)), commands()[:1], DT, start_inputs=HELD)
    z = np.hstack([START, memory_start(plan.model, car, still)])
    return stepped(plan.model, arriving(plan), DT, z)[:, : car.n]


@pytest.mark.parametrize(
    "parts",
    [
        (LIMIT, DELAY),
        (DELAY, LIMIT),
        (LAG, LIMIT),
        (LIMIT, LAG),
        (DELAY, ZONE, LAG),
        (WEAK, THROTTLE),
        (THROTTLE, WEAK),
        (BIAS, LIMIT, DELAY),
        (BIAS, ("backlash:steering", {"b": 0.1})),
    ],
    ids=lambda parts: " ".join(name.partition(":")[0] for name, _ in parts),
)
def test_one_order_everywhere(parts):
    want = predicted(parts)
    np.testing.assert_allclose(adopted(parts), want, atol=1e-9)


@pytest.mark.parametrize("parts", [(LIMIT, PART), (PART, ZONE, LAG), (BIAS, ZONE, PART)])
def test_what_is_late_by_a_part_of_a_step_is_bent_before_and_after_it_arrives(parts):
    off = np.abs(adopted(parts) - predicted(parts, leads=True)).max(axis=0)
    assert off[car.state_names.index("delta")] < 6e-4 and off.max() < 0.015


def test_a_gain_of_a_rate_takes_along_what_was_adopted_on_that_rate():
    old = dict([PULL, ("viscous_friction:v", {"k": 0.1})])
    model = planner_of(task(), old).plan.model
    want = predicted((("rate_gain:delta", {"g": 0.3}),), model)
    by_name = in_order(old, {"rate_gain:delta": {"g": 0.3}})
    parts = [*by_name.items()]
    beside = adopted([(PULL[0], PULL[1]), *parts[1:]])
    off, before = (np.abs(one - want).max() for one in (adopted(parts), beside))
    assert off < 5e-3 < before / 4  # half a step's kick of the one or the other
    assert by_name[PULL[0]] == {"c": pytest.approx(0.13)}
    assert by_name["viscous_friction:v"] == {"k": 0.1}  # of another rate


def test_the_memory_of_a_trial_follows_what_arrives():
    planner = planned((LIMIT, PART))
    trial = logged(car, predicted((LIMIT, PART)), commands(), DT, start_inputs=HELD)
    states, plan = planner.lift(trial).states, planner.plan
    after = plan.model.system.step(states[:-1], arriving(plan), plan.model.values, DT)
    np.testing.assert_allclose(after[:, car.n :], states[1:, car.n :], atol=1e-9)
    np.testing.assert_allclose(after, states[1:], atol=0.01)  # the model takes the limit's mean


FRICTION = ("viscous_friction:v", {"k": 0.8})
GAIN = ("rate_gain:v", {"g": 0.2})
TILT = ("offset:delta", {"c": 0.3})
TURN = ("offset:psi", {"c": 0.3})
UNDERSTEER = ("understeer:psi", {"k": 0.2})
COUPLING = ("coupling:psi<-v", {"k": 0.3})
SLIP = ("side_slip:x+y", {"k": 0.3})
SLEW = ("slew_limit:delta", {"r": 2.0})
TREND = ("trend:v", {"k": 0.1})
BOTH_ORDERS = [
    (FRICTION, GAIN),
    (TILT, FRICTION),
    (TURN, UNDERSTEER),
    (SLIP, COUPLING),
    (GAIN, SLIP),
    (FRICTION, SLEW),
    (SLEW, GAIN),
    (UNDERSTEER, TREND),
]


@pytest.mark.slow
@pytest.mark.parametrize("parts", BOTH_ORDERS, ids=lambda parts: " ".join(n for n, _ in parts))
def test_a_pair_steps_as_it_was_diagnosed(parts):
    start = [0.1, 1.0, 0.0, 0.0, 0.0, np.sin(0.1) / 0.15]
    one = logged(car, stepped(car, commands(), DT, start), commands(), DT, start_inputs=HELD)
    predictor = Predictor(prepare(car, [one]))
    h = Hypothesis()
    for name, values in parts:
        h = h.plus(Library().effect(name, car, predictor.data.scales), values)
    x, t = one.states[:-1], np.arange(STEPS) * DT
    want = predictor.advance(h, x, one.inputs, t)
    effect = np.abs(want - predictor.advance(Hypothesis(), x, one.inputs, t)).max(axis=0)
    model = planned(parts).plan.model
    clocks = np.repeat(t[:, None], model.n - car.n, axis=1)
    got = model.system.step(np.hstack([x, clocks]), one.inputs, model.values, DT)[:, : car.n]
    assert (np.abs(got - want).max(axis=0) <= 0.05 * effect + 1e-9).all()
    assert not model.system.note  # it is compiled


LATE = {
    "part of a step": [("sensor_delay:v", {"d": 0.02})],
    "two steps": [("sensor_delay:v", {"d": 0.12})],
    "filtered": [("sensor_lag:v", {"tau": 0.07})],
    "both": [("sensor_delay:v", {"d": 0.12}), ("sensor_lag:v", {"tau": 0.07})],
    "heading": [("sensor_delay:psi", {"d": 0.12})],
    "under a lag of an input": [
        ("sensor_delay:v", {"d": 0.12}),
        ("first_order_lag:throttle", {"tau": 0.1}),
    ],
}
MOVES = [
    ("coulomb_friction:v", {"c": 0.4}),
    ("rate_gain:v", {"g": 0.2}),
    ("offset:psi", {"c": 0.2}),
    ("viscous_friction:v", {"k": 0.3}),
    ("understeer:psi", {"k": 0.1}),
]


def built(parts, model=car):
    for name, values in parts:
        model = wrap(Library().effect(name, model), values, DT)
    return model


def late_data(model, base=car, steps=30):
    rng = np.random.default_rng(0)
    x, u = rng.uniform(0.2, 0.8, (steps + 1, base.n)), rng.uniform(-0.5, 0.5, (steps, base.m))
    one = Trial(x, u, DT, base.state_names, base.input_names)
    return prepare(model, [lifted(model, base, one)], hidden=model.state_names[base.n :])


def offered(name, data):
    (found,) = (e for e in Library().candidates(data.model, data.scales) if e.name == name)
    return found


@pytest.mark.parametrize(("name", "values"), MOVES, ids=lambda v: v if isinstance(v, str) else "")
@pytest.mark.parametrize("late", LATE.values(), ids=[*LATE])
def test_what_moves_a_model_with_late_logs_steps_as_the_model_that_adopts_it(late, name, values):
    model = built(late)
    data = late_data(model)
    effect, predictor = offered(name, data), Predictor(data)
    h = Hypothesis().plus(effect, effect.complete(values))
    x = np.random.default_rng(1).uniform(0.1, 1.0, (40, model.n))
    u = predictor.inputs(h)[:1, 0].repeat(40, axis=0)
    found = predictor.advance(h, x, u, np.zeros(40))
    within = built([(name, effect.complete(values)), *late])
    after = built([*late, (name, effect.complete(values))])
    for both in (within, after):
        order = [model.state_names.index(n) for n in both.state_names]
        want = both.system.step(x[:, order], u, both.values, DT)
        # a carried heading rate's own derivative is a difference here, exact there
        kept = [i for i, n in enumerate(both.state_names) if n != "psi_rate"]
        np.testing.assert_allclose(found[:, order][:, kept], want[:, kept], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "values"), MOVES[:3], ids=lambda v: v if isinstance(v, str) else ""
)
@pytest.mark.parametrize("late", [LATE["both"], LATE["part of a step"]], ids=["both", "part"])
def test_the_slopes_of_what_joins_late_logs_are_those_of_its_steps(late, name, values):
    data = late_data(built(late))
    effect, predictor = offered(name, data), Predictor(data)
    h = Hypothesis().plus(effect, effect.complete(values))
    x, u = data.y[:-1], predictor.inputs(h)
    found = slopes(lambda at: predictor.advance(h, at, u, data.time), x)
    error = np.abs(step_jacobian(predictor, h, data.y) - found).max(axis=-2)
    assert (np.quantile(error, 0.9, axis=(0, 1)) < 0.02).all()


boat = Model(
    states={"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"},
    inputs={"push": "m/s^2", "turn": "rad/s^2"},
    params={},
    derivative=lambda s, a, p: {
        "x": s.u * np.cos(s.psi) - s.v * np.sin(s.psi),
        "y": s.u * np.sin(s.psi) + s.v * np.cos(s.psi),
        "psi": s.r,
        "u": a.push,
        "v": -s.v,
        "r": a.turn - s.r,
    },
    angles=("psi",),
    roles={"position": ("x", "y"), "heading": "psi", "speed": "u", "heading_rate": "r"},
    name="boat",
)
RATES = {
    "quadratic_drag:u": {"k": 0.9},
    "viscous_friction:u": {"k": 1.5},
    "coriolis:v": {"k": -0.7},
    "coupling:v<-r": {"k": 0.8},
}
AT = np.array([0.0, 0.0, 0.0, 1.0, 0.2, 0.5])


def driven(dt, seconds=1.0):
    """Steps of both inputs that are on the grid of every dt here."""
    t = np.arange(round(seconds / dt)) * dt
    return np.column_stack(
        [np.where(t < 0.4 - 1e-9, 0.8, -0.3), np.where(t < 0.6 - 1e-9, 1.0, -1.0)]
    )


def of_boat(name, dt):
    """An effect on the boat, and the data of a run without it."""
    u = driven(dt)
    data = prepare(boat, [logged(boat, stepped(boat, u, dt, AT), u, dt)])
    return Library().effect(name, boat, data.scales), data


@pytest.mark.parametrize("name", RATES)
def test_half_the_step_leaves_a_quarter_of_the_error(name):
    """Added rates are of second order in the control step: their values don't depend on it."""
    true, coarse, fine = (
        stepped(wrap(of_boat(name, dt)[0], RATES[name], dt), driven(dt), dt, AT)[-1]
        for dt in (0.0005, 0.1, 0.05)
    )
    coarse, fine = (np.abs(one - true).max() for one in (coarse, fine))
    assert fine < coarse / 3 and coarse < 2e-3
