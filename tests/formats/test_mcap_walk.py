"""MCAP's records, read and written, against the format's conformance files and other writers."""

from __future__ import annotations

import io
import json
import struct
import tarfile
import zlib
from typing import Any

import numpy as np
import pytest
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from facts import holding
from grounded.errors import GroundedError
from grounded_trials.formats.mcap_records import (
    Attachment,
    Channel,
    End,
    Header,
    Messages,
    Metadata,
    Schema,
)
from grounded_trials.formats.mcap_walk import MAGIC, DamagedFile, read_records
from grounded_trials.formats.mcap_writer import CHUNK_SIZE, McapWriter
from grounded_trials.formats.protobuf import encode_doubles, encode_lists, file_descriptor_set
from shared_data import data, files, needs_data


def plain(source: bytes) -> list[Any]:
    """What the walk finds, in the words of the conformance suite's expected records."""
    found: list[Any] = []
    for r in read_records(source, "file"):
        if isinstance(r, Header):
            found.append(("Header", r.library, r.profile))
        elif isinstance(r, Schema):
            found.append(("Schema", r.id, r.name, r.encoding, r.data))
        elif isinstance(r, Channel):
            found.append(("Channel", r.id, r.topic, r.encoding, r.schema_id, r.metadata))
        elif isinstance(r, Attachment):
            found.append(("Attachment", r.name, r.media_type, r.data, r.log_time, r.create_time))
        elif isinstance(r, Metadata):
            found.append(("Metadata", r.name, r.data))
        elif isinstance(r, Messages):
            for i in range(len(r)):
                body = r.buffer[r.starts[i] : r.ends[i]]
                times = (int(r.log_times[i]), int(r.publish_times[i]))
                found.append(("Message", int(r.channels[i]), int(r.sequences[i]), *times, body))
    return found


def expected(records: list[dict[str, Any]]) -> list[Any]:
    """The expected records of a conformance file, without indexes and summary."""
    found: list[Any] = []
    for record in records:
        f = dict(record["fields"])
        octets = bytes(int(b) for b in f.get("data", [])) if record["type"] != "Chunk" else b""
        kind = record["type"]
        if kind == "DataEnd":
            break
        if kind == "Header":
            found.append((kind, f["library"], f["profile"]))
        elif kind == "Schema":
            found.append((kind, int(f["id"]), f["name"], f["encoding"], octets))
        elif kind == "Channel":
            head = (kind, int(f["id"]), f["topic"], f["message_encoding"])
            found.append((*head, int(f["schema_id"]), f["metadata"]))
        elif kind == "Attachment":
            times = (int(f["log_time"]), int(f["create_time"]))
            found.append((kind, f["name"], f["media_type"], octets, *times))
        elif kind == "Metadata":
            found.append((kind, f["name"], f["metadata"]))
        elif kind == "Message":
            times = (int(f["log_time"]), int(f["publish_time"]))
            found.append((kind, int(f["channel_id"]), int(f["sequence"]), *times, octets))
    return found


@needs_data
def test_all_conformance_files_are_read_as_expected() -> None:
    wanted = {}
    with tarfile.open(data("mcap_conformance", "expected_records_json.tar.gz")) as archive:
        for member in archive.getmembers():
            stream = archive.extractfile(member)
            if stream is not None and member.name.endswith(".json"):
                wanted[member.name.split("/")[-1][:-5]] = json.load(stream)["records"]
    paths = files("mcap_conformance/*/*.mcap")
    assert len(paths) == len(wanted) == 416
    for path in paths:
        assert plain(path.read_bytes()) == expected(wanted[path.stem]), path.name


@needs_data
def test_agrees_with_the_mcap_package_on_every_undamaged_file() -> None:
    paths = files("*/*.mcap") + files("mcap_format_fixtures/*/*.mcap")
    paths = [p for p in paths if "derived_corrupt" not in str(p)]
    assert len(paths) > 25
    for path in paths:
        mine = [r for r in plain(path.read_bytes()) if r[0] == "Message"]
        theirs = []
        for r in StreamReader(io.BytesIO(path.read_bytes())).records:
            if type(r).__name__ == "Message":
                times = (r.log_time, r.publish_time)
                theirs.append(("Message", r.channel_id, r.sequence, *times, r.data))
        assert mine == theirs, path.name


@needs_data
@pytest.mark.parametrize(
    ("name", "code", "what"),
    [
        ("zero_bytes.mcap", "file.no_message", "empty"),
        ("magic_only.mcap", "file.no_message", "cut"),
        ("cf_thrust_step1_cut_midchunk.mcap", "file.damaged", "cut"),
        ("dart_fast_truncated60pct.mcap", "file.damaged", "cut"),
        ("dart_fast_no_footer.mcap", "file.damaged", "cut"),
        ("dart_fast_bitrot_chunk3.mcap", "file.damaged", "record"),
    ],
)
def test_damaged_files_are_refused(name: str, code: str, what: str) -> None:
    path = data("mcap_format_fixtures", "derived_corrupt", name)
    with pytest.raises(DamagedFile) as caught:
        plain(path.read_bytes())
    assert (caught.value.finding.code, caught.value.what) == (code, what)
    assert caught.value.offset <= path.stat().st_size
    if caught.value.what == "cut":  # not where the chunk begins, long before
        assert caught.value.offset == path.stat().st_size


