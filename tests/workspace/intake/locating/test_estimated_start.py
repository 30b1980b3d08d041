"""Where a run begins in a log without speeds, and how fast the robot was there.

With [estimate] no start was sought: "somebody drove" was said of every log with a lead-in.
"""

from dataclasses import replace

import numpy as np
import pytest

from facts import of_code
from grounded.errors import GroundedError
from recorded import LOGGED, record, rows_of, stored_from, waiting

ONLY_POSITIONS = LOGGED.replace('[log.state.v]\npath = "/csv.v"\n', "") + (
    "[estimate]\nmeasured = { x = 0.002 }\n"
)


@pytest.fixture
def blind(tmp_path):
    """Nothing measures its speed; it waits for c0002, and its controller had its own estimate."""
    return waiting(tmp_path, ONLY_POSITIONS)


@pytest.mark.parametrize("differs", [0, 16], ids=["known", "a program's speeds lag"])
def test_a_run_is_found_where_speeds_are_estimated(blind, tmp_path, differs):
    policy = blind.candidate("c0002")[0].policy
    path = record(blind, tmp_path / "a.csv", policy, 0.8, differs=differs)
    found = blind.ingest(path)
    assert found.candidate == "c0002"
    stored_from(blind, path, 0.8)
    assert {one.name for one in found.signals} == {"x", "force"}  # what was logged


def test_an_estimated_speed_knows_what_came_before_the_run_and_after_it(blind, tmp_path):
    policy, off = blind.candidate("c0002")[0].policy, []
    for seed in range(3):
        path = record(blind, tmp_path / f"{seed}.csv", policy, 0.8, seed=seed)
        blind.ingest(path, candidate="c0002")
        table = rows_of(path)
        truth = table[80 + 5 * np.arange(policy.horizon + 1), 2]  # measured, to 0.01 m/s
        found = blind.trials()[-1].trial.states[:, 1]
        assert found[0] == 0.0  # it stood still until its first command
        off.append(found - truth)
    assert np.abs(np.mean(off, axis=0)[[0, -1]]).max() < 0.03
    assert np.sqrt(np.mean(np.square(off))) < 0.03


ITS_OWN = LOGGED + "[estimate]\nmeasured = { x = 0.002 }\n"
ROUGH = (0.002, 0.5)  # m, m/s: a speed by differences


def test_a_run_is_known_by_the_speeds_that_its_program_made_itself(tmp_path, before=0.8):
    w = waiting(tmp_path, ITS_OWN)
    policy = w.candidate("c0002")[0].policy
    path = record(w, tmp_path / "a.csv", policy, before, noise=ROUGH)
    found = w.ingest(path)
    assert found.candidate == "c0002"
    stored, table, k = stored_from(w, path, before)
    assert np.std(stored.states[:-1, 1] - table[k, 2]) > 0.3  # estimated all the same
    assert [one.about for one in of_code(found, "log.unread")] == [("v",)]


def test_a_motor_wired_wrongly_is_told_where_no_start_is_found(blind, tmp_path, after=1.0):
    policy = blind.candidate("c0002")[0].policy
    wild = replace(policy, gain=40 * policy.gain)  # the commands don't tell where the run begins
    path = record(blind, tmp_path / "a.csv", wild, 0.5, turned=True, after=after)
    with pytest.raises(GroundedError, match="force acted the other way round") as error:
        blind.ingest(path)
    assert (error.value.then.verb, error.value.then.arguments) == ("export", ("c0002", "--runner"))
    forced = blind.ingest(path, candidate="c0002")
    assert of_code(forced, "run.reversed")
    assert (forced.then.verb, forced.then.arguments) == ("discard", (forced.trial,))
