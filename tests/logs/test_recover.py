"""grounded recover: what is counted is messages, what is lost is said in time and steps."""

import re
from pathlib import Path

import pytest

from cli import grounded, plain
from facts import holds
from reported import copied
from shared_data import DATA, needs_data


@pytest.fixture
def trial(cart, tmp_path):
    """A trial of 40 steps as the store has it, in a folder of its own."""
    (path,) = copied(cart, tmp_path / "w").glob("trials/t0001-*")
    target = tmp_path / "run.mcap"
    target.write_bytes(path.read_bytes())
    return target


def words(done):
    return " ".join((done.out + done.err).split())


def test_a_trial_that_was_cut_off_is_counted_in_messages(trial, tmp_path):
    data = trial.read_bytes()
    trial.write_bytes(data[: int(0.9 * len(data))])
    done = grounded("recover", trial, "-o", tmp_path / "s.mcap")
    found = grounded("recover", trial, "-o", tmp_path / "t.mcap", "--json")
    assert done.code == found.code == 3
    assert 20 < found.json["messages"]["/state"] < 41
    assert re.search(r"\bbyte \d+", done.err)
    assert re.search("^next: grounded ingest --data", done.out, re.M)
    assert max(map(len, (done.out + done.err).splitlines())) <= 80 + len(str(tmp_path))


def test_a_trial_whose_index_is_missing_lost_nothing(trial, tmp_path):
    trial.write_bytes(trial.read_bytes()[:-20])
    done = grounded("recover", trial, "-o", tmp_path / "s.mcap")
    assert done.code == 3 and "index" in words(done)
    assert "/state: 41" in done.out and re.search("^next: grounded ingest [^-]", done.out, re.M)


def test_a_trial_with_a_hole_is_refused_where_it_is_ingested(cart, trial, tmp_path):
    data = bytearray(trial.read_bytes())
    found = None
    for at in range(len(data) // 2, len(data), 200):  # until a block in the middle is hit
        bad = bytearray(data)
        bad[at] ^= 0xFF
        trial.write_bytes(bytes(bad))
        done = grounded("recover", trial, "-o", tmp_path / f"{at}.mcap")
        if done.code == 3 and re.search(r"second \d+\.\d+ to \d+\.\d+", words(done)):
            found = done
            break
    assert found is not None and " lost" in found.out
    refused = grounded("-C", cart, "ingest", "--data", tmp_path / f"{at}.mcap")
    assert refused.code == 1 and f"{at}.mcap" in refused.err and "[log]" not in refused.err


@needs_data
def test_a_foreign_log_says_which_seconds_are_gone(tmp_path):
    assert DATA is not None
    (path,) = Path(DATA).glob("mcap_format_fixtures/derived_corrupt/dart_fast_bitrot_chunk3.mcap")
    done = grounded("recover", path, "-o", tmp_path / "s.mcap")
    assert done.code == 3 and "12.11 to 18.22" in done.err
    assert "/vicon/jetracer1: 2617, 610 lost" in done.out
    assert "next: grounded inspect" in done.out


def test_what_is_no_log_is_said_to_be_none(tmp_path):
    (tmp_path / "notes.mcap").write_text("it drove well")
    done = grounded("recover", tmp_path / "notes.mcap")
    assert done.code == 1 and holds(done.err, "notes.mcap")
    folder = grounded("recover", tmp_path)
    assert folder.code == 1 and holds(folder.err, "folder")
    nowhere = grounded("recover", tmp_path / "nowhere.mcap")
    assert nowhere.code == 1 and "nowhere.mcap" in nowhere.err


def test_a_sound_file_is_called_so(trial, tmp_path):
    done = grounded("recover", trial, "-o", tmp_path / "s.mcap")
    assert done.code == 0 and "s.mcap" in done.out and not done.err


def test_a_candidate_is_written_again_rather_than_repaired(cart, tmp_path):
    path = copied(cart, tmp_path / "w") / "candidates" / "c0001.mcap"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-500])
    done = grounded("recover", path)
    assert done.code == 3 and re.search("^next: grounded propose", plain(done.out), re.M)
