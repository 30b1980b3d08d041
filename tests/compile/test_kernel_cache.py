"""The kernel cache: found again, never trusted when damaged, bounded, loaded without LLVM."""

import os
import platform
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from grounded.compile.run import jit, object_file
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


CODE = """
import sys
import numpy as np
from problems import system
made, p = system("pendulum")
said = made.step(np.array([[0.3, -0.2]]), np.array([[0.1]]), p, 0.05).tobytes().hex()
print(said, made.how, "llvmlite.binding" in sys.modules)
"""


def started():
    """Another process that steps a pendulum."""
    path = os.pathsep.join(filter(None, [str(SUPPORT), *sys.path]))
    return subprocess.Popen(
        [sys.executable, "-c", CODE],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": path},
        text=True,
    )


def test_processes_share_the_folder(home):
    running = [started() for _ in range(4)]
    results = {process.communicate()[0].split()[0] for process in running}
    assert len(results) == 1 and all(process.returncode == 0 for process in running)
    assert len(kernels(home)) == 1 and not list(home.glob("*.part"))


HERE = sys.platform == "linux" and platform.machine() == "x86_64"


here = pytest.mark.skipif(not HERE, reason="only x86-64 Linux loads kernels without LLVM")


@here
def test_a_warm_process_does_not_import_llvm(home):
    said = [started().communicate()[0].split()[1:] for _ in range(2)]
    assert said == [["compiled", "True"], ["compiled", "False"]]


TEXT = """
@table = internal constant [3 x double] [double 1.0, double 2.0, double 4.0]
declare double @cbrt(double)
define i64 @run(ptr %words) {
  %x = load double, ptr %words
  %i = fptosi double %x to i64
  %at = getelementptr double, ptr @table, i64 %i
  %known = load double, ptr %at
  %root = call double @cbrt(double %known)
  %sum = fadd double %root, 0.1
  store double %sum, ptr %words
  ret i64 7
}
"""


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], tuple[bytes, jit.Library]]:
    """Compiles a text: its object file, and its function as LLVM's own loader has it."""

    def both(text: str) -> tuple[bytes, jit.Library]:
        seen: list[bytes] = []
        with monkeypatch.context() as patch:
            patch.setenv("GROUNDED_CACHE", "")
            patch.setattr(jit, "load", seen.append)
            library = jit.library("a test", lambda: text, ("run",))
        return seen[0], library

    return both


def called(library: jit.Library, x: float) -> tuple[int, float]:
    words = np.array([x])
    status = library["run"](words.ctypes.data)
    return status, float(words[0])


@here
@pytest.mark.parametrize("x", [0.0, 1.0, 2.0])
def test_code_constants_and_calls_of_the_c_library_are_found(built, x: float) -> None:
    code, by_llvm = built(TEXT)
    own = jit.Library(object_file.load(code), ("run",))
    assert called(own, x) == called(by_llvm, x)
    assert called(own, x) == (7, pytest.approx(2.0 ** (x / 3) + 0.1, abs=1e-15))


@here
def test_what_is_not_known_is_left_to_llvm(built, monkeypatch: pytest.MonkeyPatch) -> None:
    code, _ = built(TEXT)
    assert object_file.load(b"") is None
    assert object_file.load(b"\x7fELF" + bytes(100)) is None
    assert object_file.load(code.replace(b"cbrt", b"cbrq")) is None  # no such function
    with monkeypatch.context() as other:
        other.setattr(object_file, "RELATIVE", -1)
        other.setattr(object_file, "ABSOLUTE", -1)
        assert object_file.load(code) is None  # a kind of relocation
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    assert object_file.load(code) is None


@here
def test_kernels_give_the_same_through_both_loaders(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)

    def derivatives() -> list[np.ndarray]:
        made, p = system("car")
        x, u = rng.normal(size=(50, made.n)), rng.normal(size=(50, made.m))
        return [made.step(x, u, p, 0.02), *made.linearise(x, u, p, 0.02)]

    own = derivatives()
    rng = np.random.default_rng(0)
    monkeypatch.setattr(jit, "load", lambda code: None)
    for mine, theirs in zip(own, derivatives(), strict=True):
        assert np.array_equal(mine, theirs, equal_nan=True)


@here
def test_code_that_writes_to_its_own_memory_is_left_to_llvm(built) -> None:
    text = """
@calls = internal global i64 0
define i64 @run(ptr %words) {
  %old = load i64, ptr @calls
  %new = add i64 %old, 1
  store i64 %new, ptr @calls
  ret i64 %new
}
"""
    assert object_file.load(built(text)[0]) is None
