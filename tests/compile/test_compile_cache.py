"""The kernel cache: found again, never trusted when damaged, bounded, safe between processes."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from grounded.compile.run import jit
from problems import system
from shared_data import SUPPORT


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("GROUNDED_CACHE", str(tmp_path / "kernels"))
    return tmp_path / "kernels"


def kernels(home):
    return sorted(home.glob("*.kernel"))


def run():
    made, p = system("pendulum")
    return made.step(np.array([[0.3, -0.2]]), np.array([[0.1]]), p, 0.05)


def test_compiles_once(home, monkeypatch):
    first = run()
    assert len(kernels(home)) == 1

    def never(*args):
        raise AssertionError("compiled again")

    monkeypatch.setattr("grounded.compile.run.compiled.Kernels.text", never)
    assert np.array_equal(run(), first)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: data[: len(data) // 2],
        lambda data: data[:-1] + bytes([data[-1] ^ 1]),
        lambda data: b"something else entirely",
        lambda data: jit.MAGIC + bytes(32) + data[50:],
    ],
)
def test_damaged_entries_are_replaced(home, damage):
    first = run()
    path = kernels(home)[0]
    good = path.read_bytes()
    path.write_bytes(damage(good))
    assert np.array_equal(run(), first)
    assert path.read_bytes() == good


def test_a_file_under_another_name_is_foreign(home):
    jit.store("a" * 64, b"code")
    (home / f"{'b' * 64}.kernel").write_bytes((home / f"{'a' * 64}.kernel").read_bytes())
    assert jit.stored("a" * 64) == b"code"
    assert jit.stored("b" * 64) is None and jit.stored("c" * 64) is None


def test_size_is_bounded_and_the_oldest_go(home, monkeypatch):
    monkeypatch.setattr(jit, "MAX_BYTES", 1000)
    for i in range(5):
        jit.store(str(i) * 64, bytes(300))
        os.utime(home / f"{str(i) * 64}.kernel", (i, i))
    jit.stored("3" * 64)  # used last
    jit.store("9" * 64, bytes(300))
    left = [path.name[0] for path in kernels(home)]
    assert "3" in left and "0" not in left and len(left) <= 3
    assert not list(home.glob("*.part"))


def test_no_cache_and_unwritable_cache_still_work(monkeypatch, tmp_path):
    monkeypatch.setenv("GROUNDED_CACHE", "")
    assert jit.folder() is None
    first = run()
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("GROUNDED_CACHE", str(blocked))
    assert np.array_equal(run(), first)


def test_folder_follows_the_users_settings(monkeypatch):
    monkeypatch.delenv("GROUNDED_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "/some/where")
    if sys.platform == "linux":
        assert jit.folder() == Path("/some/where/grounded")
        monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # to be ignored, says the XDG rule
        assert jit.folder() == Path.home() / ".cache" / "grounded"


def test_processes_share_the_folder(home):
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import numpy as np\nfrom problems import system\n"
        "made, p = system('pendulum')\n"
        "print(made.step(np.array([[0.3, -0.2]]), np.array([[0.1]]), p, 0.05).tobytes().hex())"
    )
    here = SUPPORT
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    running = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(here)],
            stdout=subprocess.PIPE,
            env=environment,
            text=True,
        )
        for _ in range(4)
    ]
    results = {process.communicate()[0] for process in running}
    assert len(results) == 1 and all(process.returncode == 0 for process in running)
    assert len(kernels(home)) == 1 and not list(home.glob("*.part"))
