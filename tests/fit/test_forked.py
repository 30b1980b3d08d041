"""Pieces in copies of the process: the same results as alone, also if a copy fails in some way."""

import os
import signal
import time

import pytest

from grounded import forked
from grounded.engine import Engine, each, running

pytestmark = pytest.mark.skipif(not forked.possible(), reason="copies are made on Linux only")
HERE = os.getpid()


@pytest.fixture(autouse=True)
def always(monkeypatch):
    monkeypatch.setattr(forked, "WORTH_S", 1e-9)


@pytest.fixture(autouse=True)
def copies(monkeypatch):
    """The process ids of all copies, none of which is left after the test."""
    made, fork = [], os.fork

    def recorded():
        process = fork()
        made.append(process)
        return process

    monkeypatch.setattr(os, "fork", recorded)
    yield made
    for process in made:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


def slowly(i):
    time.sleep(0.02)
    return i, os.getpid()


@pytest.mark.parametrize("copied", [True, False])
def test_pieces_are_shared_and_come_back_in_order(copied):
    with running(Engine(3), copied=copied):
        found = each(lambda i: (time.sleep(0.1), *slowly(i))[1:], list(range(12)))
    assert [i for i, _ in found] == list(range(12))
    assert (len({process for _, process in found}) > 1) is copied  # a busy machine may start one


def killed(i):
    if os.getpid() != HERE:
        os.kill(os.getpid(), signal.SIGKILL)
    return slowly(i)


def unsendable(i):
    return (lambda: i) if os.getpid() != HERE else slowly(i)


def fails_there(i):
    if os.getpid() != HERE:
        raise ValueError(i)
    return slowly(i)


def hangs(i):
    if os.getpid() != HERE:
        time.sleep(60)
    return slowly(i)


@pytest.mark.parametrize("piece", [killed, unsendable, fails_there, hangs])
def test_what_a_copy_does_not_return_is_computed_here(piece, monkeypatch):
    monkeypatch.setattr(forked, "PATIENCE_S", 0.1)
    began, counted = time.monotonic(), []
    with running(Engine(2)):
        found = each(piece, list(range(6)), done=lambda: counted.append(1))
    assert found == [(i, HERE) for i in range(6)]
    assert len(counted) == 6
    assert time.monotonic() - began < 10


def test_ctrl_c_ends_the_copies(copies):
    def stop():
        if copies:
            raise KeyboardInterrupt

    with running(Engine(2)), pytest.raises(KeyboardInterrupt):
        each(slowly, list(range(50)), done=stop)
    assert copies


def test_without_processes_left_all_is_computed_here(monkeypatch):
    def refused():
        raise BlockingIOError("Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", refused)
    with running(Engine(3)):
        assert each(slowly, list(range(5))) == [(i, HERE) for i in range(5)]
