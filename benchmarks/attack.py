"""Attacks on files, folders and commands, which count what was tried and what broke.

Run by hand, in a clone: python benchmarks/attack.py [--seconds 60] [--seed 0] [--only NAME].
The seconds are for each attack. Exits with 1 if anything broke.
"""

from __future__ import annotations

import argparse
import random
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from bombs import BOMBS, OTHERS, explode
from cli import COMMAND, grounded
from grounded.errors import GroundedError
from grounded_trials.formats.mcap_walk import MAGIC
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.recover import recover_log
from grounded_trials.report.gathering import known_optimum
from grounded_trials.report.reporting import save_optimum
from grounded_trials.store.candidate_file import read_candidate
from grounded_trials.store.documents import StudyStore
from grounded_trials.store.trial_file import read_trial, trial_bytes
from grounded_trials.workspace.folder import Folder
from reliability import MEMORY, a_candidate, a_trial
from workspaces import CONFIG, MODEL, make

HANG_S = 10.0
LONGEST = 60  # [s of CPU] for a command; other processes may use the cores
KINDS = ("silent", "traceback", "hang", "memory")


@dataclass
class Tally:
    """The number of tries, and a sentence about each break."""

    tries: int = 0
    broken: dict[str, list[str]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    note: Counter[str] = field(default_factory=Counter)
    # [kB] of this process: a forked one begins with the memory of its parent
    at_start: int = field(
        default_factory=lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    )

    def add(self, kind: str, what: str) -> None:
        self.broken[kind].append(what[-600:])

    @property
    def failures(self) -> list[str]:
        return [f"{kind}: {what}" for kind, found in self.broken.items() for what in found]


class Hang(BaseException):
    pass


@contextmanager
def trying(tally: Tally, what: str) -> Iterator[None]:
    """Run one try in this process; a refusal is fine, any other exception counts as a break."""

    def stop(*_: object) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, HANG_S)
    tally.tries += 1
    try:
        yield
    except GroundedError as error:
        tally.note["refused"] += 1
        if len(str(error)) > 5000:
            tally.add("traceback", f"{what}: a message of {len(str(error))} letters")
    except Hang:
        tally.add("hang", what)
    except Exception as error:
        tally.add("traceback", f"{what}: {error!r}")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss > tally.at_start + 10**6:
        tally.add("memory", what)


def command(tally: Tally, what: str, *words: object) -> int:
    """Run a command in this process and return its exit code, or -1."""
    code = -1
    with trying(tally, what):
        done = grounded(*words)
        code = done.code
        if code not in (0, 1, 3):
            tally.add("traceback", f"{what}: exit {code}: {done.err}")
        said = done.err.count("error: ") == 1 or (words[-1] == "verify" and "damaged: " in done.err)
        if code == 1 and not said:
            tally.add("traceback", f"{what}: {done.err.count('error: ')} messages: {done.err}")
    return code


def during(seconds: float) -> Iterator[int]:
    """Yield numbers from 0 until the time is over, at least one."""
    end, number = time.monotonic() + seconds, 0
    while number == 0 or time.monotonic() < end:
        yield number
        number += 1


# --- MCAP files that are sound where it is checked, and wrong in their structure ----------------

Records = list[tuple[int, bytes]]


def taken_apart(data: bytes) -> Records:
    """Return the records of a file or of a chunk."""
    found, pos = [], 0
    while pos < len(data):
        opcode, length = struct.unpack_from("<BQ", data, pos)
        found.append((opcode, data[pos + 9 : pos + 9 + length]))
        pos += 9 + length
    return found


def put_together(records: Records) -> bytes:
    return b"".join(struct.pack("<BQ", opcode, len(body)) + body for opcode, body in records)


def _rewritten(body: bytes, rng: random.Random, change: Callable[[Records], None]) -> bytes:
    """Return an uncompressed chunk with other records and a matching checksum."""
    length = struct.unpack_from("<I", body, 28)[0]
    inner = taken_apart(body[40 + length :])
    change(inner)
    data = put_together(inner)
    head = body[:16] + struct.pack("<QI", len(data), zlib.crc32(data)) + body[28 : 32 + length]
    return head + struct.pack("<Q", len(data)) + data


