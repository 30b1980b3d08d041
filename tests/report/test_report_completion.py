"""The TAB key: commands, candidates, trials and effects, quickly and from names alone."""

from __future__ import annotations

import shutil
import subprocess
import sys

import click
import pytest

from cli import grounded, process
from grounded_cli.console import completion
from grounded_cli.main import COMMANDS, cli
from reported import cart

__all__ = ["cart"]


def _asked(words: str, cwd=None) -> list[str]:
    count = len(words.split(" ")) - 1
    env = {"COMP_WORDS": words, "COMP_CWORD": str(count), "_GROUNDED_COMPLETE": "bash_complete"}
    done = process(cwd=cwd, **env)
    assert done.err == ""
    return [line.split(",", 1)[1] for line in done.out.split()]


def test_commands_and_their_options():
    assert _asked("grounded re") == ["restore", "report", "recover"]
    assert set(COMMANDS) <= set(_asked("grounded "))
    assert {"--html", "--png", "--rrd"} <= set(_asked("grounded report --"))


def _context(folder) -> click.Context:
    """As the shell's TAB key makes it, with -C before the command."""
    return cli.make_context("grounded", ["-C", str(folder), "export"], resilient_parsing=True)


def test_candidates_trials_and_effects(cart, tmp_path):
    ctx = _context(cart)
    param = click.Argument(["x"])

    def names(items):
        return [item.value for item in items]

    assert names(completion.candidates(ctx, param, ""))[:3] == ["best", "c0001", "c0002"]
    assert names(completion.candidates(ctx, param, "c0002")) == ["c0002"]
    assert names(completion.trials(ctx, param, "t000"))[0] == "t0001"
    assert names(completion.effects(ctx, param, "visc")) == ["viscous_friction:v"]
    assert "car-turn" in names(completion.examples(ctx, param, "car"))
    ctx = _context(tmp_path)
    assert names(completion.trials(ctx, param, "")) == []
    assert names(completion.effects(ctx, param, "")) == []
    (tmp_path / "reports").mkdir()
    (tmp_path / "reports" / "diagnosis.json").write_text("nonsense")
    assert names(completion.effects(ctx, param, "")) == []


@pytest.mark.parametrize("shell", completion.SHELLS)
def test_scripts_are_valid(shell):
    done = grounded("completion", shell)
    assert done.code == 0 and "_GROUNDED_COMPLETE" in done.out
    if shutil.which(shell):
        checked = subprocess.run([shell, "-n"], input=done.out, text=True, capture_output=True)
        assert checked.returncode == 0, checked.stderr


def test_an_unknown_shell_is_a_usage_error():
    assert grounded("completion", "tcsh").code == 2


def test_completion_imports_little():
    script = """
import os, sys
os.environ |= {"COMP_WORDS": "grounded re", "COMP_CWORD": "1"}
os.environ["_GROUNDED_COMPLETE"] = "bash_complete"
from grounded_cli.main import main
try:
    main()
except SystemExit:
    pass
heavy = {"numpy", "rerun", "mcap"} & set(sys.modules)
sys.exit(str(heavy) if heavy else 0)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "plain,report" in done.stdout
