"""kill -9 at any moment, and lost caches."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cli import grounded, process
from shared_data import SUPPORT
from workspaces import CONFIG, make

KILLS = int(os.environ.get("GROUNDED_KILLS", "6"))
NOISY = CONFIG + "noise = { process = { v = 0.01 }, measurement = { x = 0.001 } }\nseed = 7\n"


def killed(folder, *command, longest, seed=0, kills=KILLS):
    script = SUPPORT / "killing.py"
    words = [script, seed, kills, longest, folder, *command]
    done = subprocess.run(
        [sys.executable, *map(str, words)], capture_output=True, text=True, check=True
    )
    count, code = map(int, done.stdout.split())
    assert code == 0, done.stderr[-2000:]
    return count


def kept(folder):
    """Every byte that counts: trials by name (their hash), candidates by content."""
    candidates = {p.name: p.read_bytes() for p in (folder / "candidates").glob("[!.]*")}
    return {p.name for p in (folder / "trials").glob("*.mcap")}, candidates


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = make(tmp_path_factory.mktemp("whole") / "w", config=NOISY).folder
    assert grounded("-C", folder, "learn", "--json").code == 0
    return folder


@pytest.mark.slow
def test_learn_killed_again_and_again_ends_where_it_would_have(tmp_path, undisturbed):
    folder = make(tmp_path / "w", config=NOISY).folder
    count = killed(folder, "learn", longest=0.08, seed=1)
    assert count > KILLS / 3  # or the kills came too late to prove anything
    assert kept(folder) == kept(undisturbed)
    a, b = (grounded("-C", f, "status", "--json").json for f in (folder, undisturbed))
    assert a == b and a["phase"] in ("converged", "stopped")
    assert grounded("-C", folder, "verify", "--json").json["damaged"] == []
    assert not list(folder.glob("trials/.*.tmp"))  # swept by the next that takes the lock


@pytest.mark.slow
def test_propose_killed_writes_a_whole_candidate_or_none(tmp_path, undisturbed):
    folder = make(tmp_path / "w", config=NOISY).folder
    seen = kept(undisturbed)[1]
    for name in ("c0001", "c0002"):
        killed(folder, "propose", longest=0.06, kills=max(KILLS // 2, 1))
        assert kept(folder)[1][f"{name}.mcap"] == seen[f"{name}.mcap"]
        assert grounded("-C", folder, "learn", "--trials", "1").code == 0


@pytest.mark.slow
def test_ingest_killed_stores_a_whole_trial_or_none(tmp_path):
    folder = make(tmp_path / "w", config=NOISY).folder
    grounded("-C", folder, "propose")
    trial = Path(grounded("-C", folder, "run", "--json").json["trial_file"])
    killed(folder, "ingest", str(trial), longest=0.05)
    (stored,) = (folder / "trials").glob("*.mcap")
    assert stored.read_bytes() == trial.read_bytes()
    assert not list((folder / "trials").glob(".*.tmp"))
    again = grounded("-C", folder, "ingest", trial, "--json").json["trials"][0]
    assert again["known"] and again["trial"] == "t0001"


@pytest.mark.slow
def test_caches_reports_and_the_place_do_not_matter(tmp_path, undisturbed):
    """Reports deleted, compile cache gone or unwritable, folder moved: the same next candidate."""
    part = make(tmp_path / "w", config=NOISY).folder
    grounded("-C", part, "learn", "--trials", "2")
    (part / "reports").mkdir(exist_ok=True)
    (part / "reports" / "report.html").write_text("derived")
    expected = None
    for k, cache in enumerate((tmp_path / "cold", tmp_path / "cold", "", "/proc/nowhere")):
        moved = tmp_path / f"elsewhere {k}" / "w"
        shutil.copytree(part, moved)
        shutil.rmtree(moved / "reports")
        done = process("propose", "--json", cwd=moved, GROUNDED_CACHE=str(cache))
        assert done.code == 0, done.err
        found = (moved / "candidates" / "c0003.mcap").read_bytes()
        expected = expected or found
        assert found == expected and str(tmp_path).encode() not in found
        status = grounded("-C", moved, "status", "--json").json
        assert status["trials"] == 2 and status["outstanding"] == "c0003"
    assert expected == (undisturbed / "candidates" / "c0003.mcap").read_bytes()


@pytest.mark.slow
def test_two_processes_at_once_store_each_trial_once(tmp_path):
    folder = make(tmp_path / "w", config=NOISY).folder
    grounded("-C", folder, "propose")
    trial = grounded("-C", folder, "run", "--json").json["trial_file"]
    from cli import COMMAND

    words = [*COMMAND, "-C", str(folder), "ingest", trial, "--json"]
    both = [subprocess.Popen(words, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    out = [p.communicate()[0] for p in both]
    assert all(p.returncode == 0 for p in both)
    assert sum('"known": false' in o for o in out) == 1
    assert len(list((folder / "trials").glob("*.mcap"))) == 1
