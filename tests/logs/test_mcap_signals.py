"""Logs of other writers to signals: foxglove SDK, rosbags, split bags; and all that can fail."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from bombs import log
from facts import holding
from grounded.errors import GroundedError
from grounded_trials.formats.message_path import Field
from grounded_trials.logs.log_paths import log_files
from grounded_trials.logs.log_table import LogMapping, read_log
from grounded_trials.logs.signals import SignalSpec, read_signals
from shared_data import data, files, needs_data

EPOCH = 1_700_000_000_000_000_000


def floats(path: Path, first: int, count: int, **options: Any) -> Path:
    """A ROS 2 log of /u (Float32) at 100 Hz."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/Float32", "ros2msg", b"float32 data\n")
        channel = writer.register_channel("/u", "cdr", schema)
        for i in range(first, first + count):
            body = b"\0\1\0\0" + struct.pack("<f", i)
            writer.add_message(channel, EPOCH + i * 10**7, body, EPOCH + i * 10**7 - 1000)
        writer.finish()
    return path


U = SignalSpec("/u.data", "log")


def test_a_folder_of_split_files_is_one_log(tmp_path: Path) -> None:
    for i in range(12):
        floats(tmp_path / f"bag_{i}.mcap", 100 * i, 100)
    found = read_signals(tmp_path, {"u": U, "p": SignalSpec("/u.data", "publish")})
    assert found["u"].values.tolist() == list(range(1200))
    assert (found["u"].t - found["p"].t == 1000).all()
    (tmp_path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n"
        "    - bag_1.mcap\n    - bag_0.mcap\n  files:\n    - path: bag_1.mcap\n"
        "      message_count: 100\n    - path: bag_0.mcap\n"
    )
    assert [p.name for p in log_files(tmp_path)] == ["bag_1.mcap", "bag_0.mcap"]
    (tmp_path / "metadata.yaml").write_text("files:\n  - path: ../../etc/passwd.mcap\n")
    with pytest.raises(GroundedError, match=holding("metadata.yaml", "passwd.mcap")):
        log_files(tmp_path)
    with pytest.raises(GroundedError, match=holding("MCAP")):
        log_files(Path(__file__).parent)
    with pytest.raises(GroundedError, match=holding("no.mcap")):
        log_files([tmp_path / "bag_0.mcap", tmp_path / "no.mcap"])


def test_the_foxglove_sdk(tmp_path: Path) -> None:
    foxglove = pytest.importorskip("foxglove")
    from foxglove.channels import PoseInFrameChannel
    from foxglove.messages import Pose, PoseInFrame, Quaternion, Timestamp, Vector3

    path = tmp_path / "fox.mcap"
    rng = np.random.default_rng(0)
    angles = np.cumsum(rng.uniform(-0.2, 0.4, 200))
    with foxglove.open_mcap(str(path)):
        poses = PoseInFrameChannel("/pose")
        plain = foxglove.Channel("/drive", message_encoding="json")
        for i, angle in enumerate(angles.tolist()):
            stamp = Timestamp(sec=EPOCH // 10**9 + i // 100, nsec=(i % 100) * 10**7)
            orientation = Quaternion(z=float(np.sin(angle / 2)), w=float(np.cos(angle / 2)))
            pose = Pose(position=Vector3(x=i, y=-0.0, z=0.5), orientation=orientation)
            body = PoseInFrame(timestamp=stamp, frame_id="map", pose=pose)
            poses.log(body, log_time=EPOCH + i * 10**7 + 5_000_000)
            drive = {"steering": i / 7, "gear": None}
            plain.log(drive, log_time=EPOCH + i * 10**7)
    specs = {
        "x": SignalSpec("/pose.pose.position.x"),
        "yaw": SignalSpec('/pose{frame_id=="map"}.pose.orientation.@rpy.yaw', unwrap=True),
        "u": SignalSpec("/drive.steering", "log"),
        "gear": SignalSpec("/drive.gear", "log"),
    }
    found = read_signals(path, specs)
    assert found["x"].values.tolist() == list(range(200))
    assert found["x"].t.tolist() == [EPOCH + i * 10**7 for i in range(200)]
    assert (found["x"].log_times - found["x"].t == 5_000_000).all()
    assert found["u"].values.tolist() == [i / 7 for i in range(200)]
    assert np.isnan(found["gear"].values).all()
    mapping = LogMapping({n: specs[n] for n in ("x", "yaw")}, {"u": specs["u"]})
    gridded = read_log(path, mapping, 0.02, angles=["yaw"])
    np.testing.assert_allclose(gridded.states[:, 1], angles[::2][:100], atol=1e-9)
    assert gridded.reports[0].skew_s == pytest.approx(-0.005)


def test_ros1_in_mcap(tmp_path: Path) -> None:
    text = "Header header\nfloat64 v\n" + "=" * 80 + "\nMSG: std_msgs/Header\n"
    text += "uint32 seq\ntime stamp\nstring frame_id\n"
    path = tmp_path / "ros1.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros1")
        schema = writer.register_schema("car/Speed", "ros1msg", text.encode())
        channel = writer.register_channel("/speed", "ros1", schema)
        for i in range(100):
            head = struct.pack("<IIII", i, 100 + i, 500, i % 4) + b"abcd"[: i % 4]
            writer.add_message(channel, i, head + struct.pack("<d", i / 3), i)
        writer.finish()
    found = read_signals(path, {"v": SignalSpec("/speed.v")})["v"]
    assert found.values.tolist() == [i / 3 for i in range(100)]
    assert found.t.tolist() == [(100 + i) * 10**9 + 500 for i in range(100)]


