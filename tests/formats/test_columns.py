"""A table in which a name stands twice is refused."""

import numpy as np
import pytest

from grounded.errors import GroundedError
from grounded_trials.formats.tables import npz_tables
from grounded_trials.formats.text_tables import csv_tables


@pytest.mark.parametrize(
    "head", ["t,theta,omega,torque,theta", "t,theta [rad],omega,torque,theta [deg]"]
)
def test_a_column_that_stands_twice_in_a_text_table_is_refused(tmp_path, head):
    path = tmp_path / "log.csv"
    rows = "\n".join(f"{0.1 * k:.1f},{k},1,2,{-k}" for k in range(20))
    path.write_text(f"{head}\n{rows}\n")
    with pytest.raises(GroundedError, match="theta"):
        list(csv_tables(path))
    path.write_text(f"t,theta,omega,torque,other\n{rows}\n")
    assert list(csv_tables(path))


def test_a_column_that_stands_twice_in_an_archive_is_refused(tmp_path):
    path, t = tmp_path / "log.npz", np.arange(5.0)
    np.savez(path, state=np.zeros((5, 2)), state_t=t, state_names=np.array(["x", "x"]))
    with pytest.raises(GroundedError, match="'x'"):
        list(npz_tables(path))
    np.savez(path, **{"t": t, "a b": t, "a_b": t})
    with pytest.raises(GroundedError, match="a_b"):
        list(npz_tables(path))
