"""What imports nothing: the TAB key, `--help`, a misuse."""

from __future__ import annotations

import subprocess
import sys

import pytest

from cli import process
from grounded_cli.commands import cli


def _asked(words: str, cwd=None) -> list[str]:
    count = len(words.split(" ")) - 1
    env = {"COMP_WORDS": words, "COMP_CWORD": str(count), "_GROUNDED_COMPLETE": "bash_complete"}
    done = process(cwd=cwd, **env)
    assert done.err == ""
    return [line.split(",", 1)[1] for line in done.out.split()]


def test_commands_and_their_options():
    assert _asked("grounded re") == ["restore", "report", "recover"]
    assert set(cli.commands) <= set(_asked("grounded "))
    assert {"--html", "--png", "--rrd"} <= set(_asked("grounded report --"))


@pytest.mark.parametrize(
    ("words", "env"),
    [
        (
            [],
            {"COMP_WORDS": "grounded re", "COMP_CWORD": "1", "_GROUNDED_COMPLETE": "bash_complete"},
        ),
        (["status", "--help"], {}),
        (["fit", "--jobs", "0"], {}),
    ],
)
def test_what_runs_no_command_imports_little(words, env):
    script = f"""
import os, sys
os.environ |= {env!r}
sys.argv = ["grounded", *{words!r}]
from grounded_cli.main import main
try:
    main()
except SystemExit:
    pass
heavy = {{"numpy", "rerun", "mcap", "grounded_trials.door"}} & set(sys.modules)
sys.exit(str(heavy) if heavy else 0)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