def refused(path: Any, spec: SignalSpec, says: str) -> None:
    with pytest.raises(GroundedError) as caught:
        read_signals(path, {"steering": spec})
    assert says in str(caught.value), str(caught.value)


def one_message(path: Path, encoding: str, schema: tuple[str, str, bytes], body: bytes) -> Path:
    path.write_bytes(log(encoding, schema, [body]))
    return path


def test_messages_that_do_not_fit_their_definition(tmp_path: Path) -> None:
    schema = ("x/msg/M", "ros2msg", b"float64 v\nstring s\nfloat64[] l")
    spec = SignalSpec("/t.v", "log")
    short = one_message(tmp_path / "1.mcap", "cdr", schema, b"\0\1\0\0abc")
    refused(short, spec, "x/msg/M")
    odd = one_message(tmp_path / "2.mcap", "cdr", schema, b"\0\3\0\0" + bytes(50))
    refused(odd, spec, "CDR")
    other = one_message(tmp_path / "3.mcap", "flatbuffer", schema, b"")
    refused(other, spec, "'flatbuffer'")
    idl = one_message(tmp_path / "4.mcap", "cdr", ("x/msg/M", "what", b"x"), b"\0\1\0\0")
    refused(idl, spec, "'what'")
    bad = one_message(tmp_path / "5.mcap", "json", ("x", "jsonschema", b"{}"), b"{")
    refused(bad, spec, "/t")
    body = b"\0\1\0\0" + struct.pack("<dI3xxIIdd", 1, 1, 2, 0, 2.0, 3.0)
    many = one_message(tmp_path / "6.mcap", "cdr", schema, body)
    refused(many, SignalSpec("/t.l[:]", "log"), "expected one value")
    assert read_signals(many, {"l": SignalSpec("/t.l[1]", "log")})["l"].values.tolist() == [3]
    refused(many, SignalSpec("/t.l[2]", "log"), "none of 1 message")


@needs_data
def test_wrong_encodings_and_damage_in_real_files() -> None:
    (wrong,) = files("mcap_format_fixtures/rosbag2/*wrong_rmw*")
    refused(wrong, SignalSpec("/test_topic.float64_value"), "'wrong_format'")
    empty = data("mcap_format_fixtures", "misc", "empty_zero_messages.mcap")
    refused(empty, U, "no topic '/u'")
    for path in files("mcap_format_fixtures/derived_corrupt/*.mcap"):
        with pytest.raises(GroundedError):
            read_signals(path, {"u": SignalSpec("/vicon/jetracer1.pose.pose.position.x")})


def at(message: Any, steps: Sequence[Any]) -> list[float]:
    """The numbers of a decoded message at fields and items of lists."""
    for step in steps:
        if isinstance(step, Field):
            if not hasattr(message, step.name):  # of an empty message
                return []
            message = getattr(message, step.name)
        elif -len(message) <= step.start < len(message):
            message = message[step.start]
        else:
            return []
    return [float(message)]


