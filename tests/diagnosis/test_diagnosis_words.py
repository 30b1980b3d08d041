"""Sentences about the ruler's rows: what is said must be what the rows hold."""

import math

from grounded.diagnosis.error_report import RulerRow
from grounded.diagnosis.verdict import worsened

UNITS = {"x": "m", "v": "m/s"}


def row(crude, after, floor=None, **more):
    return RulerRow(
        more.pop("horizon_s", 1.0),
        unit_by_channel=UNITS,
        crude=crude,
        with_effects=after,
        noise_floor=floor or {},
        **more,
    )


def test_what_got_worse_is_said_of_the_channel_that_lost_most():
    short = row({"x": 0.2, "v": 0.5}, {"x": 0.1, "v": 0.6})
    whole = row({"x": 2.12, "v": 0.5}, {"x": 3.79, "v": 0.3}, whole_trial=True, horizon_s=60.0)
    said = worsened((short, whole))
    assert "x" in said.split() and "3.8 m" in said and "2.1 m" in said
    assert "0.60 m/s" in worsened((short,))


def test_nothing_is_said_where_nothing_lost_or_only_within_the_noise():
    assert worsened(()) == ""
    assert worsened((row({"x": 0.2}, {"x": 0.21}),)) == ""
    assert worsened((row({"x": 0.02}, {"x": 0.04}, {"x": 0.05}),)) == ""
    assert worsened((row({"x": 0.02, "v": 0.1}, {"x": math.nan, "v": 0.1}),)) == ""
