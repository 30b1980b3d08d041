"""Small files whose reading would take gigabytes or hours, one of each kind."""

from __future__ import annotations

import io
import json
import os
import re
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer

from grounded.trial import Trial
from grounded_trials.formats.mcap_records import CHUNK
from grounded_trials.formats.mcap_walk import MAGIC
from grounded_trials.store.trial_file import trial_bytes
from grounded_trials.within import SECONDS
from pace import slowness

BREAK = "=" * 80 + "\n"
TEXTS = f"T[] list\nfloat64 x\n{BREAK}MSG: a/T\nstring s\n"


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


def ros(text: str, messages: Iterable[bytes], **how: object) -> bytes:
    return log("cdr", ("a/msg/M", "ros2msg", text.encode()), messages, **how)  # type: ignore[arg-type]


def idl(text: str, name: str = "a/M") -> bytes:
    return log("cdr", (name, "omgidl", text.encode()), [b"\0\1\0\0" + bytes(64)] * 3)


def _nested_json() -> Iterable[bytes]:
    inner = b"[" + b",".join([b"[]"] * 2_000_000) + b"]"
    return (b'{"x": 1, "y": ' + inner + b"}" for _ in range(16))


def _objects_json() -> Iterable[bytes]:
    inner = b"[" + b",".join([b'{"a":{}}'] * 1_500_000) + b"]"
    return (b'{"x": 1, "y": ' + inner + b"}" for _ in range(4))


def _texts_in_a_list(count: int, messages: int) -> Iterable[bytes]:
    """Return messages with a list of texts of unequal size before the number that is read."""
    item = struct.pack("<I3sx", 3, b"ab\0")
    body = b"\0\1\0\0" + struct.pack("<I", count) + item * count
    body += bytes(-(len(body) - 4) % 8) + struct.pack("<d", 1.0)
    return (body for _ in range(messages))


def _many_fields(count: int, messages: int) -> Iterable[bytes]:
    return (b"\x08\x01" * count + b"\x11" + struct.pack("<d", 1.0) for _ in range(messages))


def _protobuf(messages: Iterable[bytes]) -> bytes:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    files = FileDescriptorSet()
    message = files.file.add(name="m", package="p").message_type.add(name="M")
    message.field.add(name="y", number=1, type=5, label=3)
    message.field.add(name="x", number=2, type=1, label=1)
    return log("protobuf", ("p.M", "protobuf", files.SerializeToString()), messages)


def _zeros(compression: str, count: int, size: int) -> bytes:
    """Return chunks that hold one record of zeros, of an unknown type."""
    import lz4.frame
    import zstandard

    data = struct.pack("<BQ", 0x80, size - 9) + bytes(size - 9)
    pack = zstandard.compress if compression == "zstd" else lz4.frame.compress
    packed, name = pack(data), compression.encode()
    head = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name + struct.pack("<Q", len(packed))
    record = struct.pack("<BQ", CHUNK, len(head) + len(packed)) + head + packed
    end = struct.pack("<BQI", 15, 4, 0) + struct.pack("<BQQQI", 2, 20, 0, 0, 0) + MAGIC
    header = struct.pack("<BQII", 1, 8, 0, 0)
    return MAGIC + header + record * count + end


def _tiny_messages(count: int) -> bytes:
    return ros("float64 x", (b"\0\1\0\0" + bytes(8) for _ in range(count)), chunk=2**27)


def _chunks(count: int) -> bytes:
    """Return a log with one uncompressed chunk per message."""
    body = b"\0\1\0\0" + struct.pack("<d", 1.0)
    none = CompressionType.NONE
    return ros("float64 x", (body for _ in range(count)), compression=none, chunk=1)


def _trial(steps: int, dt: float) -> bytes:
    rng = np.random.default_rng(0)
    states, inputs = rng.normal(size=(steps + 1, 2)), rng.normal(size=(steps, 1))
    return trial_bytes(Trial(states, inputs, dt, ("v", "x"), ("u",)), {"kind": "data"})