@pytest.mark.slow
@needs_data
def test_every_number_of_every_ros2_fixture_against_the_other_decoder() -> None:
    support = pytest.importorskip("mcap_ros2.decoder")
    from mcap.reader import make_reader

    from grounded_trials.formats.message_path import parse_path
    from grounded_trials.logs.inspection.inspect_log import inspect_log

    compared = 0
    paths = files("mcap_format_fixtures/rosbag2/*.mcap") + files("crazyflie*/*.mcap")
    paths += files("mcap_format_fixtures/evo/*.mcap") + files("dart_small_car/*.mcap")
    for path in paths:
        if "service" in path.name or "wrong" in path.name or "roll2" in path.name:
            continue  # neither decoder reads service events
        report = inspect_log(path)
        paths_here = [f.path for t in report.topics for f in t.fields if ".@" not in f.path]
        specs = {text: SignalSpec(text, "log") for text in paths_here}
        mine = read_signals(path, specs)
        with path.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[support.DecoderFactory()])
            messages: dict[str, list[Any]] = {}
            for m in reader.iter_decoded_messages(log_time_order=False):
                messages.setdefault(m.channel.topic, []).append(m.decoded_message)
        for text, found in mine.items():
            parsed = parse_path(text)
            wanted = [v for o in messages[parsed.topic][:500] for v in at(o, parsed.steps)]
            np.testing.assert_allclose(found.values[: len(wanted)], wanted, rtol=0, atol=1e-12)
            compared += len(wanted)
    assert compared > 50_000


@needs_data
def test_a_transform_is_picked_by_its_frame_and_stamped_by_its_own_header() -> None:
    support = pytest.importorskip("mcap_ros2.decoder")
    from mcap.reader import make_reader

    path = data("mcap_format_fixtures", "evo", "nav2_turtlebot_SIM.mcap")
    wanted = []
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[support.DecoderFactory()])
        for m in reader.iter_decoded_messages(topics=["/tf"], log_time_order=False):
            for transform in m.decoded_message.transforms:
                if transform.child_frame_id == "right_wheel":
                    stamp = transform.header.stamp
                    time = stamp.sec * 10**9 + stamp.nanosec
                    wanted.append((time, transform.transform.rotation.y))
    frames = '/tf.transforms[:]{child_frame_id=="right_wheel"}'
    found = read_signals(path, {"x": SignalSpec(frames + ".transform.rotation.y")})["x"]
    assert len(wanted) > 1000 and found.messages > len(wanted)
    assert list(zip(found.t.tolist(), found.values.tolist(), strict=True)) == wanted


def test_reading_takes_memory_for_what_is_mapped_only(tmp_path: Path) -> None:
    import tracemalloc

    path = tmp_path / "big.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start()
        image = writer.register_channel("/image", "json", 0)
        schema = writer.register_schema("std_msgs/msg/Float32", "ros2msg", b"float32 data\n")
        u = writer.register_channel("/u", "cdr", schema)
        for i in range(200):
            writer.add_message(image, i, bytes(1_000_000), i)
            writer.add_message(u, i, b"\0\1\0\0" + struct.pack("<f", i), i)
        writer.finish()
    tracemalloc.start()
    found = read_signals(path, {"u": U})
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(found["u"].t) == 200 and peak < 20e6  # of a file of 200 MB


def test_what_a_person_is_told(tmp_path: Path) -> None:
    path = floats(tmp_path / "a.mcap", 0, 10)
    refused(path, SignalSpec("/v.data"), "no topic '/v'")
    refused(path, SignalSpec("/u.datum"), "has no field 'datum': did you mean 'data'?")
    refused(path, SignalSpec("/u.data"), "header stamp")
    refused(path, SignalSpec("/u"), "found std_msgs/msg/Float32")
    refused(path, SignalSpec("/u.data.@jaw", "log"), "not '@jaw'")
    refused(tmp_path / "no.mcap", U, "does not exist")
    refused(floats(tmp_path / "b.mcap", 0, 0), U, "no topic '/u'")
    (tmp_path / "c.mcap").write_bytes(path.read_bytes()[:-40])
    refused(tmp_path / "c.mcap", U, "`recover` saves")
