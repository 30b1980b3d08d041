"""Torture tests of files and store, which count tries and losses."""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from grounded.errors import GroundedError
from grounded.trial import Trial
from grounded_trials.logs.recover import recover_log
from grounded_trials.store.candidate_file import encoded_candidate, read_candidate
from grounded_trials.store.store import Store
from grounded_trials.store.trial_file import read_trial, trial_bytes
from grounded_trials.within import within
from small_tasks import a_policy

MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None  # where syncing is free


@dataclass(frozen=True)
class Outcome:
    tries: int
    failures: tuple[str, ...] = ()
    note: str = ""


def a_trial(steps: int = 6, dt: float = 0.5) -> Trial:
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(steps + 1, 2)), rng.normal(size=(steps, 1))
    return Trial(x, u, dt, ("v", "x"), ("u",), candidate="c0001")


def a_candidate() -> bytes:
    policy = a_policy(2)
    return encoded_candidate(policy, np.zeros((3, 3)), np.zeros((2, 2)), {"alpha": "1.0"})[0]


def damaged(source: bytes, flips: bool, stride: int = 1) -> list[tuple[str, bytes]]:
    """Yield every truncation or every single-bit flip (`stride` skips some)."""
    if not flips:
        return [(f"cut at {i}", source[:i]) for i in range(0, len(source), stride)]
    cases = []
    for k in range(0, 8 * len(source), stride):
        bad = bytearray(source)
        bad[k // 8] ^= 1 << (k % 8)
        cases.append((f"bit {k % 8} of byte {k // 8}", bytes(bad)))
    return cases


def read_damaged(flips: bool, stride: int = 1) -> Outcome:
    """Check that a damaged trial or candidate is always refused with a message."""
    trial = trial_bytes(a_trial(), {"iteration": "1"}, b"a policy")
    tries, failures = 0, []
    for source, read in ((trial, read_trial), (a_candidate(), read_candidate)):
        for what, bad in damaged(source, flips, stride):
            tries += 1
            try:
                read(bad)
            except GroundedError as error:
                if len(str(error)) > 500:
                    failures.append(f"{what}: a long message")
            except Exception as error:
                failures.append(f"{what}: {error!r}")
            else:
                failures.append(f"{what}: not noticed")
    return Outcome(tries, tuple(failures))


def recover_damaged(flips: bool, stride: int = 1) -> Outcome:
    """Check that `recover` saves only right numbers and never calls a loss complete."""
    return within("all of them", 10**10, _recover_damaged, flips, stride)


def _recover_damaged(flips: bool, stride: int) -> Outcome:
    trial = a_trial(12)
    source = trial_bytes(trial, {}, b"a policy")
    failures, saved = [], 0
    cases = damaged(source, flips, stride)
    with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
        bad, good = Path(folder, "bad.mcap"), Path(folder, "good.mcap")
        for what, content in cases:
            bad.write_bytes(content)
            good.unlink(missing_ok=True)
            try:
                recovery = recover_log(bad, good)
            except GroundedError:
                if good.exists():
                    failures.append(f"{what}: refused, and left a file")
                continue
            except Exception as error:
                failures.append(f"{what}: {error!r}")
                continue
            if not flips and recovery.complete:
                failures.append(f"{what}: called complete")
            if recovery.lost_messages and recovery.complete:
                failures.append(f"{what}: lost messages, called complete")
            try:
                back, _, _ = read_trial(good)
            except GroundedError as error:
                if "damaged" in str(error) or "checksum" in str(error):
                    failures.append(f"{what}: what recover wrote is itself damaged: {error}")
                continue
            saved += back.steps
            if not (
                np.array_equal(back.states, trial.states[: len(back.states)])
                and np.array_equal(back.inputs, trial.inputs[: len(back.inputs)])
            ):
                failures.append(f"{what}: wrong numbers")
    share = saved / max(1, len(cases) * trial.steps)
    return Outcome(
        len(cases), tuple(failures), f"{100 * share:.0f} % of the steps saved on average"
    )


CHILD = """
import os, random, sys
from grounded_trials.store.store import Store
store = Store(sys.argv[1])
print("ready", flush=True)
for i in range(int(sys.argv[2]), int(sys.argv[3])):
    rng = random.Random(i)
    store.add(b"%d " % i + rng.randbytes(rng.randint(10, 400_000)))
    print(i, flush=True)
"""


def content(i: int) -> bytes:
    rng = random.Random(i)
    return b"%d " % i + rng.randbytes(rng.randint(10, 400_000))


def check_store(store: Store, acknowledged: set[int]) -> list[str]:
    failures = [f"verify: {d.reason}" for d in store.verify()]
    kept = [int(store.read(entry).split(b" ", 1)[0]) for entry in store.list()]
    failures += [f"acknowledged file {i} is gone" for i in acknowledged - set(kept)]
    failures += ["a file is kept twice"] * (len(kept) != len(set(kept)))
    whole = {store.read(entry) for entry in store.list()}
    return failures + [f"file {i} has other bytes" for i in acknowledged if content(i) not in whole]


def kills(count: int, seed: int = 0) -> Outcome:
    """Kill (-9) a process at random moments while it adds files, again and again."""
    rng = random.Random(seed)
    failures: list[str] = []
    acknowledged: set[int] = set()
    with tempfile.TemporaryDirectory() as folder:
        store, next_file = Store(folder), 0
        for _ in range(count):
            arguments = [folder, str(next_file), str(next_file + 10_000)]
            child = subprocess.Popen(
                [sys.executable, "-c", CHILD, *arguments], stdout=subprocess.PIPE, text=True
            )
            assert child.stdout is not None and child.stdout.readline() == "ready\n"
            time.sleep(rng.uniform(0, 0.03))
            child.send_signal(signal.SIGKILL)
            done = [int(line) for line in child.stdout.read().split()]
            child.wait()
            child.stdout.close()
            acknowledged |= set(done)
            next_file = max(done, default=next_file - 1) + 1  # the one that was killed comes again
            failures += [f"verify: {d.reason}" for d in store.verify()]
        failures += check_store(store, acknowledged)
        entries = len(store.list())
    if entries - len(acknowledged) not in (0, 1):
        failures.append(f"{entries} files for {len(acknowledged)} that were acknowledged")
    return Outcome(count, tuple(failures), f"{len(acknowledged)} files acknowledged, all there")


def concurrent(processes: int = 24, contents: int = 12) -> Outcome:
    """Add few files from many processes: each file is stored once, each process succeeds."""
    code = (
        "import random, sys\nfrom grounded_trials.store.store import Store\n"
        "i = int(sys.argv[2]); rng = random.Random(i)\n"
        "print(Store(sys.argv[1]).add(b'%d ' % i + rng.randbytes(rng.randint(10, 400_000))).sha256)"
    )
    with tempfile.TemporaryDirectory() as folder:
        running = [
            subprocess.Popen(
                [sys.executable, "-c", code, folder, str(i % contents)], stdout=subprocess.DEVNULL
            )
            for i in range(processes)
        ]
        failures = [f"exit {p.returncode}" for p in running if p.wait() != 0]
        store = Store(folder)
        failures += check_store(store, set(range(contents)))
        if [s.number for s in store.list()] != list(range(1, contents + 1)):
            failures.append("the numbers have holes")
    return Outcome(processes, tuple(failures), f"{contents} files, each kept once")


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


def run_add(folder: str, size: int, user: str = "", **options: object) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-c", ADD, folder, str(size), *([user] if user else [])],
        capture_output=True,
        text=True,
        **options,  # type: ignore[call-overload]
    )
    return done.returncode, done.stdout + done.stderr


