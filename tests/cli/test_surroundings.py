"""Where a command runs: on a terminal of 80 columns, at the TAB key, without what Windows lacks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time

import pytest

from cli import process
from grounded_cli.commands import cli
from grounded_cli.console import terminal
from grounded_cli.console.terminal import field, harmless, table


def test_a_wide_table_breaks_the_names_of_its_columns():
    names = ("manoeuvre", *(f"improvement with scatter, level {k}" for k in range(6)))
    rows = [("turn", *["98.9 % ± 0.1"] * 6)]
    text = harmless(table(rows, names))
    lines = text.splitlines()
    assert max(map(len, lines)) <= 110 and len(lines) > 2
    assert lines[-1].split()[0] == "turn" and "manoeuvre" in lines[-2]
    narrow = table([("turn", *["98.9 %"] * 4)], names[:5])
    assert max(map(len, harmless(narrow).splitlines())) <= 80


@pytest.mark.parametrize("columns", [60, 72, 80])
def test_a_table_is_as_wide_as_the_terminal(monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    rows = [("delay:steering+throttle", "1,348", "d = 0.0179 +- 6.3e-05 s, k = 0.2 m/s")]
    text = harmless(table(rows * 2, ("effect", "evidence [nats]", "its value after the fit")))
    assert max(map(len, text.splitlines())) <= columns
    assert "0.0179 +- 6.3e-05 s," in text  # a number keeps its spread and its unit
    wide = harmless(table([("state", *["0.1234567"] * 9)] * 2, [f"name{k}" for k in range(10)]))
    assert max(map(len, wide.splitlines())) <= columns and wide.count("state") > 2
    assert max(map(len, field("gap", "1.5 m off " * 30).splitlines())) <= columns


def test_a_long_command_says_its_stage_in_a_log_too_now_and_then(capsys, monkeypatch):
    monkeypatch.setattr(terminal, "EVERY", 0.5)
    with terminal.stages() as tell:
        tell("fitting")
        tell("comparing effects, 40 %")
        time.sleep(0.8)  # also while nothing is told: `next` was silent for four minutes
        tell("")
        time.sleep(0.6)
    assert capsys.readouterr().err == "comparing effects, 40 % ...\n"


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


LACKS = {
    "os": "fork O_NOFOLLOW O_NONBLOCK O_CLOEXEC O_DIRECTORY getuid fchmod sched_getaffinity",
    "signal": "SIGPROF setitimer",
    "select": "poll",
}
SITE = f"""import builtins, filelock, os, select, signal, subprocess, sys, threading, types
whole = types.SimpleNamespace(**vars(os))  # these are other ones there
for name, module in [*sys.modules.items()]:
    if name.startswith("filelock") and hasattr(module, "os"):
        module.os = whole
for module, names in {LACKS!r}.items():
    for name in names.split():
        delattr(sys.modules[module], name)
plain = builtins.__import__
def without(name, *args, **kwargs):
    if name in ("resource", "pwd", "grp", "termios"):
        raise ImportError(name)
    return plain(name, *args, **kwargs)
builtins.__import__ = without
"""


@pytest.fixture
def grounded(tmp_path):
    (tmp_path / "sitecustomize.py").write_text(SITE)
    path = os.pathsep.join([str(tmp_path), *sys.path])
    strict = {"PYTHONPATH": path, "PYTHONWARNDEFAULTENCODING": "1"}

    def run(*words):
        code = "from grounded_cli.start import main; main()"
        command = [sys.executable, "-W", "error::EncodingWarning:grounded", "-c", code, *words]
        env = {**os.environ, **strict}
        done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_a_search_goes_round(grounded, tmp_path):
    grounded("init", "--example", "pendulum", "w")
    grounded("-C", "w", "propose")
    grounded("-C", "w", "run")
    (log,) = (tmp_path / "w" / "runs").iterdir()
    grounded("-C", "w", "ingest", str(log))
    assert json.loads(grounded("-C", "w", "status", "--json"))["trials"] == 1
    grounded("-C", "w", "export", "best", "--runner")
    grounded("inspect", str(log))
