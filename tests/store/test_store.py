"""The store: content is identity, order survives, nothing is half there, also after kill -9."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cli import grounded, process
from facts import holding
from grounded.errors import GroundedError
from grounded_trials.store.store import Store, made_folder, write_atomically
from shared_data import SUPPORT
from workspaces import CONFIG, make


def test_the_same_content_is_kept_once(tmp_path: Path) -> None:
    store = Store(tmp_path / "trials")
    first = store.add(b"one")
    second = store.add(b"two")
    again = store.add(b"one")
    assert (first.known, second.known, again.known) == (False, False, True)
    assert again.path == first.path and (first.id, second.id) == ("t0001", "t0002")
    assert [s.id for s in store.list()] == ["t0001", "t0002"]
    assert store.read("t0002") == store.read(second.path.name) == b"two"
    assert store.verify() == () and first.path.stat().st_mode & 0o222 == 0
    assert not [p for p in store.folder.iterdir() if p.suffix == ".tmp"]


def test_a_folder_that_cannot_be_made_is_an_error_that_names_it(tmp_path: Path) -> None:
    assert made_folder(made_folder(tmp_path / "a/b")).is_dir()
    (tmp_path / "reports").touch()
    with pytest.raises(GroundedError, match=holding(tmp_path / "reports", "File exists")):
        made_folder(tmp_path / "reports")
    with pytest.raises(GroundedError, match="Not a directory"):
        made_folder(tmp_path / "reports/a")


def test_order_survives_a_move_and_a_merge(tmp_path: Path) -> None:
    a, b = Store(tmp_path / "a"), Store(tmp_path / "b")
    for i in range(12):
        a.add(b"a%d" % i)
    b.add(b"b0")
    order = [s.digest for s in a.list()]
    shutil.copytree(a.folder, tmp_path / "moved")
    assert [s.digest for s in Store(tmp_path / "moved").list()] == order
    for entry in b.list():
        shutil.copy(entry.path, a.folder)
    assert len(a.list()) == 13 and a.list() == Store(a.folder).list()
    with pytest.raises(
        GroundedError,
        match=holding("'t0001'", *(entry.path.name for entry in a.list() if entry.id == "t0001")),
    ):
        a.read("t0001")
    assert a.add(b"more").id == "t0013"


def test_ingesting_again_replaces_a_damaged_file_and_keeps_the_damaged_one(tmp_path: Path) -> None:
    store = Store(tmp_path)
    added = store.add(b"good")
    store.add(b"other")
    added.path.chmod(0o644)
    added.path.write_bytes(b"gosd")
    healed = store.add(b"good")
    assert not healed.known and healed.path == added.path and store.read("t0001") == b"good"
    assert (tmp_path / (added.path.name + ".damaged")).read_bytes() == b"gosd"
    assert store.verify() == () and [s.number for s in store.list()] == [1, 2]


def test_a_damaged_file_stays_if_its_contents_can_t_be_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path)
    added = store.add(b"good")
    added.path.chmod(0o644)
    added.path.write_bytes(b"gosd")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(GroundedError):
        store.add(b"good")
    assert [one.path for one in store.list()] == [added.path] and len(store.verify()) == 1


def test_unknown_names(tmp_path: Path) -> None:
    store = Store(tmp_path / "empty")
    assert store.list() == () and store.verify() == ()
    with pytest.raises(GroundedError, match=holding(tmp_path / "empty", "'t0001'")):
        store.read("t0001")
    store.add(b"x")
    with pytest.raises(GroundedError, match=holding("'t0009'", "t0001")):
        store.read("t0009")


def test_leftovers_of_a_killed_process_are_removed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    (tmp_path / ".t-99999.tmp").write_bytes(b"half")
    store.add(b"x")
    assert sorted(p.name for p in tmp_path.iterdir() if p.suffix == ".tmp") == []


def test_a_folder_that_can_not_be_written(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_bytes(b"")
    with pytest.raises(GroundedError, match=holding(blocked)):
        Store(blocked / "trials").add(b"x")
    with pytest.raises(GroundedError, match=holding(tmp_path / "no")):
        write_atomically(tmp_path / "no" / "x", b"x")
    assert not (tmp_path / "no").exists()


def test_a_folder_without_file_locks_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    def refused(self: object, **_: object) -> None:
        raise NotImplementedError

    monkeypatch.setattr("filelock.FileLock.acquire", refused)
    with pytest.raises(GroundedError, match=str(tmp_path)):
        Store(tmp_path / "s").add(b"one")


def test_what_fails_afterwards_is_taken_back(tmp_path: Path) -> None:
    store = Store(tmp_path / "trials")
    with store.adding(b"one") as first:
        pass
    for content in (b"one", b"two"):  # one that is known stays
        with pytest.raises(KeyError), store.adding(content):
            raise KeyError
    assert [s.path for s in store.list()] == [first.path]
    with pytest.raises(KeyError), store.adding(b"two"):
        store.add(b"three")  # by another process: numbers have no gaps
        raise KeyError
    assert [s.id for s in store.list()] == ["t0001", "t0002", "t0003"]


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
