"""Small files whose reading would take gigabytes or hours: in our code, packed, in a library."""

from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mcap.writer import CompressionType, Writer

from grounded_trials.formats.mcap_records import Op
from grounded_trials.formats.mcap_walk import MAGIC
from grounded_trials.within import SECONDS
from pace import slowness


def log(
    encoding: str,
    schema: tuple[str, str, bytes] | None,
    messages: Iterable[bytes],
    *,
    compression: CompressionType = CompressionType.ZSTD,
    chunk: int = 2**20,
) -> bytes:
    """Return a log with one topic, /t."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=chunk, compression=compression)
    writer.start("ros2")
    number = writer.register_schema(*schema) if schema else 0
    channel = writer.register_channel("/t", encoding, number)
    for i, data in enumerate(messages):
        writer.add_message(channel, i * 10**7, data, i * 10**7)
    writer.finish()
    return stream.getvalue()


def _nested_json() -> Iterable[bytes]:
    inner = b"[" + b",".join([b"[]"] * 2_000_000) + b"]"
    return (b'{"x": 1, "y": ' + inner + b"}" for _ in range(16))


def _zeros(count: int, size: int) -> bytes:
    """Return chunks that hold one record of zeros, of an unknown type."""
    import zstandard

    packed = zstandard.compress(struct.pack("<BQ", 0x80, size - 9) + bytes(size - 9))
    name = b"zstd"
    head = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name + struct.pack("<Q", len(packed))
    record = struct.pack("<BQ", Op.CHUNK, len(head) + len(packed)) + head + packed
    end = struct.pack("<BQI", 15, 4, 0) + struct.pack("<BQQQI", 2, 20, 0, 0, 0) + MAGIC
    header = struct.pack("<BQII", 1, 8, 0, 0)
    return MAGIC + header + record * count + end


def _sqlite(*lines: str) -> bytes:
    """Return a ROS 2 bag made by these lines of SQL."""
    import sqlite3
    from contextlib import closing

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.db3")
        with closing(sqlite3.connect(path)) as bag:
            bag.execute("CREATE TABLE topics (id, name, type, serialization_format)")
            bag.execute("INSERT INTO topics VALUES (1, '/t', 'std_msgs/msg/Float64', 'cdr')")
            for line in lines:
                bag.execute(line)
            bag.commit()
        return path.read_bytes()


ENDLESS = (
    "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) "
    "SELECT x AS id, 1 AS topic_id, x AS timestamp, x'0001000000000000' AS data FROM c"
)
TABLE = (  # whose rows are those of the view
    "CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data, content=endless, "
    "content_rowid=id)"
)


# name -> (the file's name, its bytes, the path of the number to read in it)
KINDS: dict[str, tuple[str, Callable[[], bytes], str]] = {
    "JSON, nested lists": ("bomb.mcap", lambda: log("json", None, _nested_json()), "/t.x"),
    "zeros, zstd": ("bomb.mcap", lambda: _zeros(200, 500 * 2**20), "/t.x"),
    "SQLite, an endless view": (
        "bomb.db3",
        lambda: _sqlite(f"CREATE VIEW endless AS {ENDLESS}", TABLE),
        "/t.data",
    ),
}


@dataclass(frozen=True)
class Cost:
    """How a command ended, and the time and memory that it took."""

    exit: int  # negative: the signal that ended it
    cpu_s: float
    peak_mb: float
    text: str  # of both outputs
    size_mb: float = 0.0  # of the file that it read
    budget_s: float = 3.0  # of CPU time, for an empty file

    @property
    def wrong(self) -> str:
        """Return why this is not a clean end, or "": no traceback, under 500 MB, and in time."""
        if "Traceback" in self.text or self.exit not in (0, 1, 3):
            return f"exit {self.exit}: {self.text[-300:]}"
        allowed = self.budget_s + 4.0 + self.size_mb
        slow = self.cpu_s > allowed and self.cpu_s > allowed * slowness()
        over = slow or self.peak_mb > 500 or len(self.text) > 20_000
        took = f"{self.cpu_s:.1f} s, {self.peak_mb:.0f} MB, {len(self.text)} letters"
        return took if over else ""


_START = """
import pathlib, re, resource, sys
def told(_, peak=sys.argv.pop(1)):
    status = pathlib.Path("/proc/self/status").read_text()  # not of the process that forked
    mine = int(re.search(r"VmHWM:\\s+(\\d+)", status)[1])
    child = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss  # the largest one
    pathlib.Path(peak).write_text(str(max(mine, child)))
import atexit
atexit.register(told, 0)
"""
_CLI = "from grounded_cli.main import main\nmain()"
_READ = """
from grounded.errors import GroundedError
from grounded_trials.logs.signals import SignalSpec, read_signals
from grounded_trials.store.trial_file import read_trial
try:
    if sys.argv[2]:
        read_signals(sys.argv[1], {"x": SignalSpec(sys.argv[2], clock="log")})
    else:
        read_trial(sys.argv[1])
except GroundedError as error:
    sys.exit(f"error: {error}")
"""


def measured(
    words: Sequence[str], code: str = _CLI, timeout_s: float = 600, env: Mapping[str, str] = {}
) -> Cost:
    """Run `grounded WORDS` (or other code) in a process and measure its CPU time and memory."""
    with tempfile.TemporaryDirectory() as folder:
        output, peak = Path(folder, "output"), Path(folder, "peak")
        with output.open("wb") as out:
            limited = ["timeout", "-s", "KILL", str(timeout_s)]
            child = subprocess.Popen(
                [*limited, sys.executable, "-c", _START + code, str(peak), *words],
                stdout=out,
                stderr=subprocess.STDOUT,
                env={**os.environ, **env},
            )
            _, status, used = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
        mb = int(peak.read_text()) / 1000 if peak.exists() else 0.0
        text = output.read_text(errors="replace")
        return Cost(child.returncode, used.ru_utime + used.ru_stime, mb, text)


def explode(name: str, folder: Path, budget_s: float = 3.0) -> dict[str, Cost]:
    """Read, inspect and recover a bomb that is built in its own process."""
    here = Path(__file__).parent
    make = (
        f"sys.path.insert(0, {str(here)!r})\nfrom bombs import KINDS\n"
        f"pathlib.Path(sys.argv[1]).write_bytes(KINDS[{name!r}][1]())"
    )
    file = folder / KINDS[name][0]
    made = measured([str(file)], make, 300)
    assert made.exit == 0, made.text
    path, size = str(file), file.stat().st_size / 1e6
    saved, env = folder / "saved.mcap", {SECONDS: str(budget_s)}
    costs = {
        "read": measured([path, KINDS[name][2]], _READ, env=env),
        "inspect": measured(["inspect", path], env=env),
        "recover": measured(["recover", path, "-o", str(saved)], env=env),
    }
    saved.unlink(missing_ok=True)
    return {what: replace(cost, size_mb=size, budget_s=budget_s) for what, cost in costs.items()}