def written(**options: Any) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream, **options)
    writer.start()
    schema = writer.register_schema("a", "jsonschema", b"{}")
    channel = writer.register_channel("/a", "json", schema)
    for i in range(100):
        writer.add_message(channel, i, b'{"x": %d}' % i, i)
    writer.finish()
    return stream.getvalue()


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("crcs", [True, False])
def test_every_way_to_write(chunked: bool, compression: CompressionType, crcs: bool) -> None:
    source = written(
        use_chunking=chunked,
        compression=compression,
        enable_crcs=crcs,
        enable_data_crcs=crcs,
        chunk_size=200,
    )
    messages = [r for r in plain(source) if r[0] == "Message"]
    assert [m[3] for m in messages] == list(range(100))
    *_, end = read_records(source, "file")
    assert isinstance(end, End) and end.data_crc is crcs


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def chunk(content: bytes, compression: str, data: bytes, size: int | None = None) -> bytes:
    size = len(content) if size is None else size
    head = struct.pack("<QQQI", 0, 0, size, zlib.crc32(content)) + text(compression)
    return record(6, head + struct.pack("<Q", len(data)) + data)


def test_a_record_that_claims_too_much_takes_no_memory() -> None:
    header = record(1, text("") + text(""))
    for hostile in (
        record(9, b"x", length=2**62),
        record(3, b"x", length=2**33),
        chunk(b"", "zstd", b"x" * 100, size=2**40),
        chunk(b"", "lz4", b"x" * 100, size=2**40),
    ):
        with pytest.raises(DamagedFile):
            plain(MAGIC + header + hostile)


def test_what_is_no_mcap_file_says_so() -> None:
    for source in (b"\x89PNG\r\n\x1a\n" + bytes(100), b"#ROSBAG V2.0\n" + bytes(100)):
        with pytest.raises(GroundedError) as other:
            plain(source)
        assert other.value.finding.code == "file.no_log"
    with pytest.raises(GroundedError) as short:
        plain(MAGIC[:5])
    assert short.value.finding.code == "file.no_message"
    with pytest.raises(GroundedError, match=holding("3 bytes")):
        plain(written() + b"abc")


def test_a_chunk_with_a_flipped_bit_is_refused() -> None:
    source = bytearray(written(chunk_size=200, compression=CompressionType.NONE))
    source[source.index(b'{"x": 50}')] ^= 1
    with pytest.raises(DamagedFile, match=holding("chunk", "checksum")) as refused:
        plain(bytes(source))
    assert refused.value.offset > 0


TABLE, ABOUT = {"kind": "candidate", "units": "m, °"}, "A text, ä.".encode()
CHANNELS = (
    ("/policy", "Policy", ["gain", "none"], True),
    ("/state", "State", ["x", "v"], False),
    ("/input", "Input", ["u"], False),
)


def by_the_package(rows, compressed):
    stream = io.BytesIO()
    kind = CompressionType.ZSTD if compressed else CompressionType.NONE
    log = Writer(stream, compression=kind, enable_data_crcs=True)
    log.start("p", "grounded")
    log.add_metadata("grounded", TABLE)
    log.add_attachment(3, 0, "about", "text/plain", ABOUT)
    for topic, message, names, repeated in CHANNELS:
        data = file_descriptor_set(message, names, repeated=repeated)
        schema = log.register_schema(f"grounded.{message}", "protobuf", data)
        log.register_channel(topic, "protobuf", schema)
    for channel, k, time, data in rows:
        log.add_message(channel, time, data, time, k)
        if k == 2:
            log.flush()
    log.finish()
    return stream.getvalue()


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(("steps", "width"), [(0, 1), (1, 1), (7, 3), (300, 40), (4000, 90)])
def test_the_bytes_are_those_of_the_package(steps, width, compressed):
    rng = np.random.default_rng(steps)
    lists = encode_lists([rng.standard_normal((steps, width)), np.empty((steps, 0))])
    columns = [lists, *(encode_doubles(rng.standard_normal((steps, k))) for k in (2, 1))]
    rows = [(c + 1, k, 20_000_000 * k, columns[c][k]) for k in range(steps) for c in (0, 2, 1)]
    stream = io.BytesIO()
    log = McapWriter(stream, Header("p", "grounded"), compressed=compressed)
    log.metadata("grounded", TABLE)
    log.attachment("about", "text/plain", ABOUT, create_time=3)
    for topic, message, names, repeated in CHANNELS:
        log.doubles(topic, message, names, repeated=repeated)
    for channel, k, time, content in rows:
        log.message(channel, time, content)
        if k == 2:
            log.flush()
    log.finish()
    assert stream.getvalue() == by_the_package(rows, compressed)
    assert steps < 4000 or compressed or len(stream.getvalue()) > 2 * CHUNK_SIZE
