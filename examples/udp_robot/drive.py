"""Drive the robot: by hand along a sine, or a candidate with the one-file runner.

    python drive.py --manual 20 BAG          20 s of driving, recorded
    python drive.py CANDIDATE TRIAL          what `grounded run` calls

The loop runs at the candidate's own rate on the latest state, however old. It never waits for a
lost packet. If the computer stops the loop for longer than a step, the last command is held.
Ctrl-C sends the kill command.
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
    """Record, drive, and copy the recording to where the caller wants it."""
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
            recorder.stdout.readline()  # wait until it listens
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
    """Return dt and a function of (t, state) that gives the inputs at t, None at the end."""

    def action(t, state):
        if t > seconds:
            return None
        return 0.3 * math.sin(1.1 * t), 0.9 + 0.5 * math.sin(0.5 * t)

    return 0.02, action


def by_candidate(candidate, room):
    """Return the same for a candidate, exported with its runner as for a real robot."""
    identity = candidate.stem
    words = ["export", identity, "--runner", "-o", str(room / "policy.npz")]
    workspace = str(candidate.parents[1])
    program = [sys.executable, "-c", "from grounded_cli.main import main; main()", "-C", workspace]
    subprocess.run([*program, *words], check=True, stdout=subprocess.DEVNULL)  # for a person
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
    """Reset, wait for a state, then send commands until `action` returns None."""
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
            now += dt * (1 + late // dt)  # missed steps are skipped
            time.sleep(max(0.0, now - time.time()))
        send(line, {"t": now, "steering": 0.0, "speed": 0.0})
        time.sleep(0.1)
    except BaseException:
        send(line, {"kill": True})
        raise
    finally:
        line.close()


def newest(line, state):
    """Return the latest state received, or `state` if there is none."""
    while True:
        try:
            state = json.loads(line.recv(4096))
        except BlockingIOError:
            return state


def send(line, command):
    """Send a command to the robot, and to the recorder unless it is a reset or kill."""
    packet = json.dumps(command).encode()
    for port in (COMMANDS, RECORDER) if "speed" in command else (COMMANDS,):
        line.sendto(packet, (HOST, port))


if __name__ == "__main__":
    main()
