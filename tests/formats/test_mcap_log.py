"""Trials and candidates as files: to the last bit; MCAP's records against other writers."""

from __future__ import annotations

import io
import json
import struct
import tarfile
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory

from facts import holding
from grounded.errors import GroundedError, NextCommand
from grounded.trial import Trial
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
from grounded_trials.formats.protobuf import (
    encode_doubles,
    encode_lists,
    file_descriptor_set,
    numbers_in,
)
from grounded_trials.store.candidate_file import encoded_candidate, read_candidate
from grounded_trials.store.trial_file import TrialWriter, read_trial, trial_bytes, write_trial
from rewriting import with_metadata
from shared_data import data, files, needs_data
from small_tasks import a_policy


def a_trial(steps: int = 40, seed: int = 0) -> Trial:
    rng = np.random.default_rng(seed)
    return Trial(
        states=rng.normal(size=(steps + 1, 3)),
        inputs=rng.normal(size=(steps, 2)),
        dt=0.05,
        state_names=("v", "x", "psi"),
        input_names=("steering", "throttle"),
        candidate="c0003",
        start_inputs=np.array([0.1, -0.0]),
    )


def test_a_trial_comes_back_exactly() -> None:
    trial = a_trial()
    odd = trial.states.copy()
    odd[3] = [np.nan, np.inf, -0.0]
    odd[4] = [5e-324, 1.7e308, 0.1 + 0.2]
    trial = replace(trial, states=odd)
    meta = {"iteration": "3", "alpha": repr(0.1), "note": 'a "quoted" ü\nline'}
    source = trial_bytes(trial, meta, b"policy", state_units={"v": "m/s"})
    back, found, policy = read_trial(source)
    assert back.states.tobytes() == trial.states.tobytes()
    assert back.inputs.tobytes() == trial.inputs.tobytes()
    assert back.start_inputs is not None and trial.start_inputs is not None
    assert back.start_inputs.tobytes() == trial.start_inputs.tobytes()
    assert (back.dt, back.state_names) == (0.05, trial.state_names)
    assert back.input_names == trial.input_names
    assert back.candidate == "c0003" and len(back.id) == 64
    assert {k: found[k] for k in meta} == meta and policy == b"policy"
    assert json.loads(found["states"]) == {"v": "m/s", "x": "1", "psi": "1"}


@pytest.mark.parametrize("feedback", [True, False])
def test_a_candidate_comes_back_exactly(feedback: bool, tmp_path: Path) -> None:
    policy, rng = a_policy(feedback=feedback), np.random.default_rng(2)
    x, u = rng.normal(size=(21, 3)), rng.normal(size=(20, 2))
    path = tmp_path / "c0001.mcap"
    path.write_bytes(encoded_candidate(policy, x, u, {"alpha": "0.5"})[0])
    back, px, pu, meta = read_candidate(path)
    for part in ("feedforward", "low", "high", "past", "gain", "reference"):
        mine, theirs = getattr(policy, part), getattr(back, part)
        assert (mine is None and theirs is None) or mine.tobytes() == theirs.tobytes()
    for part in ("dt", "state_names", "input_names", "depths", "angles"):
        assert getattr(policy, part) == getattr(back, part)
    assert np.array_equal(px, x) and np.array_equal(pu, u) and meta["alpha"] == "0.5"


def test_other_tools_read_named_fields() -> None:
    trial = a_trial()
    reader = make_reader(
        io.BytesIO(trial_bytes(trial, {})), decoder_factories=[DecoderFactory()], validate_crcs=True
    )
    seen = [m.decoded_message for m in reader.iter_decoded_messages(topics=["/state"])]
    assert [s.x for s in seen] == trial.states[:, 1].tolist()
    candidate = encoded_candidate(a_policy(), np.zeros((21, 3)), np.zeros((20, 2)), {})[0]
    reader = make_reader(io.BytesIO(candidate), decoder_factories=[DecoderFactory()])
    seen = [m.decoded_message for m in reader.iter_decoded_messages(topics=["/policy"])]
    gain = a_policy().gain
    assert gain is not None and list(seen[5].gain) == gain[5].ravel().tolist()
    summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None
    assert (summary.statistics.metadata_count, summary.statistics.attachment_count) == (1, 1)


