"""A whole file at once: the bytes that the mcap package writes, message by message."""

import io

import numpy as np
import pytest

from grounded_trials.formats.mcap_whole import CHUNK, Column, whole_file
from grounded_trials.formats.mcap_writer import LogWriter, rows_of, rows_of_lists

TABLE, ABOUT = {"kind": "candidate", "units": "m, °"}, "A text, ä.".encode()


def by_the_package(columns, written):
    """The same file through `mcap.writer`."""
    stream = io.BytesIO()
    log = LogWriter(stream)
    log.metadata("grounded", TABLE)
    log.attachment("about", "text/plain", ABOUT)
    numbers = [
        log.channel(one.topic, one.message, one.fields, repeated=one.repeated) for one in columns
    ]
    events = sorted(
        (int(time), written.index(k), i, k)
        for k, one in enumerate(columns)
        for i, time in enumerate(one.times)
    )
    for time, _, i, k in events:
        log.message(numbers[k], time, columns[k].rows[i].tobytes())
    log.finish()
    return stream.getvalue()


@pytest.mark.parametrize(("steps", "width"), [(1, 1), (7, 3), (300, 40), (4000, 90)])
@pytest.mark.parametrize("written", [(0, 1, 2), (0, 2, 1), (2, 1, 0)])
def test_the_bytes_are_those_of_the_package(steps, width, written):
    rng, times = np.random.default_rng(steps), np.round(np.arange(steps + 1) * 2e7).astype(np.int64)
    lists = rows_of_lists([rng.standard_normal((steps, width)), np.empty((steps, 0))])
    columns = [
        Column("/policy", "Policy", ["gain", "none"], lists, times[:-1], repeated=True),
        Column("/state", "State", ["x", "v"], rows_of(rng.standard_normal((steps + 1, 2))), times),
        Column("/input", "Input", ["u"], rows_of(rng.standard_normal((steps, 1))), times[:-1]),
    ]
    found = whole_file(TABLE, ABOUT, columns, written)
    assert found == by_the_package(columns, written)
    assert steps < 4000 or len(found) > 2 * CHUNK  # several chunks
