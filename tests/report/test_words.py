"""Numbers and units as people read them."""

import pytest

from grounded_trials.wording import (
    percent,
)


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
