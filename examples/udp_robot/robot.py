"""A robot in another process: a small car behind UDP, with jitter, lost packets, a kill switch.

It stands in for hardware: it does not import grounded, and its dynamics (a lag, a dead zone of the
motor, an off-centre steering) differ from the crude model.

    python robot.py [--loss 0.02] [--jitter 0.004] [--seed 0]

It listens on COMMANDS for JSON: {"steering": rad, "speed": m/s}, {"kill": true}, {"reset": true}.
It sends its state to DRIVER and RECORDER at 50 Hz: t, x, y, psi, v, and whether it was killed. It
stops when it receives nothing for 0.25 s; once killed it stays where it is until reset.
"""

import argparse
import json
import math
import random
import socket
import time

COMMANDS, DRIVER, RECORDER = 9310, 9311, 9312
HOST, RATE, STEP, WATCHDOG = "127.0.0.1", 50.0, 0.005, 0.25


def main():
    """Run until stopped."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--loss", type=float, default=0.02, help="share of packets that are lost")
    options.add_argument("--jitter", type=float, default=0.004, help="largest send delay [s]")
    options.add_argument("--seed", type=int, default=0)
    chosen = options.parse_args()
    luck = random.Random(chosen.seed)
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    line.bind((HOST, COMMANDS))
    line.setblocking(False)
    car = Car()
    now = time.time()
    heard, send = now, now
    while True:
        for command in received(line):
            if luck.random() >= chosen.loss:
                heard = time.time()
                car.obey(command)
        if time.time() - heard > WATCHDOG:
            car.steering = car.speed = 0.0
        car.move(STEP)
        if now >= send:
            send += 1 / RATE
            if time.time() - now > 1 / RATE:  # the computer was stopped: this state is old
                now += STEP
                continue
            packet = json.dumps({"t": now, **car.state(luck)}).encode()
            time.sleep(luck.uniform(0, chosen.jitter))
            for port in (DRIVER, RECORDER):
                if luck.random() >= chosen.loss:
                    line.sendto(packet, (HOST, port))
        now += STEP
        time.sleep(max(0.0, now - time.time()))


def received(line):
    """Yield the received commands; drop what is not a JSON object."""
    while True:
        try:
            found = json.loads(line.recv(4096))
        except BlockingIOError:
            return
        except (ValueError, OSError):
            continue
        if isinstance(found, dict):
            yield found


class Car:
    """The true dynamics of the car."""

    def __init__(self):
        self.x = self.y = self.psi = self.v = 0.0
        self.steering = self.speed = 0.0
        self.killed = False

    def obey(self, command):
        """Apply a command; a kill holds until a reset."""
        if command.get("kill"):
            self.killed = True
        elif command.get("reset"):
            self.__init__()
        else:
            self.steering = min(max(float(command.get("steering", 0)), -0.45), 0.45)
            self.speed = min(max(float(command.get("speed", 0)), 0.0), 3.0)

    def move(self, dt):
        """Integrate one step."""
        wanted = 0.0 if self.killed or self.speed < 0.15 else 0.85 * self.speed
        self.v += dt * (wanted - self.v) / (0.08 if self.killed else 0.3)
        self.psi += dt * self.v * math.tan(self.steering + 0.03) / 0.27
        self.x += dt * self.v * math.cos(self.psi)
        self.y += dt * self.v * math.sin(self.psi)

    def state(self, luck):
        """Return what the sensors measure."""
        return {
            "x": self.x + luck.gauss(0, 0.002),
            "y": self.y + luck.gauss(0, 0.002),
            "psi": self.psi + luck.gauss(0, 0.003),
            "v": self.v + luck.gauss(0, 0.01),
            "killed": self.killed,
        }


if __name__ == "__main__":
    main()