def _ranges(count: int, messages: int) -> bytes:
    """Return arrays of a fixed length that a path takes whole."""
    return ros(f"float64[{count}] x", (b"\0\1\0\0" + bytes(8 * count) for _ in range(messages)))


def _constants() -> str:
    chain = "".join(f"const long A{i}=A{i - 1};" for i in range(1, 9_000))
    return f"const long A0=1;{chain}module a {{ struct M {{ double x; }}; }};"


def _wide() -> str:
    members = "".join(f"string s{i};\n" for i in range(15_000))
    return f"module a {{ struct M {{ {members} double x; }}; }};"


def _ros_fields() -> str:
    return "".join(f"string s{i}\n" for i in range(60_000)) + "float64 x\n"


def _ros_doubling() -> str:
    parts = [f"T0 a\nT0 b\nfloat64 x\n{BREAK}"]
    parts += [f"MSG: a/T{i}\nT{i + 1}[3] a\nT{i + 1}[] b\n{BREAK}" for i in range(40)]
    return "".join(parts) + "MSG: a/T40\nstring s\n"


def _attachments() -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    for _ in range(40_000):
        writer.add_attachment(0, 0, "a", "b", b"c")
        writer.add_metadata("grounded", {"format": "x"})
    writer.finish()
    return stream.getvalue()


def _gaps() -> bytes:
    """Return valid records with a stray byte between them, for `recover`."""
    record = struct.pack("<BQ", 12, 8) + bytes(8)
    return MAGIC + (record * 4 + b"\xff" * 3) * 30_000


# name -> (the file, the path of the number to read in it; "": it is read as a trial of ours)
BOMBS: dict[str, tuple[Callable[[], bytes], str]] = {
    "JSON, nested lists": (lambda: log("json", None, _nested_json()), "/t.x"),
    "JSON, nested objects": (lambda: log("json", None, _objects_json()), "/t.x"),
    "JSON, one message": (
        lambda: log("json", None, [json.dumps({"x": 1, "y": [[]] * 20_000_000}).encode()]),
        "/t.x",
    ),
    "lists of texts, ROS 2": (lambda: ros(TEXTS, _texts_in_a_list(99_000, 100)), "/t.x"),
    "all texts of a list, ROS 2": (
        lambda: ros(TEXTS.replace("string s", "string s\nfloat64 y"), _texts_in_a_list(60_000, 4)),
        "/t.list[59000].y",
    ),
    "fields, protobuf": (lambda: _protobuf(_many_fields(190_000, 50)), "/t.x"),
    "packed lists, protobuf": (
        lambda: _protobuf(b"\x0a" + b"\x80\x80\x80\x30" + bytes(100_663_296) for _ in range(2)),
        "/t.y[:]",
    ),
    "zeros, zstd": (lambda: _zeros("zstd", 200, 500 * 2**20), "/t.x"),
    "zeros, zstd, in smaller chunks": (lambda: _zeros("zstd", 250, 90 * 2**20), "/t.x"),
    "zeros, lz4": (lambda: _zeros("lz4", 6, 100 * 2**20), "/t.x"),
    "tiny messages": (lambda: _tiny_messages(500_000), "/t.x"),
    "30,000 chunks": (lambda: _chunks(30_000), "/t.x"),
    "items of fixed lists": (lambda: _ranges(1_000_000, 30), "/t.x[:]"),
    "IDL, constants by constants": (lambda: idl(_constants()), "/t.x"),
    "IDL, texts before a number": (lambda: idl(_wide()), "/t.x"),
    "ROS, texts before a number": (lambda: ros(_ros_fields(), [bytes(300_000)] * 3), "/t.x"),
    "ROS, types that double": (lambda: ros(_ros_doubling(), [bytes(300_000)] * 3), "/t.x"),
    "metadata and attachments": (_attachments, "/t.x"),
    "gaps between records": (_gaps, "/t.x"),
    "a trial of 30,000 steps, a chunk each": (lambda: _trial(30_000, 1.0), ""),
}
# --- other formats ------------------------------------------------------------------------------


