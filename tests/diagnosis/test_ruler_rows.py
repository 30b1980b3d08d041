"""What the rows of the ruler say: what got worse, what is contested, what is lost."""

from dataclasses import replace

import pytest

from grounded.diagnosis.error_report import (
    Remainder,
    RulerRow,
    excess,
    furthest,
    lost_most,
    telling,
)
from grounded.diagnosis.parts import Agreement, Diagnosis, Verdict


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


def test_what_noise_alone_drowns_or_what_diverges_is_not_told():
    far = row({"x": 2.0, "v": 5.0}, {"x": 1.9, "v": 9.0}, drowned=True)
    near = replace(SHORT, with_effects={"x": 0.1, "v": 0.5}, horizon_s=0.5)
    assert furthest((near, far)) is near and furthest((far,)) is far and furthest(()) is None
    assert lost_most((near, far)) is None and telling((near, far, LONG)) is near
    away = dict.fromkeys(("crude", "with_effects", "noise_floor"), ("x",))
    wild = whole({"x": 7e5, "v": 0.5}, {"x": 4e5, "v": 0.4}, runs_away=away)
    assert not wild.tells("x", "crude") and wild.tells("v", "crude")
    assert excess((near, wild)) is None and telling((near, wild)) is near


def test_a_slow_plant_is_told_by_whole_trials():
    slow, quick = row({"x": 0.02}, {"x": 0.017}), row({"x": 0.2}, {"x": 0.08})
    hour = whole({"x": 5.0}, {"x": 0.3})
    assert telling((slow, hour)) is hour and telling((quick, hour)) is quick
    assert telling((hour,)) is None and telling(()) is None


ALIKE, UNLIKE = (Agreement("delay:u", "d", agrees=agrees) for agrees in (True, False))
LITTLE, MUCH = (row({"x": 2.0, "v": 1.0}, {"x": x, "v": 1.0}) for x in (1.7, 0.5))
PAIR = ("sensor_delay:psi", "coupling:p<-phi")
LEFT, WIDE = ((Remainder("x", error=e, floor=1.0),) for e in (1.5, 3.5))


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
    names = ("prediction_error", "agreement", "effects", "indistinguishable", "leftover")
    parts = dict(zip(names, given, strict=False))
    verdict = Verdict("effect", parts.pop("effects"))
    assert bool(Diagnosis(verdict, **parts).doubt) is contested
