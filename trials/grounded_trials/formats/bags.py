"""Convert ROS bags other than MCAP to MCAP records: ROS 2 `.db3` (SQLite) and ROS 1 `.bag`.

A `.db3` consists of a table of topics and one of messages, read with Python's sqlite3, read-only.
Since ROS 2 Iron it contains the definitions of its messages; for older bags they are taken from the
standard types of ROS 2 Humble in rosbags. A `.bag` is read with rosbags (0.10 and later; pure
Python except for its decompressors, and maintained for each ROS release).

A batch holds at most `BATCH` messages or `ROOM` bytes, so memory is bounded for bags of any size.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from grounded.checks import refused
from grounded_trials.formats.mcap_records import Channel, End, Header, Messages, Record, Schema

BATCH, ROOM = 20_000, 64 * 2**20  # messages, bytes
ZSTD = b"\x28\xb5\x2f\xfd"  # with which compressed data begin

Piece = tuple[int, int, bytes]  # channel, time [ns], message


def batches(pieces: Iterable[Piece]) -> Iterator[Messages]:
    """Collect single messages into batches."""
    pieces = iter(pieces)
    while some := [*_first(pieces)]:
        channels, times, parts = zip(*some, strict=True)
        yield _batch(parts, channels, times)


def _first(pieces: Iterator[Piece]) -> Iterator[Piece]:
    room = 0
    for piece in islice(pieces, BATCH):
        yield piece
        room += len(piece[2])
        if room > ROOM:
            return


def _batch(parts: Sequence[bytes], channels: ArrayLike, times: ArrayLike) -> Messages:
    ends, t = np.cumsum([len(part) for part in parts]), np.array(times, dtype=np.int64)
    starts, numbers = np.r_[0, ends[:-1]], np.arange(len(t), dtype=np.uint32)
    return Messages(b"".join(parts), starts, ends, np.array(channels, np.uint16), numbers, t, t)


def sqlite_records(path: Path) -> Iterator[Record]:
    """Yield the records of a ROS 2 `.db3` file."""
    import sqlite3

    waiting = path.with_name(path.name + "-wal").exists()  # left by a recorder that was killed
    name = f"{path.absolute().as_uri()}?mode=ro{'' if waiting else '&immutable=1'}"
    with closing(sqlite3.connect(name, uri=True)) as bag:
        yield from _tables(bag, path)


def _tables(bag: Any, path: Path) -> Iterator[Record]:
    tables = {name for (name,) in bag.execute("SELECT name FROM sqlite_master WHERE type='table'")}
    if not {"topics", "messages"} <= tables:
        raise refused("file.no_log", path, head="SQLite")
    yield Header("ros2", "rosbag2 sqlite3")
    query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    rows = bag.execute(query) if "message_definitions" in tables else ()
    known = {kind: (encoding, text) for kind, encoding, text in rows if text}
    topics = bag.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
    numbers = dict[str, int]()  # of the types that are defined
    for kind in dict.fromkeys(kind for _, _, kind, _ in topics):
        encoding, text = known.get(kind) or ("ros2msg", _standard(kind))
        if text:
            numbers[kind] = len(numbers) + 1
            yield Schema(numbers[kind], kind, encoding, text.encode())
    channels: dict[int, int] = {}
    for i, (identity, topic, kind, encoding) in enumerate(topics):
        channels[identity] = i
        yield Channel(i, topic, encoding, numbers.get(kind, 0), {})
    messages = bag.execute("SELECT topic_id, timestamp, data FROM messages")
    yield from batches(
        (_known(channels, topic, path), stamp, data) for topic, stamp, data in messages
    )
    yield End(data_crc=False)


def _known(channels: dict[int, int], topic: int, path: Path) -> int:
    if topic not in channels:
        raise refused("file.damaged", path, part=f"channel {topic}")
    return channels[topic]


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


def decompressed(batch: Messages) -> Messages:
    """Decompress the messages of a batch if each is compressed (rosbag2's mode "message").

    No CDR message begins like a zstd frame.
    """
    starts, ends = batch.starts.tolist(), batch.ends.tolist()
    if not starts or batch.buffer[starts[0] : starts[0] + 4] != ZSTD:
        return batch
    import zstandard

    decoder = zstandard.ZstdDecompressor(max_window_size=2**27)
    parts = list[bytes]()
    for start, end in zip(starts, ends, strict=True):
        with decoder.stream_reader(batch.buffer[start:end]) as reader:
            parts.append(reader.read())
    return _batch(parts, batch.channels, batch.log_times)