def mutated(source: bytes, rng: random.Random) -> tuple[str, bytes]:
    """Return what was changed and a file with valid checksums but invalid records."""
    records = taken_apart(source[8:-8])
    chunks = [i for i, (opcode, _) in enumerate(records) if opcode == 6]
    name = rng.choice(sorted(_MUTATIONS))
    if chunks and rng.random() < 0.7:
        i = rng.choice(chunks)
        body = _rewritten(records[i][1], rng, lambda inner: _MUTATIONS[name](inner, rng))
        records[i] = (6, body)
    else:
        end = next(i for i, (opcode, _) in enumerate(records) if opcode == 15)
        data = records[:end]
        _MUTATIONS[name](data, rng)
        records = data + records[end:]
    end = next((i for i, (opcode, _) in enumerate(records) if opcode == 15), None)
    if end is not None:
        crc = zlib.crc32(MAGIC + put_together(records[:end]))
        records[end] = (15, struct.pack("<I", crc))
    if records and records[-1][0] == 2:
        records[-1] = (2, bytes(20))  # no summary
    return name, MAGIC + put_together(records) + MAGIC


def _numbers(records: Records, rng: random.Random) -> None:
    """Change a field of a record's head: an id, a time, a length."""
    i = rng.randrange(len(records))
    opcode, body = records[i]
    heads = {3: (0, 6), 4: (0, 8), 5: (0, 22), 6: (0, 40), 9: (0, 20), 12: (0, 4), 1: (0, 4)}
    low, high = heads.get(opcode, (0, len(body)))
    if high > low and len(body) >= high:
        at = rng.randrange(low, high)
        size = min(rng.choice((1, 2, 4, 8)), high - at)
        value = rng.choice((0, 1, 2**15, 2**31, 2**63, 2**64 - 1, rng.getrandbits(64)))
        part = (value & (256**size - 1)).to_bytes(size, "little")
        records[i] = (opcode, body[:at] + part + body[at + size :])


def _place(records: Records, rng: random.Random) -> int:
    return rng.randrange(len(records))


def _swapped(records: Records, rng: random.Random) -> None:
    i, j = _place(records, rng), _place(records, rng)
    records[i], records[j] = records[j], records[i]


def _resized(records: Records, rng: random.Random, longer: bool) -> None:
    """Cut a record or add to it, but for messages: absent fields are 0, more bytes are no field."""
    i = _place(records, rng)
    opcode, body = records[i]
    if opcode != 5:
        cut = body[: rng.randrange(len(body) + 1)]
        records[i] = (opcode, body + rng.randbytes(rng.randint(1, 40)) if longer else cut)


def _other_kind(records: Records, rng: random.Random) -> None:
    i = _place(records, rng)
    records[i] = (rng.choice((*range(1, 16), 0x80, 0)), records[i][1])


def _inserted(records: Records, rng: random.Random, record: tuple[int, bytes]) -> None:
    records.insert(rng.randrange(len(records) + 1), record)


_MUTATIONS: dict[str, Callable[[Records, random.Random], None]] = {
    "a number": _numbers,
    "a record twice": lambda records, rng: _inserted(records, rng, rng.choice(records)),
    "a record less": lambda records, rng: records.__delitem__(_place(records, rng)),
    "two swapped": _swapped,
    "cut": lambda records, rng: _resized(records, rng, longer=False),
    "longer": lambda records, rng: _resized(records, rng, longer=True),
    "another kind": _other_kind,
    "a strange record": lambda records, rng: _inserted(
        records, rng, (rng.randrange(256), rng.randbytes(rng.randint(0, 60)))
    ),
}


