"""docs/foxglove.md: every path that it tells people to plot is in the files; its script runs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from cli import grounded
from workspaces import make

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
