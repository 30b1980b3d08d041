"""Budgets of time and memory, stamps, ids of channels."""

from __future__ import annotations

import io
import os
import re
import signal
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from bombs import KINDS, explode, log
from facts import holding
from grounded.errors import GroundedError
from grounded.trial import Trial
from grounded_trials.formats.mcap_walk import DamagedFile
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.recover import recover_log
from grounded_trials.logs.signals import SignalSpec, read_signals
from grounded_trials.store.trial_file import read_trial, trial_bytes
from grounded_trials.within import MEMORY, SECONDS, OverBudget, within
from pace import slowness


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_every_bomb_ends_in_time(name: str, tmp_path: Path) -> None:
    told = {what: cost.wrong for what, cost in explode(name, tmp_path, budget_s=1.0).items()}
    assert not any(told.values()), told


def test_a_trial_in_many_small_chunks_is_read_in_linear_time() -> None:
    steps = 20_000
    trial = Trial(np.zeros((steps + 1, 1)), np.zeros((steps, 1)), 1.0, ("x",), ("u",))
    data = trial_bytes(trial, {})
    began = time.process_time()
    assert read_trial(data)[0].steps == steps
    assert time.process_time() - began < 2.0 * slowness()


def endless() -> None:
    while True:
        pass


def hungry() -> list[bytes]:
    return [bytes(10**8) for _ in range(100)]


def in_c() -> bool:
    return re.search("(a*)*b", "a" * 40) is None  # never looks at a signal's handler


def full() -> None:
    with tempfile.TemporaryFile() as out:
        while True:
            out.write(bytes(10**7))


def hidden() -> None:
    try:
        hungry()
    except MemoryError:
        raise ValueError("a decoder hides what it met") from None


def crash() -> None:
    os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize(
    ("function", "setting"),
    [(endless, SECONDS), (in_c, SECONDS), (hungry, MEMORY), (hidden, MEMORY), (full, MEMORY)],
)
def test_a_reader_ends_at_each_limit_which_is_named(
    function: Callable[[], object], setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(SECONDS, "0.5" if setting == SECONDS else "9")
    monkeypatch.setenv(MEMORY, "50")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(OverBudget, match=holding("a.log", setting)):
        within("a.log", 0, function)
    assert not [*tmp_path.iterdir()]


def test_results_and_errors_come_back() -> None:
    assert within("a.log", 10**8, echo, np.arange(5), b=[1]).tolist() == [1, 2, 3, 4, 5]
    with pytest.raises(DamagedFile, match="a hole") as damaged:
        within("a.log", 0, broken)
    assert damaged.value.offset == 7 and damaged.value.then is not None
    with pytest.raises(ZeroDivisionError):
        within("a.log", 0, divided)


def echo(a: np.ndarray, b: list[int]) -> np.ndarray:
    return a + b[0]


def broken() -> None:
    raise DamagedFile("a.log", 7, "record", "a hole")


def divided() -> float:
    return 1 / 0


def test_a_crash_of_a_decoder_is_an_error_that_names_the_file() -> None:
    with pytest.raises(OverBudget, match=holding("a.log")):
        within("a.log", 0, crash)


def test_ctrl_c_ends_the_child_as_well(tmp_path: Path) -> None:
    note = tmp_path / "pid"

    def press(*_: object) -> None:
        if note.exists() and note.read_text():
            signal.setitimer(signal.ITIMER_REAL, 0)  # once
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, press)
    signal.setitimer(signal.ITIMER_REAL, 0.1, 0.1)
    try:
        with pytest.raises(KeyboardInterrupt):
            within("a.log", 10**8, note_and_wait, note)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    with pytest.raises(ProcessLookupError):
        os.kill(int(note.read_text()), 0)


def note_and_wait(path: Path) -> None:
    path.write_text(str(os.getpid()))
    endless()


def two_channels() -> bytes:
    """Channel 1 is /a, then /b: 1.0 goes to /a, 2.0 to /b by the file's order."""
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.NONE, use_chunking=False)
    writer.start("ros2")
    schema = writer.register_schema("a/msg/M", "ros2msg", b"float64 x")
    numbers = []
    for i, topic in enumerate(("/a", "/b")):
        numbers.append(writer.register_channel(topic, "cdr", schema))
        writer.add_message(numbers[-1], i, b"\0\1\0\0" + struct.pack("<d", i + 1.0), i)
    writer.finish()
    data = bytearray(stream.getvalue())
    for opcode in (4, 5):  # channel /b, and its messages, get the id of /a
        at = 8
        while at < len(data) - 8:
            length = int.from_bytes(data[at + 1 : at + 9], "little")
            if data[at] == opcode and data[at + 9 : at + 11] == bytes([numbers[1], 0]):
                data[at + 9] = numbers[0]
            if data[at] == 15:
                data[at + 9 : at + 13] = bytes(4)  # the checksum of the data: none
                break
            at += 9 + length
    return bytes(data)


def test_a_channel_that_is_defined_again_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(two_channels())
    with pytest.raises(DamagedFile, match=holding("channel 1", "'/a'", "/b")):
        read_signals(path, {"x": SignalSpec("/a.x", clock="log")})
    saved = recover_log(path, tmp_path / "saved.mcap")
    assert not saved.complete and any(loss.code == "file.lost" for loss in saved.findings)
    series = read_signals(tmp_path / "saved.mcap", {"x": SignalSpec("/a.x", clock="log")})
    assert series["x"].values.tolist() == [1.0]


@pytest.mark.parametrize("stamp", ['{"sec": 1e30, "nanosec": 0}', '{"sec": null, "nanosec": 0}'])
def test_stamps_outside_the_calendar_are_refused(stamp: str, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    good = '{"x": 1, "header": {"stamp": {"sec": 5, "nanosec": 0}}}'
    bad = f'{{"x": 1, "header": {{"stamp": {stamp}}}}}'
    path.write_bytes(log("json", None, [good.encode(), bad.encode()]))
    with pytest.raises(GroundedError, match=holding("0.010 s", "stamp")):
        read_signals(path, {"x": SignalSpec("/t.x")})
    assert "stamp" in inspect_log(path).topics[0].problem


def test_a_log_time_after_2262_is_refused_and_left_out_by_recover(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start("ros2")
    schema = writer.register_schema("a/msg/M", "ros2msg", b"float64 x")
    channel = writer.register_channel("/t", "cdr", schema)
    for when in (1, 2**63 + 5, 3):
        writer.add_message(channel, when, b"\0\1\0\0" + bytes(8), when)
    writer.finish()
    path.write_bytes(stream.getvalue())
    with pytest.raises(DamagedFile, match=holding(2262)):
        read_signals(path, {"x": SignalSpec("/t.x", clock="log")})
    saved = recover_log(path, tmp_path / "saved.mcap")
    assert saved.messages == {"/t": 2} and not saved.complete


def test_a_setting_that_is_no_number_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SECONDS, "much")
    with pytest.raises(GroundedError, match="'much'"):
        within("a.log", 0, divided)
