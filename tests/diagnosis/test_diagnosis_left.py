"""What a verdict says of values and of what is left: how sure, and the worst first."""

from types import SimpleNamespace

import numpy as np

from grounded.diagnosis.validation.measured import Measured


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
