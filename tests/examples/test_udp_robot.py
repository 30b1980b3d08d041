"""The stand-in for hardware: another process, lost packets, its own recorder, a kill switch."""

import json
import os
import socket
import subprocess
import sys
import time
from contextlib import closing
from operator import sub
from pathlib import Path

import pytest
from mcap.reader import make_reader

from cli import grounded
from grounded_trials import Workspace

HERE = Path(__file__).parents[2] / "examples" / "udp_robot"
ROOTS = [str(HERE.parents[1] / part) for part in ("", "trials", "cli")]
PORT = 9310
BEARABLE = 0.075  # [s]: two lost packets in a row take 0.06; five steps are all that is bridged
ATTEMPTS = 4


@pytest.fixture
def robot():
    process = subprocess.Popen([sys.executable, HERE / "robot.py", "--seed", "3"])
    time.sleep(0.5)
    yield process
    process.terminate()
    process.wait()


def drive(*words):
    path = os.pathsep.join([*ROOTS, os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, HERE / "drive.py", *map(str, words)]
    subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": path})


class Stopped(Exception):
    """This computer stopped robot, driver or recorder for longer than they bear."""


def unless_stopped(log):
    """Raises where messages of a topic arrived farther apart than lost packets explain."""
    arrived = {}
    with log.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            arrived.setdefault(channel.topic, []).append(message.log_time / 1e9)
    gap = max(max(map(sub, times[1:], times)) for times in arrived.values())
    if gap > BEARABLE:
        raise Stopped(f"{gap:.2f} s in {log.name}")


def in_real_time(attempt):
    """An attempt that this computer did not stop; skips where each of a few was."""
    for k in range(ATTEMPTS):
        try:
            return attempt(k)
        except Stopped as error:
            stopped = error
    pytest.skip(
        f"this computer is too busy for a test in real time: programs stood still {stopped}"
    )


@pytest.mark.slow
def test_from_manual_driving_to_trials_of_a_policy(robot, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(ROOTS))
    in_real_time(lambda k: from_manual_driving_to_trials(tmp_path / str(k)))


def from_manual_driving_to_trials(room):
    room.mkdir()
    log, w = room / "bag", room / "car"
    drive("--manual", 6, log)
    unless_stopped(next(log.glob("*.mcap")))
    made = grounded("init", w, "--from", log, "--model", HERE / "model.py", "--json").json
    paths = {one["name"]: one["path"] for one in made["signals"]}
    assert paths["v"] == "/odom.twist.twist.linear.x"
    assert paths["speed"] == "/drive.twist.linear.x" and paths["steering"].endswith("angular.z")
    assert grounded("-C", w, "ingest", "--data", log).code == 0
    assert grounded("-C", w, "target", "circle", "--speed", 1.2, "--size", 1).code == 0
    program = f"{sys.executable} {HERE}/drive.py {{candidate}} {{trial}}"
    kept = f"cp {{trial}} {room}/$$.mcap"
    with (w / "grounded.toml").open("a") as file:
        file.write(f"\n[system]\ncommand = \"sh -c '{program} && {kept}'\"\n")
    done = grounded("-C", w, "learn", "--trials", 2, "--json")
    for recorded in room.glob("*.mcap"):
        unless_stopped(recorded)
    assert done.code == 0, done.err
    ran = [t.trial.candidate for t in Workspace(w).trials()]
    assert ran[:2] == ["", "c0001"] and len(ran) == 3
    assert "its commands are not" not in done.err + done.out  # though packets were lost


@pytest.mark.slow
def test_the_kill_switch_holds_until_a_reset(robot):
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as line:
        line.bind(("127.0.0.1", PORT + 1))
        in_real_time(lambda _: the_kill_switch_holds(line))


def the_kill_switch_holds(line):
    gaps = [0.0]
    line.settimeout(1)

    def say(seconds, **command):
        heard = time.time()
        end = heard + seconds
        while time.time() < end:  # a packet may be lost
            line.sendto(json.dumps(command).encode(), ("127.0.0.1", PORT))
            state = json.loads(line.recv(4096))
            gaps.append(time.time() - heard)
            heard = time.time()
        if max(gaps) > BEARABLE:
            raise Stopped(f"{max(gaps):.2f} s")
        return state

    say(0.1, reset=True)
    moving = say(0.6, speed=1.0, steering=0.0)
    killed = say(0.8, kill=True)
    still = say(0.5, speed=1.0, steering=0.0)
    say(0.1, reset=True)
    again = say(0.6, speed=1.0, steering=0.0)
    assert moving["v"] > 0.3
    assert killed["killed"] and killed["v"] < 0.1 and still["v"] < 0.1
    assert not again["killed"] and again["v"] > 0.3
    time.sleep(0.9)  # nothing is heard: the watchdog stops it
    while True:
        try:
            line.settimeout(0.05)
            state = json.loads(line.recv(4096))
        except TimeoutError:
            break
        if time.time() - state["t"] < 0.05:
            break
    assert state["v"] < 0.3