def judge(folder: str, returncode: int, output: str, says: str) -> list[str]:
    """Check after a failed add: one clear message, nothing stored, nothing left behind."""
    failures = []
    if returncode != 1 or "Traceback" in output or says not in output:
        failures.append(f"exit {returncode}: {output[-300:]}")
    left = [p.name for p in Path(folder).iterdir() if p.name != ".lock"] if not failures else []
    if left:
        failures.append(f"left behind: {left}")
    return failures


def size_limit(stride: int = 20_011) -> Outcome:
    """Let writes end early, after any number of bytes."""
    limits = range(0, 200_000, stride)
    failures = []
    for limit in limits:
        with tempfile.TemporaryDirectory() as folder:
            import resource

            def limited(limit: int = limit) -> None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

            code, output = run_add(folder, 200_000, preexec_fn=limited)
            failures += judge(folder, code, output, "File too large")
    return Outcome(len(limits), tuple(failures))


def read_only() -> Outcome:
    """Add to a folder without write permission; as root, as another user."""
    base = Path(tempfile.mkdtemp())
    base.chmod(0o755)
    failures = []
    user = "65534" if os.geteuid() == 0 else ""
    try:
        for name, prepare in (("new", False), ("old", True)):
            folder = base / name / "trials"
            if prepare:
                Store(folder).add(b"x")
            else:
                folder.parent.mkdir()
            for path in (folder.parent, folder):
                if path.exists():
                    path.chmod(0o555)
            code, output = run_add(str(folder), 100, user)
            if code != 1 or "can't be written: Permission denied" not in output:
                failures.append(f"{name}: exit {code}: {output[-300:]}")
            if prepare and Store(folder).read("t0001") != b"x":
                failures.append("the stored file changed")
    finally:
        for path in (*base.rglob("*"), base):
            if path.is_dir():
                path.chmod(0o755)
        shutil.rmtree(base)
    return Outcome(2, tuple(failures))


