"""A file has the bytes that the mcap package writes of the same records."""

import io

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from grounded_trials.formats.mcap_records import Header
from grounded_trials.formats.mcap_writer import CHUNK_SIZE, McapWriter
from grounded_trials.formats.protobuf import encode_doubles, encode_lists, file_descriptor_set

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
    for channel, k, time, data in rows:
        log.message(channel, time, data)
        if k == 2:
            log.flush()
    log.finish()
    assert stream.getvalue() == by_the_package(rows, compressed)
    assert steps < 4000 or compressed or len(stream.getvalue()) > 2 * CHUNK_SIZE
