"""Several effects together: diagnosis and adopted model agree which of them acts first."""

import numpy as np
import pytest

from grounded import Trial
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Library, memory_start, scales_of
from grounded.effects.memory import shifted
from grounded.models.car import model as car
from grounded_trials.workspace.adopted import in_order, planner_of
from small_tasks import plain_task

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


def predicted(parts, model=car, leads=False):
    """The diagnosis' own prediction from the start, (STEPS + 1, n). leads."""
    names = (car.state_names, car.input_names)
    empty = np.full((STEPS + 1, car.n), 0.1)
    predictor = Predictor(prepare(model, [Trial(empty, commands(), DT, *names, start_inputs=HELD)]))
    h = hypothesis(parts, model)
    received = predictor.received(h, leads=leads)[0]
    x = [np.full(car.n, 0.1)]
    for t in range(STEPS):
        x.append(predictor.advance(h, x[-1], received[t], np.array(t * DT)))
    return np.array(x)


def adopted(parts):
    """What the adopted model plans with: a delay is latency, the rest is in the model."""
    plan = planner_of(task(), [{"name": name, **values} for name, values in parts]).plan
    still = Trial(
        np.full((2, car.n), 0.1),
        commands()[:1],
        DT,
        car.state_names,
        car.input_names,
        start_inputs=HELD,
    )
    z = [np.hstack([np.full(car.n, 0.1), memory_start(plan.model, car, still)])]
    received = [
        shifted(commands()[None, :, j], HELD[j : j + 1], plan.latency[j] / DT)[0] for j in range(2)
    ]
    for u in np.stack(received, axis=1):
        z.append(plan.model.system.step(z[-1][None], u[None], plan.model.values, DT)[0])
    return np.array(z)[:, : car.n]


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
    old = [{"name": PULL[0], **PULL[1]}, {"name": "viscous_friction:v", "k": 0.1}]
    model = planner_of(task(), old).plan.model
    want = predicted((("rate_gain:delta", {"g": 0.3}),), model)
    found = in_order(old, [{"name": "rate_gain:delta", "g": 0.3}])
    parts = [(e["name"], {k: v for k, v in e.items() if k != "name"}) for e in found]
    by_name = dict(parts)
    beside = adopted([(PULL[0], PULL[1]), *parts[1:]])
    off, before = (np.abs(one - want).max() for one in (adopted(parts), beside))
    assert off < 5e-3 < before / 4  # half a step's kick of the one or the other
    assert by_name[PULL[0]] == {"c": pytest.approx(0.13)}
    assert by_name["viscous_friction:v"] == {"k": 0.1}  # of another rate


def test_the_memory_of_a_trial_follows_what_arrives():
    planner = planner_of(task(), [{"name": name, **values} for name, values in (LIMIT, PART)])
    trial = Trial(
        predicted((LIMIT, PART)),
        commands(),
        DT,
        car.state_names,
        car.input_names,
        start_inputs=HELD,
    )
    states, plan = planner.lift(trial).states, planner.plan
    received = np.stack(
        [shifted(commands()[None, :, j], HELD[[j]], plan.latency[j] / DT)[0] for j in range(2)],
        axis=1,
    )
    after = plan.model.system.step(states[:-1], received, plan.model.values, DT)
    np.testing.assert_allclose(after[:, car.n :], states[1:, car.n :], atol=1e-9)
    np.testing.assert_allclose(after, states[1:], atol=0.01)  # the model takes the limit's mean
