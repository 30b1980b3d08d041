"""What a verdict says of values and of what is left: how sure, and the worst first."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded.diagnosis.hypotheses.leftover import Leftover
from grounded.diagnosis.parts import Estimate
from grounded.diagnosis.validation.measured import Measured


@pytest.mark.parametrize(
    ("value", "std", "unit", "text"),
    [
        (1.57628, 0.00121, "N/V", "1.5763 +- 0.0012 N/V"),
        (1.62, 0.3, "1", "1.62 +- 0.30"),
        (0.0149, 0.02, "rad", "0.0149 +- 0.020 rad"),
        (-1234.5, 20.0, "N", "-1,234 +- 20 N"),
        (2.0 / 3.0, 1e-6, "m", "0.666667 +- 0.0000010 m"),
        (2.0 / 3.0, 1e-16, "m", "0.667 m"),
        (1.2, 0.0, "kg", "1.2 kg"),
        (1.2, np.inf, "kg", "1.2 kg"),
    ],
)
def test_a_value_is_as_precise_as_its_standard_deviation(value, std, unit, text):
    assert Estimate(value, std, None, unit).text == text


def test_what_is_farthest_above_its_noise_is_left_over_first():
    names = ("x", "v", "th")
    flexible = Leftover("x", 200.0, 1e-3, "m/s", np.zeros((1, 1)), np.zeros((1, 1)))
    fake = SimpleNamespace(
        data=SimpleNamespace(dt=0.5),
        ruler=SimpleNamespace(
            names=names, shown=[0, 1, 2], fine=np.full(3, 1e-4), steps=(2,), doubt=lambda fit: 0.0
        ),
        drowned=np.zeros(2, dtype=bool),
        rms=lambda fit: np.array([[0.0054, 0.019, 0.30], [0.01, 0.1, 0.5]]),
        floor=np.array([[0.0046, 0.011, 0.004], [np.nan] * 3]),
        unsure=np.zeros((2, 1)),
        best=None,
        flexible={"x": (flexible, None)},
        units={"x": "m", "v": "m/s", "th": "rad"},
        source="short horizon",
        at_most=False,
        part=lambda k, i, floor: None,
        with_region=lambda row, left: replace(row, evidence=left.gain if left else np.nan),
    )
    found = Measured.remainders(fake)
    assert [one.channel for one in found] == ["th", "v", "x"]
    assert found[-1].evidence == 200.0 and not found[-1].above
    fake.floor[0, 0] = 1e-9  # below what matters of a state its noise is no measure
    assert [one.channel for one in Measured.remainders(fake)] == ["th", "x", "v"]
    fake.floor[0, 0], fake.ruler.fine[0] = 0.0046, 0.0028  # too little, whatever would lower it
    assert [one.channel for one in Measured.remainders(fake)] == ["th", "v"]


def test_a_gap_in_one_second_of_one_log_is_told_with_its_time():
    total, count = np.full((1, 9, 1), 1e-6), np.full((1, 9, 1), 10.0)
    total[0, 6] = 1e-3  # the third second of the second run, which begins at 4 s of t2
    fake = SimpleNamespace(
        ruler=SimpleNamespace(
            errors=lambda fit: SimpleNamespace(total=total, count=count),
            run_of=np.repeat([0, 1], [4, 5]),
            piece0=np.array([0, 4, 9]),
            step0=np.array([0, 40]),
            steps=(1, 10),
        ),
        data=SimpleNamespace(
            dt=0.1, trial_of=np.array([0, 1]), step_at=np.array([[0], [80]]), lengths=[40, 85]
        ),
        trials=[SimpleNamespace(id="t1"), SimpleNamespace(id="t2")],
        best=None,
    )
    found = Measured.part(fake, 0, 0, 3e-4)
    assert (found.trial, found.start, found.end) == ("t2", 6.0, 7.0) and found.share > 0.98
    assert Measured.part(fake, 0, 0, 0.1) is None  # all of it may be noise
    count[0, 6] = 30.0  # of 110: not a short part
    assert Measured.part(fake, 0, 0, 3e-4) is None
