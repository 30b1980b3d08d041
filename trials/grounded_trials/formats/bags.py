"""Convert ROS bags other than MCAP to MCAP records: ROS 2 `.db3` (SQLite) and ROS 1 `.bag`.

A `.db3` consists of a table of topics and one of messages, read with Python's sqlite3, read-only.
Since ROS 2 Iron it contains the definitions of its messages; for older bags they are taken from the
standard types of ROS 2 Humble in rosbags. A `.bag` is read with rosbags (0.10 and later; pure
Python except for its decompressors, and maintained for each ROS release).

A batch holds at most `BATCH` messages or `ROOM` bytes, so memory is bounded for bags of any size.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from grounded.errors import GroundedError
from grounded.findings import found
from grounded_trials.formats.mcap_records import Channel, End, Header, Messages, Record, Schema

BATCH, ROOM = 20_000, 64 * 2**20  # messages, bytes

Piece = tuple[int, int, bytes]  # channel, time [ns], message


def batches(pieces: Iterable[Piece]) -> Iterator[Messages]:
    """Collect single messages into batches."""
    held: list[Piece] = []
    room = 0
    for piece in pieces:
        held.append(piece)
        room += len(piece[2])
        if len(held) == BATCH or room > ROOM:
            yield _batch(held)
            held, room = [], 0
    if held:
        yield _batch(held)


def _batch(pieces: list[Piece]) -> Messages:
    channels, times, parts = zip(*pieces, strict=True)
    ends = np.cumsum(np.array([len(part) for part in parts], dtype=np.int64))
    t = np.array(times, dtype=np.int64)
    return Messages(
        b"".join(parts),
        np.concatenate([[0], ends[:-1]]),
        ends,
        np.array(channels, dtype=np.uint16),
        np.arange(len(t), dtype=np.uint32),
        t,
        t,
    )


def sqlite_records(path: Path) -> Iterator[Record]:
    """Yield the records of a ROS 2 `.db3` file.

    Raises:
        GroundedError: if it is not a bag.
    """
    import sqlite3

    waiting = path.with_name(path.name + "-wal").exists()  # left by a recorder that was killed
    name = f"{path.absolute().as_uri()}?mode=ro{'' if waiting else '&immutable=1'}"
    with closing(sqlite3.connect(name, uri=True)) as bag:
        yield from _tables(bag, path)


def _tables(bag: Any, path: Path) -> Iterator[Record]:
    tables = {name for (name,) in bag.execute("SELECT name FROM sqlite_master WHERE type='table'")}
    if not {"topics", "messages"} <= tables:
        raise GroundedError(found("file.no_log", str(path), head="SQLite"))
    yield Header("ros2", "rosbag2 sqlite3")
    known = _definitions(bag) if "message_definitions" in tables else {}
    topics = bag.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
    kinds = list(dict.fromkeys(kind for _, _, kind, _ in topics))
    numbers = {kind: i for i, kind in enumerate(kinds, start=1)}
    for kind, number in numbers.items():
        encoding, text = known.get(kind) or ("ros2msg", _standard(kind))
        if text:
            yield Schema(number, kind, encoding, text.encode())
    channels: dict[int, int] = {}
    for i, (identity, topic, kind, encoding) in enumerate(topics):
        channels[identity] = i
        missing = not known.get(kind) and not _standard(kind)
        yield Channel(i, topic, encoding, 0 if missing else numbers[kind], {})
    yield from batches(_messages(bag, channels, path))
    yield End(data_crc=False)


def _definitions(bag: Any) -> dict[str, tuple[str, str]]:
    query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    return {kind: (encoding, text) for kind, encoding, text in bag.execute(query) if text}


def _messages(bag: Any, channels: dict[int, int], path: Path) -> Iterator[Piece]:
    query = "SELECT topic_id, timestamp, data FROM messages"
    for topic, stamp, data in bag.execute(query):
        if topic not in channels:
            raise GroundedError(found("file.damaged", str(path), part=f"channel {topic}"))
        yield channels[topic], stamp, data


def _standard(kind: str) -> str:
    """Return the definition of a standard ROS 2 type, "" if Humble doesn't have it."""
    store = standard_types()
    return str(store.generate_msgdef(kind, 2)[0]) if kind in store.fielddefs else ""


@cache
def standard_types() -> Any:
    """Return the types of ROS 2 Humble."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def ros1_records(path: Path) -> Iterator[Record]:
    """Yield the records of a ROS 1 `.bag` file."""
    from rosbags.rosbag1 import Reader

    with Reader(path) as bag:
        yield Header("ros1", "rosbag")
        numbers: dict[int, int] = {}
        for i, one in enumerate(bag.connections):
            numbers[one.id] = i
            yield Schema(i + 1, one.msgtype, "ros1msg", one.msgdef.data.encode())
            yield Channel(i, one.topic, "ros1", i + 1, {})
        yield from batches((numbers[c.id], t, bytes(data)) for c, t, data in bag.messages())
        yield End(data_crc=False)


def expanded(batch: Messages) -> Messages:
    """Decompress the messages of a batch one by one (rosbag2's zstd mode "message")."""
    import zstandard

    decoder = zstandard.ZstdDecompressor(max_window_size=2**27)
    pieces: list[Piece] = []
    columns = (batch.starts, batch.ends, batch.channels, batch.log_times)
    for start, end, channel, time in zip(*(c.tolist() for c in columns), strict=True):
        data = batch.buffer[start:end]
        if data.startswith(b"\x28\xb5\x2f\xfd"):
            with decoder.stream_reader(data) as reader:
                data = reader.read()
        pieces.append((channel, time, data))
    return _batch(pieces)