def mutants(rng: random.Random, seconds: float) -> Tally:
    """Read, inspect and recover mutated trials and candidates."""
    tally = Tally()
    trial = a_trial(12)
    policy, candidate = a_candidate()
    source = trial_bytes(trial, {"kind": "trial"}, b"a policy")
    with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
        bad, good = Path(folder, "bad.mcap"), Path(folder, "good.mcap")
        for k in during(seconds):
            name, data = mutated(candidate if k % 3 == 2 else source, rng)
            bad.write_bytes(data)
            good.unlink(missing_ok=True)
            what = f"mutant {k}, {name}"
            with trying(tally, what):
                if k % 3 == 2:
                    back = read_candidate(data)[0]
                    if not np.array_equal(back.feedforward, policy.feedforward):
                        tally.add("silent", f"{what}: another candidate")
                else:
                    _compare(tally, what, data)
            with trying(tally, f"{what}, inspect"):
                inspect_log(bad)
            with trying(tally, f"{what}, recover"):
                saved = recover_log(bad, good)
                if k % 3 != 2 and saved.complete:
                    _compare(tally, f"{what}, recovered", good.read_bytes())
    return tally


def _compare(tally: Tally, what: str, data: bytes) -> None:
    """Check that a trial has the states and inputs that were written."""
    trial, (back, _, _) = a_trial(12), read_trial(data)
    steps = len(back.states)
    same = np.array_equal(back.states, trial.states[:steps])
    if not (same and np.array_equal(back.inputs, trial.inputs[: len(back.inputs)])):
        tally.add("silent", f"{what}: other numbers")


# --- configurations ------------------------------------------------------------------------------

ODD = ("nan", "inf", "-1", "0", "1e308", "1e-320", "true", '""', "[]", "{}", "[[[]]]", "9" * 400)
ODD += ('"\\u001b[8m"', '"../../x"', '"/dev/zero"', "1979-05-27", "'x'", "2", "0x7fffffffffffffff")
ODD_CODE = (
    "None",
    "np.nan",
    "1/0",
    "s",
    "lambda: 1",
    "'x'",
    "{}",
    "np.zeros(3)",
    "p",
    "1e400",
    "[]",
)


def fuzzed_toml(rng: random.Random) -> str:
    lines = CONFIG.splitlines()
    for _ in range(rng.randint(1, 3)):
        i = rng.randrange(len(lines))
        how = rng.randrange(5)
        if how == 0 and "=" in lines[i]:
            lines[i] = lines[i].split("=")[0] + "= " + rng.choice(ODD)
        elif how == 1:
            del lines[i]
        elif how == 2:
            lines.insert(i, rng.choice(lines))
        elif how == 3:
            at = rng.randrange(len(lines[i]) + 1)
            lines[i] = lines[i][:at] + chr(rng.choice((0, 9, 27, 34, 91, 0x202E, 0x1F600)))
        else:
            lines[i] = "[" * rng.choice((1, 3, 5000)) + lines[i]
    return "\n".join(lines)


def fuzzed_model(rng: random.Random) -> str:
    """Return model.py with an expression replaced, a line removed, or a line cut."""
    lines = MODEL.splitlines()
    i = rng.choice([k for k, line in enumerate(lines) if line.strip()])
    how = rng.randrange(4)
    if how == 0:
        del lines[i]
    elif how == 1:
        lines[i] = lines[i][: rng.randrange(len(lines[i]))]
    else:
        parts = lines[i].replace("(", " ( ").replace(",", " , ").split(" ")
        parts[rng.randrange(len(parts))] = rng.choice(ODD_CODE)
        indent = lines[i][: len(lines[i]) - len(lines[i].lstrip())]
        lines[i] = indent + " ".join(parts).strip()
    return "\n".join(lines)


def fuzzed_target(rng: random.Random) -> str:
    rows = [f"{0.05 * i:.2f},{i / 40:.6f}" for i in range(41)]
    lines = ["t,x", *rows]
    for _ in range(rng.randint(1, 3)):
        i = rng.randrange(len(lines))
        odd = ("nan", "", "1e400", "a", '"', "1,2", "\0", "-0", "9" * 500, ";", "\ufeff", " ")
        cells = lines[i].split(",")
        cells[rng.randrange(len(cells))] = rng.choice(odd)
        lines[i] = ",".join(cells)
        if rng.random() < 0.2:
            del lines[rng.randrange(len(lines))]
    return "\n".join(lines)