def test_a_live_trial_that_is_cut_off_keeps_all_but_its_last_second(tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    writer = TrialWriter(path, 0.02, {"x": "m"}, {"u": "1"}, {})
    for k in range(250):
        writer.append(k * 0.02, np.array([k]), np.array([-k]))
    on_disk = path.stat().st_size  # without close: the battery is gone
    assert on_disk > 0.75 * 250 * 2 * 40
    with pytest.raises(GroundedError) as refused:
        read_trial(path)
    assert refused.value.then == NextCommand("recover", (str(path),))
    writer.close()
    writer.close()
    trial, _, _ = read_trial(path)
    assert trial.steps == 249  # the last input led to no state


def test_a_writer_never_overwrites(tmp_path: Path) -> None:
    path = tmp_path / "trial.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(GroundedError, match="exists already"):
        TrialWriter(path, 0.1, {"x": "m"}, {"u": "1"}, {})
    assert path.read_bytes() == b"precious"


def test_refusals() -> None:
    with pytest.raises(GroundedError, match=holding("'dt'")):
        trial_bytes(a_trial(), {"dt": "1"})
    policy, x, u = a_policy(), np.zeros((21, 3)), np.zeros((20, 2))
    gain = np.array(policy.gain)
    gain[7, 0, 0] = np.nan
    with pytest.raises(GroundedError, match=holding("gain", "step 7")):
        encoded_candidate(replace(policy, gain=gain), x, u, {})
    with pytest.raises(GroundedError, match=holding("(21, 3)", "(20, 3)")):
        encoded_candidate(policy, x[1:], u, {})
    with pytest.raises(GroundedError, match=holding("grounded trial 1", "grounded candidate 1")):
        read_trial(encoded_candidate(policy, x, u, {})[0])
    with pytest.raises(GroundedError, match=holding("grounded trial 1", "grounded candidate 1")):
        read_candidate(trial_bytes(a_trial(), {}))
    with pytest.raises(GroundedError, match=holding("/nowhere/t.mcap")):
        read_trial("/nowhere/t.mcap")
    with pytest.raises(GroundedError, match=holding("/nowhere/t.mcap")):
        write_trial("/nowhere/t.mcap", a_trial(), {})


def test_reading_needs_no_mcap_and_no_protobuf() -> None:
    import subprocess
    import sys

    code = (
        "import sys; from grounded_trials.store.trial_file import read_trial; "
        "read_trial(sys.stdin.buffer.read()); "
        "bad = [m for m in sys.modules if m.split('.')[0] in ('mcap', 'google', 'zstandard')]; "
        "sys.exit(bool(bad) and str(bad))"
    )
    source = trial_bytes(a_trial(), {})
    subprocess.run([sys.executable, "-c", code], input=source, check=True)


def test_a_file_without_its_checksum_is_refused() -> None:
    from mcap.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    writer.add_metadata("grounded", {"format": "grounded trial 1"})
    writer.finish()
    with pytest.raises(GroundedError, match="checksum"):
        read_trial(stream.getvalue())


@pytest.mark.parametrize("repeated", [False, True])
@pytest.mark.parametrize("names", [[], ["x"], ["n" * 10, "k" * 33, "w" * 127], ["ü"], ["w" * 130]])
def test_our_own_definitions_are_known_without_the_library(
    names: list[str], repeated: bool
) -> None:
    data = file_descriptor_set("State", names, repeated=repeated)
    found = numbers_in(Schema(1, "grounded.State", "protobuf", data))
    assert found == {name: (i, repeated) for i, name in enumerate(names, start=1)}
    other = file_descriptor_set("State", names, repeated=repeated).replace(b"proto3", b"proto2")
    assert numbers_in(Schema(1, "grounded.State", "protobuf", other)) == found


def test_a_live_trial_on_a_full_disk_says_so() -> None:
    class Full(io.BytesIO):
        def write(self, data: object) -> int:
            if self.tell() > 3000:
                raise OSError(28, "ENOSPC, full disk")
            return super().write(data)  # type: ignore[arg-type]

    writer = TrialWriter(Full(), 0.1, {"x": "m"}, {"u": "1"}, {})
    with pytest.raises(GroundedError, match=holding("ENOSPC, full disk")):
        for k in range(1000):
            writer.append(k * 0.1, np.zeros(1), np.zeros(1))
    with pytest.raises(GroundedError, match=holding("(1,)", "(2,)")):
        writer.append(0.0, np.zeros(2), None)


NASTY = ["", "x", "-1", "0", "1e999", "nan", "inf", "null", "[]", "{}", "[[[1]]]", "[1e999, 2]"]


@pytest.mark.parametrize("value", [None, *NASTY])
def test_a_strangers_metadata_is_read_or_refused_with_a_message(value: str | None) -> None:
    trial = trial_bytes(a_trial(4), {})
    candidate = encoded_candidate(a_policy(), np.zeros((21, 3)), np.zeros((20, 2)), {})[0]
    candidate = with_metadata(candidate, "sha256", None)  # else it alone would refuse everything
    for key in ("dt", "states", "inputs", "candidate", "start_inputs", "start_ns"):
        try:
            found, _, _ = read_trial(with_metadata(trial, key, value))
        except GroundedError as error:
            assert len(str(error)) < 500
        else:
            assert found.steps == 4 and found.dt > 0
    table = json.loads(read_candidate(candidate)[3]["policy"])
    for key in ("dt", "states", "inputs", "steps", "policy", *table):
        changed = value
        if key in table:
            try:
                inner = {**table, key: json.loads(value or "null")}
            except (ValueError, RecursionError):
                continue
            key, changed = "policy", json.dumps(inner)
        try:
            policy, _, _, _ = read_candidate(with_metadata(candidate, key, changed))
        except GroundedError as error:
            assert len(str(error)) < 500
        else:
            assert policy.horizon == 20 and np.isfinite(policy.feedforward).all()


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