CALL = re.compile(r"^(?:\d+ +)?(\w+)\(")
NEVER_FAIL = ("brk", "mmap", "munmap", "mremap", "mprotect", "getpid", "gettid", "geteuid")


def system_calls() -> list[tuple[str, int]]:
    """Return each system call of adding a file: its name, and its number among those."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "log")
        store = Path(folder, "store")
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


def fault_injection(stride: int = 1) -> Outcome | None:
    """Fail and kill an add at each of its system calls; return None without strace."""
    if shutil.which("strace") is None:
        return None
    failures, tries = [], 0
    for name, number in system_calls()[::stride]:
        for fault in ("error=EIO", "error=ENOSPC", "signal=KILL"):
            tries += 1
            with tempfile.TemporaryDirectory() as folder:
                store = Store(folder)
                store.add(b"0 first")
                command = ["strace", "-o", "/dev/null", "-e", f"trace={name}"]
                command += ["-e", f"inject={name}:{fault}:when={number}"]
                command += [sys.executable, "-c", ADD, folder, "300000"]
                done = subprocess.run(command, capture_output=True, text=True)
                where = f"{name} {number} {fault}"
                if "Traceback" in done.stderr:
                    failures.append(f"{where}: {done.stderr[-400:]}")
                if store.verify():
                    failures.append(f"{where}: damaged")
                kept = [store.read(s) for s in store.list()]
                if b"0 first" not in kept or (done.stdout == "added\n" and len(kept) != 2):
                    failures.append(f"{where}: lost")
                again = store.add(b"1 " + bytes(300_000))
                if store.read(again.path.name) != b"1 " + bytes(300_000) or len(store.list()) != 2:
                    failures.append(f"{where}: the next add failed")
                if list(Path(folder).glob("*.tmp")) + list(Path(folder).glob(".*.tmp")):
                    failures.append(f"{where}: a temporary file stays")
    return Outcome(tries, tuple(failures))


def verify_flips(stride: int = 1) -> Outcome:
    """Check that `verify` finds a flipped bit in any stored byte."""
    source = trial_bytes(a_trial(), {})
    failures, tries = [], 0
    with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
        store = Store(folder)
        path = store.add(source).path
        path.chmod(0o644)
        for what, bad in damaged(source, True, stride):
            tries += 1
            path.write_bytes(bad)
            if [d.file for d in store.verify()] != [str(path)]:
                failures.append(what)
    return Outcome(tries, tuple(failures))
