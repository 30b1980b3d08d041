"""Our writer against the mcap package's: the same calls give the same bytes."""

from __future__ import annotations

import io
from collections import Counter

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from grounded_trials.formats.mcap_stream import CHUNK_SIZE, McapStream


class Both:
    """Two files, one of each writer, given the same records."""

    def __init__(self) -> None:
        self.ours, self.theirs = io.BytesIO(), io.BytesIO()
        self.stream = McapStream(self.ours, "ros2", "grounded")
        self.package = Writer(self.theirs, compression=CompressionType.NONE, enable_data_crcs=True)
        self.package.start(profile="ros2", library="grounded")
        self.numbers: Counter[int] = Counter()

    def channel(self, topic: str, message: str) -> int:
        schema = self.package.register_schema(message, "protobuf", message.encode())
        assert self.stream.schema(message, "protobuf", message.encode()) == schema
        channel = self.package.register_channel(topic, "protobuf", schema)
        assert self.stream.channel(topic, "protobuf", schema) == channel
        return channel

    def about(self, name: str) -> None:
        table, data = {"ü": name, "": "x" * 300}, name.encode() * 7
        self.package.add_metadata(name, table)
        self.stream.metadata(name, table)
        self.package.add_attachment(0, 0, name, "text/plain", data)
        self.stream.attachment(name, "text/plain", data)

    def message(self, channel: int, time: int, data: bytes) -> None:
        self.package.add_message(channel, time, data, time, self.numbers[channel])
        self.stream.message(channel, time, data)
        self.numbers[channel] += 1

    def flush(self) -> None:
        self.package.flush()  # type: ignore[no-untyped-call]
        self.stream.flush()
        assert self.ours.getvalue() == self.theirs.getvalue()

    def finish(self) -> bytes:
        self.package.finish()  # type: ignore[no-untyped-call]
        self.stream.finish()
        assert self.ours.getvalue() == self.theirs.getvalue()
        return self.ours.getvalue()


@pytest.mark.parametrize("seed", range(5))
def test_records_in_any_order(seed: int) -> None:
    rng, both = np.random.default_rng(seed), Both()
    channels = [both.channel("/first", "First")]
    for k in range(60):
        action = rng.integers(8)
        if action == 0:
            both.about(f"n{k}")
        elif action == 1:
            channels.append(both.channel(f"/t{k}", f"Type{k}"))
        elif action == 2:
            both.flush()
        else:
            size, time = int(rng.integers(200)), int(rng.integers(2**62))
            both.message(int(rng.choice(channels)), time, rng.bytes(size))
    both.finish()


def test_chunks_that_fill_up() -> None:
    both = Both()
    both.about("grounded")
    channel = both.channel("/state", "State")
    for k in range(5):
        both.message(channel, k, bytes(CHUNK_SIZE // 2))
    late = both.channel("/input", "Input")
    both.message(late, 3, b"")
    assert len(both.finish()) > 2 * CHUNK_SIZE


def test_files_without_messages() -> None:
    Both().finish()
    both = Both()
    both.channel("/state", "State")
    both.flush()
    both.finish()
