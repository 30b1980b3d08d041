"""grounded view: a viewer of its own, reachable from this machine only; a sentence without one."""

from __future__ import annotations

import stat
import sys

import pytest

from cli import grounded
from facts import holds
from grounded_cli import report
from reported import cart, copied

__all__ = ["cart"]
needs_posix = pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")


@pytest.mark.extra("view")
def test_without_a_screen_the_recording_is_written_and_named(cart, tmp_path, monkeypatch):
    folder = copied(cart, tmp_path / "w")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    done = grounded("-C", folder, "view")
    assert done.code == 1
    assert holds(done.err, "recording.rrd", "rerun")
    assert (folder / "reports" / "recording.rrd").stat().st_size > 1000


@pytest.mark.slow
@needs_posix
@pytest.mark.extra("view")
@pytest.mark.parametrize(("ending", "code"), [("exit 3", 1), ("sleep 3", 0)])
def test_the_viewer_is_started_for_this_machine_alone(cart, tmp_path, monkeypatch, ending, code):
    folder = copied(cart, tmp_path / "w")
    program = tmp_path / "rerun"
    program.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/words\n{ending}\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("DISPLAY", ":7")
    monkeypatch.setattr(report.sys, "executable", str(tmp_path / "python"))
    done = grounded("-C", folder, "view")
    assert done.code == code, done.err
    assert "Traceback" not in done.err
    words = (tmp_path / "words").read_text().split()
    assert words[:3] == ["--new", "--bind", "127.0.0.1"] and words[3].endswith("recording.rrd")
