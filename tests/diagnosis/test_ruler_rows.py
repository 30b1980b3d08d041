"""What the rows of the ruler say: what got worse, what is contested, what is lost."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from grounded.diagnosis.next_trial import LOG, LOST
from grounded.diagnosis.ruler_words import (
    in_doubt,
    objection,
    open_noise,
    outweighed,
    rest,
    telling,
    worsened,
)
from grounded.diagnosis.verdict import verdict

from grounded import Trial
from grounded.diagnosis.error_report import AT_MOST, Remainder, RulerRow, furthest, runaway
from grounded.diagnosis.parts import Agreement, Verdict
from grounded.diagnosis.report import Diagnosis
from grounded.diagnosis.tables import error_table
from grounded.diagnosis.unconfirmed import unrepeatable
from small_tasks import cart_task


def row(crude, after, floor=None, **more):
    return RulerRow(
        more.pop("horizon_s", 1.0),
        unit_by_channel={"x": "m", "v": "m/s"},
        crude=crude,
        with_effects=after,
        noise_floor=floor or {},
        **more,
    )


def whole(crude, after, **more):
    return row(crude, after, whole_trial=True, horizon_s=60.0, **more)


SHORT = row({"x": 0.2, "v": 0.5}, {"x": 0.1, "v": 0.6})
LONG = whole({"x": 2.12, "v": 0.5}, {"x": 3.79, "v": 0.3})


@pytest.mark.parametrize(
    ("rows", "worse", "outweighs"),
    [
        ((), False, False),
        ((SHORT,), True, False),  # v loses, x gains more
        ((SHORT, LONG), True, True),
        ((row({"x": 0.2}, {"x": 0.205}),), False, False),
        ((row({"x": 0.2, "v": 0.5}, {"x": 0.21, "v": 0.5}),), True, True),
        ((row({"x": 0.2, "v": 0.5}, {"x": 0.21, "v": 0.4}),), False, False),
        ((row({"x": 0.02}, {"x": 0.04}, {"x": 0.05}),), False, None),  # within the noise
        ((row({"x": 0.02, "v": 0.1}, {"x": np.nan, "v": 0.1}),), False, None),
    ],
)
def test_what_is_called_worse_and_whether_it_outweighs(rows, worse, outweighs):
    assert bool(worsened(rows)) is worse
    assert outweighs is None or outweighed(rows) is outweighs


def test_what_noise_alone_drowns_or_what_diverges_is_not_told():
    far = row({"x": 2.0, "v": 5.0}, {"x": 1.9, "v": 9.0}, drowned=True)
    near = replace(SHORT, with_effects={"x": 0.1, "v": 0.5}, horizon_s=0.5)
    assert furthest((near, far)) is near and furthest((far,)) is far and furthest(()) is None
    assert worsened((near, far)) == "" and telling((near, far, LONG)) is near
    away = dict.fromkeys(("crude", "with_effects", "noise_floor"), ("x",))
    wild = whole({"x": 7e5, "v": 0.5}, {"x": 4e5, "v": 0.4}, runs_away=away)
    assert not wild.tells("x", "crude") and wild.tells("v", "crude")
    assert rest((near, wild)) == "" and telling((near, wild)) is near
    assert runaway((near, wild)) and not runaway((near,))


def test_a_slow_plant_is_told_by_whole_trials():
    slow, quick = row({"x": 0.02}, {"x": 0.017}), row({"x": 0.2}, {"x": 0.08})
    hour = whole({"x": 5.0}, {"x": 0.3})
    assert telling((slow, hour)) is hour and telling((quick, hour)) is quick
    assert telling((hour,)) is None and telling(()) is None


@pytest.mark.parametrize(
    ("after", "causes", "columns"),
    [(0.02518557, (), 1), (0.024, (), 2), (0.02518557, ("b",), 2)],
)
def test_the_same_figures_are_not_shown_twice(after, causes, columns):
    rows = (row({"x": 0.02518153, "v": 0.5}, {"x": after, "v": 0.5}),)
    found = Diagnosis(Verdict("none", causes=causes), prediction_error=rows)
    assert len({"crude", "now", "as diagnosed"} & {*error_table(found)[1]}) == columns


ALIKE, UNLIKE = (Agreement("delay:u", "d", agrees=agrees) for agrees in (True, False))
LITTLE, MUCH = (row({"x": 2.0, "v": 1.0}, {"x": x, "v": 1.0}) for x in (1.7, 0.5))
PAIR = ("sensor_delay:psi", "coupling:p<-phi")
LEFT, WIDE = ([Remainder("x", error=e, floor=1.0)] for e in (1.5, 3.0))


@pytest.mark.parametrize(
    ("given", "contested"),
    [
        (((SHORT, LONG), (ALIKE,), ("delay:u",)), True),
        (((SHORT, LONG), (ALIKE,), ()), False),
        (((SHORT,), (ALIKE,), ("delay:u",)), False),
        (((SHORT,), (UNLIKE,), ("delay:u",)), True),
        (((LITTLE,), (), PAIR[:1], [PAIR], LEFT), True),  # a tie that gains little beside a gap
        (((LITTLE,), (), PAIR[:1], [PAIR]), False),
        (((MUCH,), (), PAIR[:1], [PAIR], LEFT), False),
        (((LITTLE,), (), PAIR[:1], [], LEFT), False),
        (((LITTLE,), (), ("periodic:p",), [], WIDE), True),
        (((MUCH,), (), ("periodic:p",), [], WIDE), False),
        (((LITTLE,), (), (PAIR[0], "delay:u"), [PAIR], LEFT), False),
    ],
)
def test_a_claim_is_contested(given, contested):
    assert bool(objection(*given)) is contested


def judged(rows, **more):
    claims = SimpleNamespace(
        known=SimpleNamespace(no_cause=False), names=(), blamed=(), one_clock=()
    )
    return verdict(claims, (), (), (), rows, (), **more)


def test_a_noise_of_which_only_a_bound_is_known_leaves_the_verdict_open():
    bound = row({"x": 1.0}, {"x": 0.9}, {"x": 0.89}, floor_at_most=True)
    known = replace(bound, floor_at_most=False)
    assert judged((bound,)).kind == "unknown" and open_noise((bound,)) == "x"
    assert judged((known,)).kind == "none" and not open_noise((known,))
    adopted = ("viscous_friction:v",)
    repeats = row({"x": 1.0}, {"x": 0.9}, {"x": 0.7}, floor_from=AT_MOST, floor_unsure=0.3)
    for rows in ((bound,), (repeats,)):
        assert judged(rows, adopted=adopted).kind == "none"
    few = row({"x": 0.31}, {"x": 1.6e-3}, {"x": 9.1e-4}, floor_unsure=0.41)
    assert in_doubt((few,)) and not rest((few,))
    assert rest((replace(few, floor_unsure=0.0),))


def test_what_ended_early_left_safety_or_ran_far_is_lost():
    task = cart_task()
    H, names = task.horizon, (task.model.state_names, task.model.input_names)
    good = np.nan_to_num(np.array(task.target))

    def ran(name, states):
        inputs = np.zeros((len(states) - 1, task.model.m))
        return Trial(states, inputs, task.dt, *names, id=name, candidate="c0001")

    trials = [ran("good", good), ran("off", good + 0.1), ran("early", good[: H // 2])]
    trials.append(ran("far", good + 50.0 * np.linspace(0, 1, H + 1)[:, None]))
    assert unrepeatable(task, trials) == {"early": LOST, "far": LOST}
    fenced = replace(task, safety_high=np.array([float(good[:, 0].max()) + 0.05, np.inf]))
    assert list(unrepeatable(fenced, trials)) == ["off", "early", "far"]
    assert unrepeatable(task, [replace(trials[2], candidate="")]) == {"early": LOG}
