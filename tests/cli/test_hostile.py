"""Terminals, pipes, devices, strangers' code: what file, shell or model may do to a command."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from itertools import cycle
from pathlib import Path

import pytest

from bombs import log
from cli import COMMAND, grounded, process
from facts import holding
from grounded.compile.run import jit
from grounded.errors import GroundedError
from grounded.trusted import TRUST, check_own, suspicion
from grounded_cli import main
from grounded_cli.console.terminal import harmless, show, show_json, style, table
from grounded_trials.store.store import Store, write_atomically
from pace import crowding, slowness
from user_code import DEEDS, HARMLESS, PLACES
from workspaces import MODEL, make

EVIL = "\x1b]0;title\x07\x1b[8m\x9b2J\u202e\u200b\r"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make(tmp_path / "w").folder


def test_control_characters_of_a_file_do_not_reach_the_terminal(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    data = log("json", None, [b"{}"]).replace(b"/t", b"\x1b[")
    path.write_bytes(data.replace(b"json", b"\x1b[8m"))
    for words in (["inspect", str(path)], ["recover", str(path)], ["ingest", f"{tmp_path}/{EVIL}"]):
        done = grounded(*words)
        shown = (done.out + done.err).replace("\n", "")
        assert shown.isprintable(), repr(shown)


def test_output_is_printable_and_json_is_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    show(EVIL + "\ud800")
    assert "".join(capsys.readouterr().out.split("\n")).isprintable()
    show_json({EVIL: ["\ud800", "größe 🤖"]})
    text = capsys.readouterr().out
    assert "".join(text.split("\n")).isprintable()
    assert json.loads(text) == {EVIL: ["\ud800", "größe 🤖"]}
    assert table([("a\nnext: rm", "1")], ("x", "y")).count("\n") == 1


def test_our_own_marks_colour_only_a_terminal() -> None:
    assert harmless(style("a")) == "a" and harmless("\x1b[1ma") == "?[1ma"
    assert harmless(style("a"), coloured=True) == "\x1b[1ma\x1b[0m"


@pytest.mark.parametrize(
    ("name", "what"),
    [
        *((name, "pipe") for name in ("target.csv", "log.mcap")),
        ("log.mcap", "device"),
        ("model.py", "folder"),
    ],
)
def test_what_is_no_file_is_refused_at_once(what: str, name: str, folder: Path) -> None:
    path = folder / name
    path.unlink(missing_ok=True)
    if what == "pipe":
        os.mkfifo(path)
    elif what == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    began = time.monotonic()
    words = ["ingest", str(path)] if name == "log.mcap" else ["propose"]
    done = process("-C", str(folder), *words)
    assert done.code == 1 and "Traceback" not in done.err and name in done.err, done.err
    assert time.monotonic() - began < 60  # by the clock: a busy machine starts a process in ten


def test_a_link_is_no_stored_file(tmp_path: Path) -> None:
    store = Store(tmp_path / "trials")
    entry = store.add(b"content")
    moved = tmp_path / "elsewhere"
    entry.path.rename(moved)
    entry.path.symlink_to(moved)
    with pytest.raises(GroundedError, match="link"):
        store.read(entry.path.name)
    assert len(store.verify()) == 1


@pytest.mark.parametrize(("place", "mode"), [("model.py", 0o777), (".", 0o775)])
def test_code_that_others_may_change_is_not_executed(place: str, mode: int, folder: Path) -> None:
    (folder / "__pycache__").mkdir(exist_ok=True)
    marker = folder / "executed"
    source = (folder / "model.py").read_text()
    (folder / "model.py").write_text(f"open({str(marker)!r}, 'w')\n" + source)
    os.chown(folder / place, -1, 12345 if os.getuid() == 0 else -1)
    (folder / place).chmod(mode)
    if mode == 0o775 and not suspicion(folder / place):
        pytest.skip("the group is the user's private one")
    done = grounded("-C", folder, "propose")
    assert done.code == 1 and "writable by" in done.err and "chmod" in done.err
    assert not marker.exists()


def test_a_stranger_s_file_is_not_executed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if os.getuid() != 0:
        pytest.skip("only root gives files away")
    os.chown(folder / "model.py", 12345, -1)
    with pytest.raises(GroundedError, match=holding(folder / "model.py", 12345)):
        check_own(folder, [folder / "model.py"])
    monkeypatch.setenv(TRUST, str(folder.parent))
    check_own(folder, [folder / "model.py"])


@pytest.mark.parametrize("open_to_all", ["nothing", "the folder", "the file"])
def test_a_kernel_cache_that_others_may_write_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, open_to_all: str
) -> None:
    monkeypatch.setenv("GROUNDED_CACHE", str(tmp_path / "made"))
    jit.store("0" * 64, b"code")
    cache = Path(shutil.copytree(tmp_path / "made", tmp_path / "cache"))  # not looked at before
    monkeypatch.setenv("GROUNDED_CACHE", str(cache))
    places = {"nothing": [], "the folder": [cache], "the file": [*cache.glob("*.kernel")]}
    for place in places[open_to_all]:
        place.chmod(0o777)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = jit.stored("0" * 64)
    assert found == (b"code" if open_to_all == "nothing" else None)
    assert [str(cache) in str(one.message) for one in told] == [True] * (open_to_all != "nothing")


SHELL = " ".join(f"'{word}'" for word in COMMAND)


@pytest.mark.parametrize(
    ("how", "code"),
    [
        ("--help | true", 0),
        ("{status} | true", 0),
        ("{status} 2>&-", 0),
        ("{status} >/dev/full", 1),
        ("nothing 2>/dev/full", 1),
    ],
)
def test_closed_and_full_outputs(how: str, code: int, folder: Path) -> None:
    words = how.format(status=f"-C {folder} status")
    line = f"set -o pipefail; {SHELL} {words}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr


@pytest.mark.parametrize("told", [False, True])
def test_an_interrupt_while_a_module_is_imported_is_one(
    told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def imported(**_: object) -> None:
        try:  # as Python 3.11 raises it from a class, and a module in C from its start
            raise RuntimeError("Error calling __set_name__ on 'Field'") from KeyboardInterrupt()
        except RuntimeError:
            if told:
                raise GroundedError("this needs the package 'mujoco'") from None
            raise

    monkeypatch.setattr(main.cli, "main", imported)
    assert grounded("status").code == 130


@pytest.mark.slow
def test_an_interrupt_at_any_moment_leaves_no_traceback(folder: Path) -> None:
    start = "from grounded_cli.start import main; main()"
    for k in range(0, 10, 3):
        child = subprocess.Popen(
            [sys.executable, "-X", "utf8", "-c", start, "-C", str(folder), "propose"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        time.sleep(0.05 + 0.1 * k)
        child.send_signal(signal.SIGINT)
        _, err = child.communicate()
        begun = any(part in err for part in (", in main\n", "grounded_cli/main.py"))
        if "Traceback" in err and not begun:
            continue  # Python's own start is out of our hands
        assert "Traceback" not in err, err
        assert child.returncode in (0, 130, -signal.SIGINT), (child.returncode, err)


@pytest.mark.slow
@pytest.mark.parametrize(("verb", "after"), [("diagnose", 1.5), ("diagnose", 3.0), ("fit", 1.5)])
def test_an_interrupt_ends_a_long_computation_soon(verb: str, after: float, car: Path) -> None:
    psutil = pytest.importorskip("psutil", reason="needs psutil")
    child = subprocess.Popen(
        [*COMMAND, "-C", str(car), verb],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    at_work = psutil.Process(child.pid)
    while child.poll() is None and sum(at_work.cpu_times()[:2]) < after:
        time.sleep(0.05)
    began = time.perf_counter()
    child.send_signal(signal.SIGINT)
    _, err = child.communicate()
    taken = time.perf_counter() - began
    assert child.returncode in (0, 130) and "Traceback" not in err, err  # 0: it had ended before
    assert taken < 2.0 * slowness() * max(crowding(), 2.0)


@pytest.mark.parametrize("words", [["learn"], ["report", "--html"], ["init", "new"]])
def test_a_read_only_folder_is_one_sentence(words: list[str], folder: Path) -> None:
    limited = ["setpriv", "--bounding-set", "-dac_override"] if os.getuid() == 0 else []
    if limited and not shutil.which("setpriv"):
        pytest.skip("root may write anywhere")
    assert grounded("-C", folder, "propose").code == 0
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    words = [*words, "--example", "pendulum"] if words[0] == "init" else ["-C", str(folder), *words]
    done = subprocess.run(
        [*limited, *COMMAND, *words], capture_output=True, text=True, check=False, cwd=folder
    )
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755)
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert done.returncode == 1 and len(errors) == 1 and "Traceback" not in done.stderr, done.stderr


def test_init_that_was_cut_off_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("init", tmp_path / "w", "--example", "pendulum")
    for count in range(4):
        done = 0

        def cut(path: Path, data: bytes, count: int = count) -> None:
            nonlocal done
            if done == count:
                raise KeyboardInterrupt
            done += 1
            write_atomically(path, data)

        monkeypatch.setattr("grounded_trials.starting.examples.write_atomically", cut)
        assert grounded(*words).code == 130
    monkeypatch.undo()
    assert grounded(*words).code == 0 and grounded("-C", tmp_path / "w", "status").code == 0
    assert "exists already" in grounded(*words).err
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "model.py").write_text("mine")
    assert "exists already" in grounded("init", tmp_path / "mine", "--example", "pendulum").err
    assert (tmp_path / "mine" / "model.py").read_text() == "mine"


@pytest.mark.parametrize("place", PLACES)
def test_what_a_model_prints_goes_to_stderr(tmp_path, place):
    deed = "\n".join(list(DEEDS.values())[:HARMLESS])
    make(tmp_path / "w", model=PLACES[place](MODEL, deed))
    done = process("-C", "w", "propose", "--json", cwd=tmp_path)
    assert done.code == 0 and done.json["candidate"] == "c0001"
    assert (tmp_path / "w" / "candidates" / "c0001.mcap").exists()
    assert "printed" in done.err and "written" in done.err


@pytest.mark.slow
@pytest.mark.parametrize(("deed", "place"), [*zip(list(DEEDS)[HARMLESS::2], cycle(PLACES))])
def test_whatever_a_model_raises_is_one_message(tmp_path, place, deed):
    make(tmp_path / "w", model=PLACES[place](MODEL, DEEDS[deed]))
    done = process("-C", "w", "propose", "--json", cwd=tmp_path)
    assert done.code == 1 and done.out == ""
    assert done.err.count("error: ") == 1 and "model.py" in done.err
    assert "Traceback" not in done.err
