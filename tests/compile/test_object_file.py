"""Cached kernels load without LLVM, and are left to it where they are not what is known here."""

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

HERE = sys.platform == "linux" and platform.machine() == "x86_64"
here = pytest.mark.skipif(not HERE, reason="only x86-64 Linux loads kernels without LLVM")
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
def test_a_warm_process_does_not_import_llvm(tmp_path: Path) -> None:
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import numpy as np\nfrom problems import system\n"
        "made, p = system('pendulum')\n"
        "made.step(np.array([[0.3, -0.2]]), np.array([[0.1]]), p, 0.05)\n"
        "print(made.how, 'llvmlite.binding' in sys.modules)"
    )
    environment = os.environ | {"GROUNDED_CACHE": str(tmp_path / "cache")}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    command = [sys.executable, "-c", code, str(SUPPORT)]
    said = [
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    assert [line.split() for line in said] == [["compiled", "True"], ["compiled", "False"]]


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
