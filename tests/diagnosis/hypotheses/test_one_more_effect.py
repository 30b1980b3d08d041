"""When a diagnosis looks for one effect more: as long as what it found leaves more than noise.

Of a quadrotor's six effects three were named, with "a gap remains that no known effect explains":
the fourth took the place of one of the three, so there were never four to be had.
"""

from types import SimpleNamespace

import pytest

from grounded.diagnosis import writer
from grounded.diagnosis.writer import Writer

GONE_ON = {"above": True, "source": "repeats", "promise": 0.0}


@pytest.mark.parametrize(
    ("claimed", "likely", "most", "left", "expected"),
    [
        (3, 3, 3, GONE_ON, True),
        (3, 4, 4, GONE_ON, True),  # four are likely, one of which predictions do not need
        (3, 3, 4, GONE_ON, False),  # a fourth is not likely
        (0, 4, 4, GONE_ON, False),  # nothing pays
        (4, 4, 4, {"above": False, "source": "short horizon", "promise": 80.0}, True),
        (4, 4, 4, {"above": False, "source": "short horizon", "promise": 5.0}, False),
        (4, 4, 4, {"above": False, "source": "repeats", "promise": 80.0}, True),  # small, lasting
        (4, 4, 4, {"above": False, "source": "repeats", "promise": 5.0}, False),
        (4, 4, 4, {"above": None, "source": "repeats", "promise": 80.0}, False),  # nothing is left
        (3, 4, 4, {"above": False, "source": "short horizon", "promise": 80.0}, False),
    ],
)
def test_one_more_is_sought_while_the_likely_ones_leave_more_than_noise(
    monkeypatch, claimed, likely, most, left, expected
):
    made = object.__new__(Writer)
    names = tuple(f"effect{k}" for k in range(12))
    chosen = SimpleNamespace(hypothesis=SimpleNamespace(names=names[:likely]))
    made.search = SimpleNamespace(chosen=lambda most: chosen)
    made.known, made.most, made.best = SimpleNamespace(no_cause=False), most, None
    made.claims = SimpleNamespace(names=names[:claimed])
    rows = () if left["above"] is None else (SimpleNamespace(above=left["above"]),)
    made.measured = SimpleNamespace(remainders=lambda: rows, source=left["source"])
    monkeypatch.setattr(writer, "promised", lambda search, best: left["promise"])
    assert made.unfinished is expected
