"""`propose` says by which model a step was made."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded.search.candidate import BY_STEP, Candidate
from grounded_cli.propose import _what
from small_tasks import cart_task


@pytest.mark.parametrize(
    ("slopes", "corrected", "original"),
    [
        ("", False, False),
        ("corrected", True, False),
        ("original", False, True),
        ("original, corrected", True, True),
    ],
)
def test_the_line_names_the_model_of_a_step(slopes, corrected, original):
    task = cart_task()
    policy = task.policy(np.zeros((task.horizon, 1)), None, None)
    run = np.zeros((task.horizon + 1, 2)), np.zeros((task.horizon, 1))
    made = Candidate("c0002", policy, 1, 1.0, "c0001", "m", *run, -1.0, slopes=slopes)
    line = _what(made, SimpleNamespace(history=()), task)
    assert ("corrected by the trials" in line) is corrected
    assert ("without the adopted effects" in line) is original
    assert "step by step" not in line
    by_step = _what(replace(made, way=BY_STEP), SimpleNamespace(history=()), task)
    assert "with derivatives corrected step by step" in by_step
    assert "by the trials" not in by_step
