"""Where a command runs: 80 columns, the TAB key, without what Windows lacks; its JSON keys."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from cli import grounded, process
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
        (["--help"], {}),
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
heavy = {{"numpy", "scipy", "llvmlite", "rerun", "mcap", "grounded_trials.door"}} & set(sys.modules)
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
def without(tmp_path):
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


def test_a_search_goes_round(without, tmp_path):
    without("init", "--example", "pendulum", "w")
    without("-C", "w", "propose")
    without("-C", "w", "run")
    (log,) = (tmp_path / "w" / "runs").iterdir()
    without("-C", "w", "ingest", str(log))
    assert json.loads(without("-C", "w", "status", "--json"))["trials"] == 1
    without("-C", "w", "export", "best", "--runner")
    without("inspect", str(log))


PAGE = Path(__file__).resolve().parents[2] / "docs" / "json.md"


def documented(command):
    """The keys of the section that names a command."""
    for part in re.split(r"^## ", PAGE.read_text(), flags=re.M)[1:]:
        title, _, text = part.partition("\n")
        if command in title.split(", "):
            return re.findall(r"`([^`]+)`", "\n".join(re.findall(r"^\| (`.*?) \|", text, re.M)))
    raise AssertionError(f"docs/json.md has no section for {command}")


def unknown(command, document):
    """Paths of a document that the page does not name; what is empty has longer ones elsewhere."""
    keys = documented(command)
    known = [re.compile(_pattern(key) + r"(\[\])?(\.|$)") for key in keys]
    found = set(leaves(document))
    assert len(found) > 1
    return [p for p in found if not any(k.match(p) for k in known) and not _begun(p, keys)]


def _begun(path, keys):
    return any(key.startswith((f"{path}.", f"{path}[]")) for key in keys)


def _pattern(key):
    return re.escape(key).replace(r"\*", r"[^.]+").replace(r"\[\]", r"(\[\])?")


def leaves(value, at=""):
    """The paths of all numbers and texts: `where.channels[].rms`."""
    if isinstance(value, dict) and value:
        for key, item in value.items():
            yield from leaves(item, f"{at}.{key}".lstrip("."))
    elif isinstance(value, list) and value:
        for item in value:
            yield from leaves(item, at if isinstance(item, str | list) else f"{at}[]")
    else:
        yield at


LOG = "t,theta,omega,torque\n" + "".join(
    f"{k / 50:.3f},{np.sin(k / 9):.5f},{50 / 9 * np.cos(k / 9):.5f},{np.sign(k % 40 - 20)}\n"
    for k in range(200)
)
COMMANDS = [
    ("status",),
    ("report", "--html"),
    ("fit",),
    ("verify",),
    ("propose",),
    ("excite", "--seconds", "3"),
    pytest.param(("diagnose",), marks=pytest.mark.slow),
    ("discard", "t0002"),
    ("export", "best", "-o", "{folder}/best.npz", "--runner"),
    ("adopt", "viscous_friction:v"),
    ("export", "--model", "-o", "{folder}/found.py"),
    ("inspect", "{trial}"),
    ("ingest", "{trial}"),
    ("run", "best"),
    ("learn", "--trials", "1"),
    ("restore", "t0001"),
    ("target", "line", "--to", "x=1"),
    ("init", "{folder}/more", "--example", "pendulum"),
    ("init", "{folder}/more", "--from", "{log}"),
    ("init", "--list"),
    ("recover", "{trial}", "-o", "{folder}/saved.mcap"),
    ("explain", "log.unit"),
    ("init", "{folder}/more", "--blank", "--model", "{folder}/model.py"),
    ("next", "{trial}"),
]


@pytest.mark.parametrize("words", COMMANDS)
def test_every_key_is_documented(learnt, tmp_path, words):
    trial = next((learnt / "trials").glob("t0001*"))
    (log := tmp_path / "log.csv").write_text(LOG)
    fits(learnt, [word.format(folder=learnt, trial=trial, log=log) for word in words])


def test_what_follows_an_adoption_is_documented(learnt, tmp_path):
    assert grounded("-C", learnt, "adopt", "viscous_friction:v").code == 0
    fits(learnt, ["export", "--library", tmp_path / "actuator.yaml"])
    fits(learnt, ["adopt", "--undo"])


def fits(folder, words):
    """Check that the page names the keys of a command's document."""
    done = grounded("-C", folder, *words, "--json")
    assert done.code == 0, done.err
    assert not unknown(words[0], done.json)


def test_a_key_that_is_not_there_is_found():
    assert not unknown("fit", {"params": {"mass": {"value": 1.0, "std": 0.1}}})
    assert unknown("fit", {"params": {"mass": {"valu": 1.0, "std": 0.1}}}) == ["params.mass.valu"]
    assert list(leaves(json.loads('{"a": [{"b": 1}], "c": {}}'))) == ["a[].b", "c"]