FUZZES = (("config", fuzzed_toml), ("model", fuzzed_model), ("target", fuzzed_target))


def configurations(rng: random.Random, seconds: float) -> Tally:
    """Run `propose`, `status` and `run` on mutated grounded.toml, model.py and target.csv."""
    tally = Tally()
    with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
        for k in during(seconds):
            kind, fuzz = FUZZES[k % 3]
            text = fuzz(rng)
            np.nan, np.inf = float("nan"), float("inf")  # a model.py may have assigned to them
            where = Path(folder, "w")
            shutil.rmtree(where, ignore_errors=True)
            with trying(tally, f"{kind} {k}"):
                make(where, **{kind: text})
            for words in (("propose",), ("status",)):
                code = command(tally, f"{kind} {k} {words[0]}: {text!r}", "-C", where, *words)
                tally.note["accepted" if code == 0 else "refused"] += 1
    return tally


# --- commands that are killed, starved, crowded --------------------------------------------------

WRITING: tuple[tuple[str, ...], ...] = (
    ("init", "W2", "--example", "pendulum"),
    ("propose",),
    ("run",),
    ("ingest", "RUN"),
    ("learn", "--trials", "2"),
    ("fit", "--apply"),
    ("diagnose",),
    ("adopt", "input_gain:force"),
    ("report", "--html"),
    ("export", "best", "--format", "json", "-o", "out.json"),
    ("export", "best", "--runner", "-o", "out.npz"),
    ("next", "RUN"),
    ("target", "step", "--to", "x=0.5"),
    ("discard", "t0001", "--why", "a wheel was loose"),
    ("restore", "t0001"),
    ("recover", "RUN", "-o", "saved.mcap"),
)


def prepared(folder: Path) -> tuple[Path, str]:
    """Make a workspace with three trials, a waiting candidate and a run not yet ingested."""
    where = folder / "w"
    make(where)
    for words in (["learn", "--trials", "3"], ["propose"], ["run"]):
        done = grounded("-C", where, *words)
        assert done.code == 0, done.err
    return where, str(max((where / "runs").glob("*.mcap"), key=lambda p: p.stat().st_mtime_ns))


def words_of(command: tuple[str, ...], where: Path, run: str) -> list[str]:
    """Return the arguments that run a writing command in a workspace."""
    told = [
        run.replace("/prepared/", f"/{where.parent.name}/") if w == "RUN" else w for w in command
    ]
    if command[0] == "init":
        return [told[0], str(where.parent / "w2"), *told[2:]]
    told = [str(where / w) if w in ("out.json", "out.npz", "saved.mcap") else w for w in told]
    return ["-C", str(where), *told]


