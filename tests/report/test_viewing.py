"""Viewers: reachable from this machine only, and their paths; what extras bring."""

from __future__ import annotations

import re
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from cli import grounded
from facts import holds
from grounded.errors import GroundedError, needs
from grounded.figures.figure import Figure
from grounded_cli import report
from grounded_trials.report.figures.png import png
from reported import copied
from workspaces import make

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


PAGE = Path(__file__).resolve().parents[2] / "docs" / "foxglove.md"


needs_page = pytest.mark.skipif(not PAGE.exists(), reason="docs/ is not beside the tests")


@pytest.fixture(scope="module")
def car(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page's RC car, with feedback: its policy has gains."""
    folder = tmp_path_factory.mktemp("foxglove") / "car"
    make(folder, "car-circle")
    assert grounded("-C", folder, "learn", "--trials", 1).code == 0
    return folder


def _paths(text: str) -> set[str]:
    return set(re.findall(r"`(/[a-z_]+(?:\.[a-z_]+(?:\[\d+\])?)?)`", text))


def _values(path: Path) -> dict[str, object]:
    """The first message of every topic, decoded by the mcap project's own decoder."""
    pytest.importorskip("mcap_protobuf", reason="mcap-protobuf-support is not installed")
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    found: dict[str, object] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, _, decoded in reader.iter_decoded_messages():
            assert schema is not None and schema.encoding == "protobuf"
            found.setdefault(channel.topic, decoded)
            found[f"schema {channel.topic}"] = schema.name
    return found


@needs_page
def test_every_path_of_the_page_is_in_a_file(car):
    (trial,) = car.glob("trials/t0001-*")
    values = _values(trial) | _values(car / "candidates" / "c0001.mcap")
    paths = _paths(PAGE.read_text())
    assert len(paths) > 12
    for path in paths:
        topic, _, field = path.partition(".")
        assert topic in values, path
        if field:
            name, _, index = field.rstrip("]").partition("[")
            value = getattr(values[topic], name)
            if index:
                value = value[int(index)]
            assert isinstance(value, float) or (path == "/policy.gain" and len(value)), path


@needs_page
def test_the_script_of_the_page_runs(car, tmp_path):
    pytest.importorskip("mcap_protobuf", reason="mcap-protobuf-support is not installed")
    (script,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (trial,) = car.glob("trials/t0001-*")
    (tmp_path / "trial.mcap").write_bytes(trial.read_bytes())
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) > 50


@pytest.mark.parametrize(
    ("module", "words", "extra"),
    [
        ("rerun", ("report", "--rrd"), "view"),
        ("rerun", ("view",), "view"),
        ("jinja2", ("report", "--html"), "report"),
    ],
)
def test_a_command_names_the_extra_that_it_needs(tmp_path, monkeypatch, module, words, extra):
    make(tmp_path / "w")
    monkeypatch.setitem(sys.modules, module, None)
    done = grounded("-C", tmp_path / "w", *words)
    assert done.code == 1 and f"'.[{extra}]'" in done.err
    assert "Traceback" not in done.err and done.err.count("\n") == 1


def test_nothing_is_written_where_an_extra_is_missing(tmp_path, monkeypatch):
    make(tmp_path / "w")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    done = grounded("-C", tmp_path / "w", "report", "--html", "--png")
    assert done.code == 1 and not (tmp_path / "w" / "reports" / "report.html").exists()


def test_a_picture_names_the_extra_that_it_needs(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(GroundedError, match=r"\.\[png\]"):
        png(Figure("utility", "Utility", "", ()))


def test_what_is_there_is_imported():
    assert needs("json", "all") is sys.modules["json"]
    with pytest.raises(GroundedError, match=r"no_such_module.*\.\[all\]"):
        needs("no_such_module", "all")


@pytest.mark.parametrize(
    ("module", "never"),
    [
        ("grounded_trials.report.page", ("grounded.diagnosis.likelihood", "grounded.effects")),
        (
            "grounded_trials.workspace.candidates.proposing",
            ("grounded.diagnosis", "grounded.search.improve"),
        ),
        (
            "grounded.search.improve",
            ("grounded.search.first_policy",),
        ),
    ],
)
def test_a_command_imports_what_it_needs(module, never):
    code = f"import sys, {module}; print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not [name for name in found.stdout.split() if name.startswith(never)]
