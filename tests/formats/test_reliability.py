"""Torture of files and store, with few repetitions (all of them: GROUNDED_TORTURE=1)."""

from __future__ import annotations

import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from grounded.errors import GroundedError
from grounded.trial import Trial
from grounded_trials.logs.recover import recover_log
from grounded_trials.store.candidate_file import encoded_candidate, read_candidate
from grounded_trials.store.store import Store
from grounded_trials.store.trial_file import read_trial, trial_bytes
from grounded_trials.within import within
from small_tasks import a_policy

FULL = os.environ.get("GROUNDED_TORTURE") == "1"
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None  # where syncing is free


def a_trial(steps: int = 6) -> Trial:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(steps + 1, 2)), rng.normal(size=(steps, 1))
    return Trial(x, u, 0.5, ("v", "x"), ("u",), candidate="c0001")


TRIAL = trial_bytes(a_trial(), {"iteration": "1"}, b"a policy")
CANDIDATE = encoded_candidate(a_policy(2), np.zeros((3, 3)), np.zeros((2, 2)), {"alpha": "1.0"})[0]


def damaged(source: bytes, flips: bool, stride: int = 1) -> Iterator[tuple[str, bytes]]:
    """Yield every truncation or every single-bit flip (`stride` skips some)."""
    for k in range(0, (8 if flips else 1) * len(source), stride):
        bad = bytearray(source if flips else source[:k])
        if flips:
            bad[k // 8] ^= 1 << (k % 8)
        yield f"bit {k}" if flips else f"cut at {k}", bytes(bad)


@pytest.mark.slow
@pytest.mark.parametrize("flips", [False, True])
def test_a_damaged_trial_or_candidate_is_refused_with_a_message(flips: bool) -> None:
    for source, read in ((TRIAL, read_trial), (CANDIDATE, read_candidate)):
        for what, bad in damaged(source, flips, 41 if flips and not FULL else 1):
            with pytest.raises(GroundedError) as refused:
                read(bad)
            assert len(str(refused.value)) <= 500, what


@pytest.mark.slow
@pytest.mark.parametrize(("flips", "stride"), [(False, 41), (True, 149)])
def test_what_is_recovered_of_a_damaged_trial_is_right(flips: bool, stride: int) -> None:
    assert within("all of them", 10**10, wrongly_recovered, flips, 1 if FULL else stride) == []


def wrongly_recovered(flips: bool, stride: int) -> list[str]:
    """Recover each damaged trial: only right numbers, and no loss is called complete."""
    trial, failures = a_trial(12), []
    with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
        bad, good = Path(folder, "bad.mcap"), Path(folder, "good.mcap")
        for what, content in damaged(trial_bytes(trial, {}, b"a policy"), flips, stride):
            bad.write_bytes(content)
            good.unlink(missing_ok=True)
            try:
                recovery = recover_log(bad, good)
            except GroundedError:
                failures += [f"{what}: refused, and left a file"] * good.exists()
                continue
            except Exception as error:
                failures.append(f"{what}: {error!r}")
                continue
            if recovery.complete and (recovery.lost_messages or not flips):
                failures.append(f"{what}: lost messages, called complete")
            try:
                back, _, _ = read_trial(good)
            except GroundedError as error:
                if "damaged" in str(error) or "checksum" in str(error):
                    failures.append(f"{what}: what recover wrote is itself damaged: {error}")
                continue
            same = np.array_equal(back.states, trial.states[: len(back.states)])
            if not same or not np.array_equal(back.inputs, trial.inputs[: len(back.inputs)]):
                failures.append(f"{what}: wrong numbers")
    return failures


def test_verify_finds_every_flipped_bit() -> None:
    with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
        store = Store(folder)
        path = store.add(TRIAL).path
        path.chmod(0o644)
        for what, bad in damaged(TRIAL, True, 1 if FULL else 17):
            path.write_bytes(bad)
            assert [d.file for d in store.verify()] == [str(path)], what
            with pytest.raises(GroundedError):
                store.read("t0001")


CHILD = """
import random, sys
from grounded_trials.store.store import Store
store = Store(sys.argv[1])
print("ready", flush=True)
for i in range(int(sys.argv[2]), int(sys.argv[3])):
    rng = random.Random(i)
    store.add(b"%d " % i + rng.randbytes(rng.randint(10, 400_000)))
    print(i, flush=True)
"""


def adding(folder: Path, first: int, last: int) -> subprocess.Popen[str]:
    """A process that adds files."""
    command = [sys.executable, "-c", CHILD, str(folder), str(first), str(last)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def content(i: int) -> bytes:
    rng = random.Random(i)
    return b"%d " % i + rng.randbytes(rng.randint(10, 400_000))


def holds_once(store: Store, acknowledged: set[int]) -> None:
    """Every acknowledged file is there once, with its bytes, and none is damaged."""
    assert not store.verify()
    whole = [store.read(entry) for entry in store.list()]
    kept = [int(one.split(b" ", 1)[0]) for one in whole]
    assert acknowledged <= set(kept) and len(kept) == len(set(kept))
    assert all(content(i) in whole for i in acknowledged)


@pytest.mark.slow
def test_a_process_that_adds_files_may_be_killed_at_any_moment(tmp_path: Path) -> None:
    rng, store, next_file = random.Random(0), Store(tmp_path), 0
    acknowledged: set[int] = set()
    for _ in range(300 if FULL else 3):
        child = adding(tmp_path, next_file, next_file + 10_000)
        assert child.stdout is not None and child.stdout.readline() == "ready\n"
        time.sleep(rng.uniform(0, 0.03))
        child.send_signal(signal.SIGKILL)
        done = [int(line) for line in child.communicate()[0].split()]
        acknowledged |= set(done)
        next_file = max(done, default=next_file - 1) + 1  # the one that was killed comes again
        assert not store.verify()
    holds_once(store, acknowledged)
    assert len(store.list()) - len(acknowledged) in (0, 1)


def test_many_processes_store_each_file_once(tmp_path: Path) -> None:
    processes, contents = (24, 12) if FULL else (8, 4)
    running = [adding(tmp_path, i % contents, i % contents + 1) for i in range(processes)]
    for process in running:
        process.communicate()
    assert [process.returncode for process in running] == [0] * processes
    holds_once(Store(tmp_path), set(range(contents)))
    assert [s.number for s in Store(tmp_path).list()] == list(range(1, contents + 1))


START, STOP = "/grounded-marker-start", "/grounded-marker-stop"  # between them, the store's calls
ADD = f"""
import os, sys
import filelock  # before the user changes, who may read no library; its calls are not the store's
from grounded.errors import GroundedError
from grounded.findings.catalogue import codes
from grounded_trials.store.store import Store
codes()  # the words of an error
if len(sys.argv) > 3:
    os.setuid(int(sys.argv[3]))
os.path.exists({START!r})
try:
    Store(sys.argv[1]).add(b"1 " + bytes(int(sys.argv[2])))
except GroundedError as error:
    print(error)
    sys.exit(1)
os.path.exists({STOP!r})
print("added")
"""


def failed_add(folder: Path, size: int, user: str = "", **options: object) -> str:
    """What a failed add says: one clear message."""
    done = subprocess.run(
        [sys.executable, "-c", ADD, str(folder), str(size), *([user] if user else [])],
        capture_output=True,
        text=True,
        **options,  # type: ignore[call-overload]
    )
    said = done.stdout + done.stderr
    assert done.returncode == 1 and "Traceback" not in said, said
    return said


@pytest.mark.parametrize("limit", range(0, 200_000, 20_011 if FULL else 70_001))
def test_a_write_that_ends_early_leaves_nothing(tmp_path: Path, limit: int) -> None:
    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    assert "File too large" in failed_add(tmp_path, 200_000, preexec_fn=limited)
    assert [path.name for path in tmp_path.iterdir() if path.name != ".lock"] == []


@pytest.mark.parametrize("old", [False, True])
def test_a_folder_that_may_not_be_written(old: bool) -> None:
    """As root, by another user."""
    base = Path(tempfile.mkdtemp())
    folder = base / "trials"
    if old:
        Store(folder).add(b"x")
    user = "65534" if os.geteuid() == 0 else ""
    try:
        for path in (base, folder):
            if path.exists():
                path.chmod(0o555)
        assert "can't be written: Permission denied" in failed_add(folder, 100, user)
        assert not old or Store(folder).read("t0001") == b"x"
    finally:
        for path in (base, folder):
            if path.exists():
                path.chmod(0o755)
        shutil.rmtree(base)


CALL = re.compile(r"^(?:\d+ +)?(\w+)\(")
NEVER_FAIL = ("brk", "mmap", "munmap", "mremap", "mprotect", "getpid", "gettid", "geteuid")


def system_calls(folder: Path) -> list[tuple[str, int]]:
    """Return each system call of adding a file: its name, and its number among those."""
    log, store = folder / "log", folder / "store"
    Store(store).add(b"0 first")
    command = ["strace", "-o", str(log), sys.executable, "-c", ADD, str(store), "300000"]
    subprocess.run(command, check=True, capture_output=True)
    counts: dict[str, int] = {}
    found, inside = [], False
    for line in log.read_text("utf-8", "replace").splitlines():
        match = CALL.match(line)
        if not match:
            continue
        counts[match[1]] = counts.get(match[1], 0) + 1
        if STOP in line:
            break
        if inside and match[1] not in NEVER_FAIL:
            found.append((match[1], counts[match[1]]))
        inside |= START in line
    return found


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not there")
def test_an_add_may_fail_or_be_killed_at_each_of_its_system_calls(tmp_path: Path) -> None:
    calls = system_calls(tmp_path)[:: 1 if FULL else 19]
    assert calls
    for name, number in calls:
        for fault in ("error=EIO", "error=ENOSPC", "signal=KILL"):
            where, folder = f"{name} {number} {fault}", tmp_path / f"{name}{number}{fault}"
            store = Store(folder)
            store.add(b"0 first")
            command = ["strace", "-o", "/dev/null", "-e", f"trace={name}"]
            command += ["-e", f"inject={name}:{fault}:when={number}"]
            command += [sys.executable, "-c", ADD, str(folder), "300000"]
            done = subprocess.run(command, capture_output=True, text=True)
            assert "Traceback" not in done.stderr, f"{where}: {done.stderr[-400:]}"
            assert not store.verify(), where
            kept = [store.read(s) for s in store.list()]
            assert b"0 first" in kept and (done.stdout != "added\n" or len(kept) == 2), where
            again = store.add(b"1 " + bytes(300_000))
            assert store.read(again.path.name) == b"1 " + bytes(300_000), where
            assert len(store.list()) == 2, where
            assert not [*folder.glob("*.tmp"), *folder.glob(".*.tmp")], where