def _proved(tally: Tally, what: str, where: Path, before: set[str]) -> None:
    """Check after an attack that every stored file is intact and none is missing."""
    kept = {path.name for path in (where / "trials").glob("*.mcap")}
    if before - kept:
        tally.add("silent", f"{what}: {before - kept} gone")
    done = subprocess.run(
        [*COMMAND, "-C", str(where), "verify"], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        tally.add("silent", f"{what}: verify says {done.stdout} {done.stderr}")


def _starved(words: list[str], how: Callable[[], None] | None = None, kill: float = 0) -> str:
    """Run a command with limits, or kill it after a time; return what is wrong with its end."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (LONGEST, LONGEST))
        if how is not None:
            how()

    child = subprocess.Popen(
        [*COMMAND, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=limited,
    )
    try:
        out, _ = child.communicate(timeout=kill or 20 * LONGEST)
    except subprocess.TimeoutExpired:
        child.kill()
        child.communicate()
        return "" if kill else "hang"
    if child.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        return "hang"
    wrong = "Traceback" in out or child.returncode not in (0, 1, 3, -signal.SIGXFSZ)
    return f"exit {child.returncode}: {out}" if wrong else ""


def _kind(wrong: str) -> str:
    return "hang" if wrong == "hang" else "traceback"


def _copies(seconds: float) -> Iterator[tuple[int, Path, Path, set[str]]]:
    """Yield numbered copies of a workspace, with a run to ingest and the trials it has."""
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder, "prepared")
        base.mkdir()
        original, run = prepared(base)
        before = {path.name for path in (original / "trials").glob("*.mcap")}
        for k in during(seconds):
            copy = Path(folder, f"copy{k}")
            shutil.copytree(base, copy)
            yield k, copy, run, before
            shutil.rmtree(copy)


def _attacked(
    rng: random.Random, seconds: float, attack: Callable[[Tally, list[str], str], None]
) -> Tally:
    """Attack each writing command in a copy of a workspace, repeat it alone, verify the copy."""
    tally = Tally()
    for k, copy, run, before in _copies(seconds):
        command = WRITING[k % len(WRITING)]
        words = words_of(command, copy / "w", run)
        tally.tries += 1
        tally.note[command[0]] += 1
        attack(tally, words, f"{command[0]} {k}")
        shutil.rmtree(copy / "saved.mcap", ignore_errors=True)
        (copy / "w" / "saved.mcap").unlink(missing_ok=True)
        if wrong := _starved(words):
            tally.add(_kind(wrong), f"{command[0]} {k}, again: {wrong}")
        _proved(tally, f"{command[0]} {k}", copy / "w", before)
    return tally


def kills(rng: random.Random, seconds: float) -> Tally:
    """Kill every writing command (-9) at a random moment and run it again."""

    def attack(tally: Tally, words: list[str], what: str) -> None:
        if wrong := _starved(words, kill=rng.uniform(0.1, 2.0)):
            tally.add(_kind(wrong), f"{what}: {wrong}")

    return _attacked(rng, seconds, attack)


def short_writes(rng: random.Random, seconds: float) -> Tally:
    """Run every writing command with file sizes limited to a few bytes or kilobytes."""

    def attack(tally: Tally, words: list[str], what: str) -> None:
        size = rng.choice((0, 10, 100, 1000, 3000, 8000, 20_000, 60_000))

        def limited() -> None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

        if wrong := _starved(words, how=limited):
            tally.add(_kind(wrong), f"{what}, {size} bytes: {wrong}")

    return _attacked(rng, seconds, attack)


def crowds(rng: random.Random, seconds: float) -> Tally:
    """Run six commands of all kinds at once in one workspace, then `verify`."""
    tally = Tally()
    for k, copy, run, before in _copies(seconds):
        chosen = [rng.choice((*WRITING[1:-1], ("status",), ("verify",))) for _ in range(6)]
        running = [
            subprocess.Popen(
                [*COMMAND, *words_of(words, copy / "w", run)],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            for words in chosen
        ]
        for words, child in zip(chosen, running, strict=True):
            tally.tries += 1
            out, _ = child.communicate()
            if "Traceback" in out or child.returncode not in (0, 1, 3):
                tally.add("traceback", f"{words} among {chosen}: {out}")
        _proved(tally, f"crowd {k}: {chosen}", copy / "w", before)
    return tally


# --- flipped bits ---------------------------------------------------------------------------------

READING = (("status",), ("propose",))


def flips(rng: random.Random, seconds: float) -> Tally:
    """Flip one bit of any file of a workspace: commands end well, and `verify` finds it."""
    tally = Tally()
    results = {f"seed {k}": {"utility": -1.5 + k, "errors": [0.25, float("inf")]} for k in range(3)}
    with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
        where, _ = prepared(Path(folder))
        for words in (["diagnose", "--max-effects", "1"], ["report"]):
            grounded("-C", where, *words)
        save_optimum(Folder(where), -1.5)
        study = StudyStore(where / "study")
        study.update(results)
        files = [p for p in where.rglob("*") if p.is_file() and p.stat().st_size]
        edited = {"grounded.toml", "target.csv"}
        files = [p for p in files if p.suffix in (".mcap", ".json", ".db") or p.name in edited]
        files = [p for p in files if p.parent.name != "runs"]
        for k in during(seconds):
            path = rng.choice(files)
            source = path.read_bytes()
            mode = path.stat().st_mode
            bit = rng.randrange(8 * len(source))
            bad = bytearray(source)
            bad[bit // 8] ^= 1 << bit % 8
            path.chmod(0o644)
            path.write_bytes(bytes(bad))
            what = f"bit {bit} of {path.relative_to(where)}"
            if path.name == "optimum.json" and known_optimum(path.parent) is not None:
                tally.add("silent", f"{what}: the report believes it")
            tally.note[path.parent.name if path.suffix == ".mcap" else path.name] += 1
            kept = {p: p.read_bytes() for p in where.rglob("*") if p.is_file()}
            command(tally, what, "-C", where, *READING[k % 2])
            stated = path.suffix == ".mcap" or b"sha256" in source  # a checksum to be proved
            if path.parent == study.folder:
                if [key for key in study if study[key] != results[key]] or len(study) > 2:
                    tally.add("silent", f"{what}: {dict(study)}")
            elif (
                path.name not in edited
                and stated
                and command(tally, what, "-C", where, "verify") == 0
            ):
                tally.add("silent", f"{what}: verify finds nothing")
            _restored(where, kept)
            path.chmod(0o644)
            path.write_bytes(source)
            path.chmod(mode)
    return tally


def _restored(where: Path, kept: Mapping[Path, bytes]) -> None:
    """Make a folder as it was: remove new files, and write those that differ."""
    for now in [p for p in where.rglob("*") if p.is_file() and p not in kept]:
        now.unlink()
    for one, data in kept.items():
        if not one.exists() or one.read_bytes() != data:
            one.unlink(missing_ok=True)
            one.write_bytes(data)


def bombs(rng: random.Random, seconds: float) -> Tally:
    """Read, inspect and recover every small file that asks for much memory or time."""
    tally, names = Tally(), [*BOMBS, *OTHERS]
    rng.shuffle(names)
    end = time.monotonic() + seconds
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            for what, cost in explode(name, Path(folder)).items():
                tally.tries += 1
                if "Traceback" in cost.text or cost.exit not in (0, 1, 3):
                    tally.add("traceback", f"{name}, {what}: exit {cost.exit}: {cost.text}")
                if cost.cpu_s > max(5.0, cost.size_mb):
                    tally.add("hang", f"{name}, {what}: {cost.cpu_s:.1f} s")
                if cost.peak_mb > 500:
                    tally.add("memory", f"{name}, {what}: {cost.peak_mb:.0f} MB")
        if time.monotonic() > end:
            break
    return tally


ATTACKS: dict[str, Callable[[random.Random, float], Tally]] = {
    "mutants": mutants,
    "configurations": configurations,
    "kills": kills,
    "short writes": short_writes,
    "crowds": crowds,
    "flips": flips,
    "bombs": bombs,
}


def apart(name: str, seed: int, seconds: float) -> Tally:
    """Run an attack in its own process, so that its memory is measured alone."""
    with get_context("fork").Pool(1) as pool:
        return pool.apply(ATTACKS[name], (random.Random(f"{seed} {name}"), seconds))


def main() -> None:
    """Print a row for each attack, and what broke."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=ATTACKS)
    given = parser.parse_args()
    heads = {"silent": "silently wrong", "traceback": "tracebacks"}
    heads |= {"hang": "over 10 s", "memory": "over 1 GB"}
    print(f"| tried | times | {' | '.join(heads[k] for k in KINDS)} |\n|---|---|" + "---|" * 4)
    failures: list[str] = []
    for name in [given.only] if given.only else list(ATTACKS):
        tally = apart(name, given.seed, given.seconds)
        counts = " | ".join(str(len(tally.broken[kind])) for kind in KINDS)
        print(f"| {name} | {tally.tries} | {counts} |", flush=True)
        failures += [f"{name}: {failure}" for failure in tally.failures]
    print("\n".join(["", *failures[:40]]))
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