def _bag(compression: str, size: int) -> bytes:
    """Return a ROS 1 bag with one chunk of zeros."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.bag")
        bag = Writer(path)
        bag.set_compression(Writer.CompressionFormat[compression])
        bag.chunk_threshold = 2**31
        with bag:
            kind = "std_msgs/msg/UInt8MultiArray"
            topic = bag.add_connection("/t", kind, typestore=store)
            for i in range(size // 10**7):
                bag.write(topic, i + 1, struct.pack("<III", 0, 0, 10**7) + bytes(10**7))
        return path.read_bytes()


def _packed_table(size: int) -> bytes:
    import zstandard

    packer = zstandard.ZstdCompressor().compressobj()
    rows = b"0,0\n" * 10**6
    parts = [packer.compress(b"t,x\n"), *(packer.compress(rows) for _ in range(size // len(rows)))]
    return b"".join([*parts, packer.flush()])


def _ulog() -> bytes:
    """Return a PX4 log whose types contain each other."""
    head = b"ULog\x01\x12\x35\x01" + bytes(8)
    texts = [f"t{i}:t{i + 1}[99] a;t{i + 1}[99] b;".encode() for i in range(9)]
    texts = [b"t:uint64_t timestamp;t0[99] a;", *texts, b"t9:double x;"]
    parts = [struct.pack("<Hc", len(text), b"F") + text for text in texts]
    added, data = b"\0\0\0t", b"\0\0" + bytes(100)
    parts += [struct.pack("<Hc", len(added), b"A") + added]
    parts += [struct.pack("<Hc", len(data), b"D") + data] * 9
    return head + b"".join(parts)


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


def _archive(arrays: Mapping[str, bytes]) -> bytes:
    import zipfile

    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in arrays.items():
            archive.writestr(name + ".npy", data)
    return out.getvalue()


def _parquet() -> bytes:
    """Return a table of a few kilobytes: one value, a thousand million times."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    out = io.BytesIO()
    rows = pa.table({"t": np.zeros(10**7), "x": np.zeros(10**7)})
    with pq.ParquetWriter(out, rows.schema, compression="zstd") as writer:
        for _ in range(30):
            writer.write_table(rows)
    return out.getvalue()


def _mat() -> bytes:
    """Return a MATLAB file with a packed array of zeros."""
    from scipy.io import savemat

    out = io.BytesIO()
    savemat(out, {"t": np.zeros(5 * 10**7), "x": 1.0}, do_compression=True)
    return out.getvalue()


def _mat73() -> bytes:
    """Return a MATLAB file of version 7.3 with an array of which nothing is stored."""
    import h5py

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.mat")
        with h5py.File(path, "w", userblock_size=512) as file:
            for name in ("t", "x"):
                file.create_dataset(name, shape=(10**10,), chunks=(10**6,), dtype="f8")
        data = path.read_bytes()
    return b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM" + data[128:]


def _npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def _long_headers() -> bytes:
    fields = ", ".join(f"('a{i}', '<f8')" for i in range(600))
    head = f"{{'descr': [{fields}], 'fortran_order': False, 'shape': (1,)}}".encode() + b"\n"
    one = b"\x93NUMPY\x01\0" + struct.pack("<H", len(head)) + head + bytes(8 * 600)
    return _archive({f"a{i}": one for i in range(3000)})


