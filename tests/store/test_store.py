"""The store: content is identity, order survives, nothing is half there."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest

from facts import holding
from grounded.errors import GroundedError
from grounded_trials.store.store import Store, made_folder, write_atomically


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


def test_damage_is_found_at_every_byte(tmp_path: Path) -> None:
    store = Store(tmp_path)
    added = store.add(bytes(range(64)))
    added.path.chmod(0o644)
    good = added.path.read_bytes()
    for i in range(len(good)):
        bad = bytearray(good)
        bad[i] ^= 1 << (i % 8)
        added.path.write_bytes(bytes(bad))
        assert [d.file for d in store.verify()] == [str(added.path)]
        with pytest.raises(GroundedError, match=holding(added.path)):
            store.read("t0001")
    added.path.write_bytes(good[:-1])
    assert len(store.verify()) == 1


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
