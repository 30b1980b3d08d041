"""What a small install leaves out is said in one sentence, with the command that brings it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from cli import grounded
from grounded.errors import GroundedError, needs
from grounded.figures.figure import Figure
from grounded_trials.report.figures.png import png
from workspaces import make


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
