"""Numbers and units as people read them."""

import pytest

from grounded.result import measured_alike
from grounded_trials.wording import (
    labelled,
    percent,
    shown,
    with_unit,
)


def test_the_unit_one_is_not_printed():
    assert shown("1") == "" and shown("m/s") == "m/s"
    assert with_unit("0.146", "1") == "0.146" and with_unit("0.3", "m") == "0.3 m"
    assert labelled("throttle", "1") == "throttle" and labelled("v", "m/s") == "v [m/s]"


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.5, "50 %"),
        (0.997, "99.7 %"),
        (0.002, "0.2 %"),
        (1.0, "100 %"),
        (1.5, "150 %"),
        (0.0, "0.0 %"),
        (1e-5, "< 0.1 %"),
        (0.99999, "> 99.9 %"),
        (float("nan"), "-"),
    ],
)
def test_a_share_keeps_its_tenths_where_they_matter(share, text):
    assert percent(share) == text


@pytest.mark.parametrize(
    ("values", "unit", "texts"),
    [
        ((1.6e-4, 1.6e-3), "m", ["0.16 mm", "1.6 mm"]),  # it was 0.16 mm -> 0.16 cm
        ((1.6e-3, 9.1e-4), "m", ["1.6 mm", "0.91 mm"]),
        ((8.2e-4, 0.045), "m", ["0.82 mm", "45 mm"]),
        ((1.75, 0.012), "m", ["1,750 mm", "12 mm"]),
        ((0.31, 1.6e-3), "m", ["310 mm", "1.6 mm"]),
        ((1.2e-3, 7.3e-4), "rad", ["1.2 mrad", "0.73 mrad"]),
        ((0.12, 5.8e-4), "rad", ["0.12 rad", "0.00058 rad"]),
        ((0.2, 0.0), "m", ["200 mm", "0 mm"]),
        ((0.17,), "m", ["170 mm"]),
    ],
)
def test_errors_that_are_compared_have_one_unit(values, unit, texts):
    assert measured_alike(values, unit) == texts
