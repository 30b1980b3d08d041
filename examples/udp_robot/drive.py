"""Drives the robot: by hand along a sine, or a candidate by the one-file runner.

    python drive.py --manual 20 BAG          20 s of driving, recorded
    python drive.py CANDIDATE TRIAL          what `grounded run` calls

The loop runs at the candidate's own rate on the state that came last, however late; a lost packet
means that the state is older, never that the loop waits. Where the computer stops it for longer
than a step, the last command holds meanwhile. Ctrl-C sends the kill command.
"""

import json
import math
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from robot import COMMANDS, DRIVER, HOST, RECORDER

HERE = Path(__file__).parent


def main():
    """Records, drives, and hands the recording over."""
    manual = sys.argv[1] == "--manual"
    seconds = float(sys.argv[2]) if manual else 0.0
    target = Path(sys.argv[-1])
    with tempfile.TemporaryDirectory() as room:
        bag = Path(room) / "bag"
        steer = by_hand(seconds) if manual else by_candidate(Path(sys.argv[1]), Path(room))
        recorder = subprocess.Popen(
            [sys.executable, HERE / "record.py", bag], stdout=subprocess.PIPE, text=True
        )
        try:
            recorder.stdout.readline()  # it listens
            drive(*steer)
        finally:
            recorder.terminate()
            recorder.wait()
            recorder.stdout.close()
        if manual:
            shutil.copytree(bag, target)
        else:
            shutil.copy(next(bag.glob("*.mcap")), target)


def by_hand(seconds):
    """The control interval, and what a person would do at time t, None at the end."""

    def action(t, state):
        if t > seconds:
            return None
        return 0.3 * math.sin(1.1 * t), 0.9 + 0.5 * math.sin(0.5 * t)

    return 0.02, action


def by_candidate(candidate, room):
    """The same of a candidate, exported with its runner as one would for the robot."""
    identity = candidate.stem
    words = ["export", identity, "--runner", "-o", str(room / "policy.npz")]
    workspace = str(candidate.parents[1])
    program = [sys.executable, "-c", "from grounded_cli.main import main; main()", "-C", workspace]
    subprocess.run([*program, *words], check=True, stdout=sys.stderr)
    sys.path.insert(0, str(room))
    from grounded_runner import load

    names = ("v", "x", "y", "psi")
    runner = load(room / "policy.npz", states=names)

    def action(t, state):
        if runner.done(t):
            return None
        return runner.action(t, [state[name] for name in names])

    return runner.policy.dt, action


def drive(dt, action):
    """The loop: reset, wait for a state, then act until `action` says that it is over."""
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    line.bind((HOST, DRIVER))
    line.setblocking(False)
    send(line, {"reset": True})
    time.sleep(0.3)
    newest(line, None)
    state = None
    while state is None:
        state = newest(line, None)
        time.sleep(0.002)
    start = now = time.time()
    try:
        while True:
            state = newest(line, state)
            found = action(now - start, state)
            if found is None:
                break
            send(line, {"t": now, "steering": float(found[0]), "speed": float(found[1])})
            late = max(0.0, time.time() - now - dt)
            now += dt * (1 + late // dt)  # steps that were missed are not made up for
            time.sleep(max(0.0, now - time.time()))
        send(line, {"t": now, "steering": 0.0, "speed": 0.0})
        time.sleep(0.1)
    except BaseException:
        send(line, {"kill": True})
        raise
    finally:
        line.close()


def newest(line, state):
    """The state that came last, `state` where none did."""
    while True:
        try:
            state = json.loads(line.recv(4096))
        except BlockingIOError:
            return state


def send(line, command):
    """To the robot; commands to the recorder as well."""
    packet = json.dumps(command).encode()
    for port in (COMMANDS, RECORDER) if "speed" in command else (COMMANDS,):
        line.sendto(packet, (HOST, port))


if __name__ == "__main__":
    main()