# name -> (the file's name, its bytes, the path of the number to read in it)
OTHERS: dict[str, tuple[str, Callable[[], bytes], str]] = {
    "ROS 1, bz2": ("bomb.bag", lambda: _bag("BZ2", 600_000_000), "/t.data[0]"),
    "ROS 1, lz4": ("bomb.bag", lambda: _bag("LZ4", 1_500_000_000), "/t.data[0]"),
    "a table, zstd": ("bomb.csv.zst", lambda: _packed_table(3 * 10**9), "/csv.x"),
    "parquet, one value": ("bomb.parquet", _parquet, "/parquet.x"),
    "MATLAB, packed zeros": ("bomb.mat", _mat, "/mat.x"),
    "MATLAB 7.3, nothing stored": ("bomb.mat", _mat73, "/mat.x"),
    "PX4, types of types": ("bomb.ulg", _ulog, "/t.timestamp"),
    "SQLite, generated columns": (
        "bomb.db3",
        lambda: _sqlite(
            "CREATE TABLE messages (id, topic_id, timestamp, data AS (zeroblob(900000000)))",
            *["INSERT INTO messages VALUES (1, 1, 1)"] * 50,
        ),
        "/t.data",
    ),
    "SQLite, an endless view": (
        "bomb.db3",
        lambda: _sqlite(f"CREATE VIEW endless AS {ENDLESS}", TABLE),
        "/t.data",
    ),
    "SQLite, an endless view without a row": (
        "bomb.db3",
        lambda: _sqlite(
            f"CREATE VIEW endless AS SELECT * FROM ({ENDLESS}) WHERE timestamp < 0", TABLE
        ),
        "/t.data",
    ),
    "NumPy, 30,000 arrays": (
        "bomb.npz",
        lambda: _archive(
            {"t": _npy(np.arange(9.0))} | {f"a{i}": _npy(np.zeros(9)) for i in range(30_000)}
        ),
        "/npz.a5",
    ),
    "NumPy, long headers": ("bomb.npz", _long_headers, "/npz.a5"),
    "NumPy, zeros": (
        "bomb.npz",
        lambda: _archive({"t": _npy(np.zeros(10**8, np.int8)), "x": _npy(np.zeros(10**8, "i1"))}),
        "/npz.x",
    ),
    "metadata.yaml, lines without end": (
        "metadata.yaml",
        lambda: b"files:\n" + b"\n" * 8_000_000 + b"- " + b"a" * 8_000_000,
        "/t.x",
    ),
    "a table, brackets": (
        "bomb.csv",
        lambda: b"(" * 60_000 + b",t\n" + b"1,2\n" * 30,
        "/csv.t",
    ),
    "a table, one line": ("bomb.csv", lambda: b"t,x\n" + b"1," * 1_000_000, "/csv.x"),
}
LONG: dict[str, tuple[Callable[[], bytes], str]] = {  # a minute each: with the study alone
    "2,000,000 tiny messages": (lambda: _tiny_messages(2_000_000), "/t.x"),
    "300,000 chunks": (lambda: _chunks(300_000), "/t.x"),
    "a trial of 400,000 steps, a chunk each": (lambda: _trial(400_000, 1.0), ""),
}


KINDS = {name: ("bomb.mcap", *one) for name, one in (BOMBS | LONG).items()} | OTHERS


def bomb(name: str, folder: Path) -> tuple[Path, str]:
    """Write a bomb; return the file and the path to read in it."""
    where, build, text = KINDS[name]
    (folder / where).write_bytes(build())
    return (folder if where == "metadata.yaml" else folder / where), text


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
        f"sys.path.insert(0, {str(here)!r})\nfrom bombs import bomb\n"
        f"bomb({name!r}, pathlib.Path(sys.argv[1]))"
    )
    made = measured([str(folder)], make, 300)
    assert made.exit == 0, made.text
    file = folder / KINDS[name][0]
    path, size = str(folder if file.name == "metadata.yaml" else file), file.stat().st_size / 1e6
    saved, env = folder / "saved.mcap", {SECONDS: str(budget_s)}
    costs = {
        "read": measured([path, KINDS[name][2]], _READ, env=env),
        "inspect": measured(["inspect", path], env=env),
        "recover": measured(["recover", path, "-o", str(saved)], env=env),
    }
    saved.unlink(missing_ok=True)
    return {what: replace(cost, size_mb=size, budget_s=budget_s) for what, cost in costs.items()}


def main() -> None:
    """Print a line for each bomb: python tests/support/bombs.py [NAME ...]"""
    for name in KINDS:
        if sys.argv[1:] and not any(re.search(word, name) for word in sys.argv[1:]):
            continue
        with tempfile.TemporaryDirectory() as folder:
            for what, cost in explode(name, Path(folder)).items():
                print(
                    f"{name:40} {1e3 * cost.size_mb:8.0f} kB {what:8} {cost.cpu_s:5.1f} s"
                    f" {cost.peak_mb:5.0f} MB exit {cost.exit} {cost.wrong[:300]}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
