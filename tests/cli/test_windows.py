"""The loop without what Windows lacks: forks, resource limits, signals, modes of files and users.

Paths and line ends of Windows itself need one: `.github/workflows/windows.yml`.
"""

import json
import os
import subprocess
import sys

import pytest

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
