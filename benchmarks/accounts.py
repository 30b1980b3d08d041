"""Put faults into logs of robots, and see which story is told of how each log came about.

    python -m benchmarks.accounts [--seeds 0,1,2] [--robots car,arm] [--faults NAME,...] [--all]
                                  [--honest 20] [--wrong 300] [--by-hand 32] [--ingest N]

Five robots (car, arm, drone, boat, rover) are simulated with other parameters than their crude
model's, by seed mostly with an effect that it lacks, and with noise. Each fault is put into the log
of two runs, or of one of them, and `sound_trials` judges both. Printed are each true fault with
what was named (right: the kind and the signals; part: the kind, with other signals, or tied with
another story; silent: nothing; wrong: another kind), and how many honest runs were refused. With
`--all` every case has a line. Seeds are even for building, odd for measuring. With `--ingest` N
tables of each robot go through `ingest` instead, in which a run begins somewhere: whose it is said
to be, and whether it is cut where it begins.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.helpers import table
from grounded import Model, Param, Reward, Search, Task
from grounded.compile import Named
from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.onboard import Runner
from grounded.search.candidate import Candidate
from grounded.trial import Trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.opening.foreign import read_log_file
from grounded_trials.workspace.intake.recognise import recognised

DEGREES, RPM = 180 / np.pi, 30 / np.pi


@dataclass(frozen=True)
class Robot:
    """A crude model, what it lacks, and how the robot is driven.

    Args:
        model: the crude model.
        lacks: adds an unmodelled effect of a size to the derivative.
        noise: standard deviation of each state's sensor.
        reach: largest input of each kind.
        dt: control interval [s].
        rest: start of a run, None: zero.
        held: a feedback (states, inputs wanted) -> inputs, for a robot that would fall.
    """

    model: Model
    lacks: Callable[..., dict[str, Array]]
    noise: Sequence[float]
    reach: Sequence[tuple[float, float]]
    dt: float
    start: Sequence[float]
    held: Callable[[Array, Array], Array] | None = None


def _car() -> Robot:
    def rates(s, a, p):  # type: ignore[no-untyped-def]
        return {
            "x": s.v * np.cos(s.psi),
            "y": s.v * np.sin(s.psi),
            "psi": s.v * np.tan(a.steering) / p.L,
            "v": p.k * a.throttle - p.d * s.v,
        }

    model = Model(
        states={"x": "m", "y": "m", "psi": "rad", "v": "m/s"},
        inputs={"throttle": "1", "steering": "rad"},
        params={
            "L": Param(0.3, "m", 0.15, 0.6),
            "k": Param(4.0, "m/s^2", 1.0, 12.0),
            "d": Param(0.8, "1/s", 0.1, 3.0),
        },
        derivative=rates,
        angles=("psi",),
        roles={"position": ("x", "y"), "heading": "psi", "speed": "v"},
    )

    def lacks(s, a, size):  # type: ignore[no-untyped-def]
        grip = 1 / (1 + size * np.abs(s.v * np.tan(a.steering)))
        turn = s.v * np.tan(a.steering) / 0.3
        return {"v": -size * s.v * np.abs(s.v), "psi": (grip - 1) * turn}

    reach = ((0.1, 0.9), (-0.35, 0.35))
    return Robot(model, lacks, (0.004, 0.004, 0.005, 0.02), reach, 0.05, (0, 0, 0, 0.5))


def _arm() -> Robot:
    def rates(s, a, p):  # type: ignore[no-untyped-def]
        g1, g2 = 9.81 * np.sin(s.q1), 9.81 * np.sin(s.q1 + s.q2)
        return {
            "q1": s.w1,
            "q2": s.w2,
            "w1": (a.tau1 - p.d * s.w1 - p.m * 0.3 * g1 - p.m * 0.1 * g2) / (0.2 * p.m),
            "w2": (a.tau2 - p.d * s.w2 - p.m * 0.1 * g2) / (0.06 * p.m),
        }

    model = Model(
        states={"q1": "rad", "q2": "rad", "w1": "rad/s", "w2": "rad/s"},
        inputs={"tau1": "N m", "tau2": "N m"},
        params={"m": Param(1.0, "kg", 0.4, 2.5), "d": Param(0.15, "N m s", 0.01, 0.8)},
        derivative=rates,
    )

    def lacks(s, a, size):  # type: ignore[no-untyped-def]
        return {
            "w1": -4 * size * np.tanh(s.w1 / 0.05),
            "w2": -5 * size * np.tanh(s.w2 / 0.05),
        }

    reach = ((-2.5, 2.5), (-0.9, 0.9))
    return Robot(model, lacks, (0.002, 0.002, 0.02, 0.02), reach, 0.02, (0, 0, 0, 0))


def _drone() -> Robot:
    def rates(s, a, p):  # type: ignore[no-untyped-def]
        return {
            "x": s.vx,
            "z": s.vz,
            "th": s.w,
            "vx": -a.thrust / p.m * np.sin(s.th) - p.d * s.vx,
            "vz": a.thrust / p.m * np.cos(s.th) - 9.81 - p.d * s.vz,
            "w": a.torque / p.J,
        }

    model = Model(
        states={"x": "m", "z": "m", "th": "rad", "vx": "m/s", "vz": "m/s", "w": "rad/s"},
        inputs={"thrust": "N", "torque": "N m"},
        params={
            "m": Param(0.5, "kg", 0.3, 0.8),
            "J": Param(0.006, "kg m^2", 0.002, 0.02),
            "d": Param(0.1, "1/s", 0.0, 1.0),
        },
        derivative=rates,
        roles={"position": ("x", "z")},
    )

    def lacks(s, a, size):  # type: ignore[no-untyped-def]
        return {"vx": -size * s.vx * np.abs(s.vx), "w": -6 * size * s.w}

    def held(x: Array, want: Array) -> Array:
        lean = np.clip(0.25 * (x[0] - want[1]) + 0.3 * x[3], -0.5, 0.5)
        up = 0.5 * (9.81 + 4 * (want[0] - x[1]) - 3 * x[4]) / np.cos(np.clip(x[2], -0.9, 0.9))
        return np.array(
            [np.clip(up, 1, 9), np.clip(0.006 * (60 * (lean - x[2]) - 14 * x[5]), -1, 1)]
        )

    noise = (0.005, 0.005, 0.004, 0.02, 0.02, 0.02)
    return Robot(model, lacks, noise, ((-1.0, 1.0), (-1.5, 1.5)), 0.02, (0,) * 6, held)


def _boat() -> Robot:
    def rates(s, a, p):  # type: ignore[no-untyped-def]
        return {
            "x": s.u * np.cos(s.psi) - s.v * np.sin(s.psi),
            "y": s.u * np.sin(s.psi) + s.v * np.cos(s.psi),
            "psi": s.r,
            "u": (a.left + a.right) / p.m - p.du * s.u,
            "v": -p.dv * s.v - 0.3 * s.u * s.r,
            "r": 0.3 * (a.right - a.left) / p.J - p.dr * s.r,
        }

    model = Model(
        states={"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"},
        inputs={"left": "N", "right": "N"},
        params={
            "m": Param(20.0, "kg", 8.0, 50.0),
            "J": Param(2.0, "kg m^2", 0.5, 8.0),
            "du": Param(0.5, "1/s", 0.05, 2.0),
            "dv": Param(1.0, "1/s", 0.1, 5.0),
            "dr": Param(1.0, "1/s", 0.1, 5.0),
        },
        derivative=rates,
        angles=("psi",),
        roles={"position": ("x", "y"), "heading": "psi", "speed": "u"},
    )

    def lacks(s, a, size):  # type: ignore[no-untyped-def]
        return {"u": -size * s.u * np.abs(s.u), "r": -4 * size * s.r * np.abs(s.r)}

    noise = (0.02, 0.02, 0.01, 0.02, 0.02, 0.015)
    return Robot(model, lacks, noise, ((-4.0, 15.0), (-4.0, 15.0)), 0.1, (0, 0, 0, 0.3, 0, 0))


def _rover() -> Robot:
    def rates(s, a, p):  # type: ignore[no-untyped-def]
        v, w = p.R * (s.wr + s.wl) / 2, p.R * (s.wr - s.wl) / p.B
        return {
            "x": v * np.cos(s.psi),
            "y": v * np.sin(s.psi),
            "psi": w,
            "wl": (p.k * a.left - s.wl) / p.tau,
            "wr": (p.k * a.right - s.wr) / p.tau,
        }

    model = Model(
        states={"x": "m", "y": "m", "psi": "rad", "wl": "rad/s", "wr": "rad/s"},
        inputs={"left": "%", "right": "%"},
        params={
            "R": Param(0.1, "m", 0.05, 0.2),
            "B": Param(0.4, "m", 0.2, 0.8),
            "k": Param(0.12, "rad/s", 0.04, 0.4),
            "tau": Param(0.25, "s", 0.05, 1.0),
        },
        derivative=rates,
        angles=("psi",),
        roles={"position": ("x", "y"), "heading": "psi"},
    )

    def lacks(s, a, size):  # type: ignore[no-untyped-def]
        return {
            "wl": -8 * size * np.tanh(s.wl / 0.5),
            "wr": -8 * size * np.tanh(s.wr / 0.5),
            "psi": -size * 0.25 * (s.wr - s.wl),
        }

    noise = (0.004, 0.004, 0.006, 0.1, 0.1)
    return Robot(model, lacks, noise, ((-60.0, 95.0), (-60.0, 95.0)), 0.05, (0, 0, 0, 2, 2))


ROBOTS = {"car": _car, "arm": _arm, "drone": _drone, "boat": _boat, "rover": _rover}


@dataclass(frozen=True)
class Real:
    """How a real robot differs from its crude model: parameters, an effect, delay and noise."""

    robot: Robot
    values: Array
    size: float
    late: int
    noise: Array

    @classmethod
    def drawn(cls, robot: Robot, rng: np.random.Generator) -> Real:
        """Return a robot drawn at random; mostly with an effect that its model lacks."""
        model = robot.model
        real = dict(zip(model.params, model.values, strict=True))
        for name, one in model.params.items():
            real[name] = float(np.clip(real[name] * np.exp(0.2 * rng.normal()), one.low, one.high))
        values, size = np.array(list(real.values())), 0.4 * rng.random() * (rng.random() < 0.75)
        late, noise = int(rng.integers(0, 3)), np.array(robot.noise) * np.exp(0.5 * rng.normal())
        return cls(robot, values, size, 0 if robot.held else late, noise)

    def run(
        self,
        asked: Callable[[int, Array], Array],
        H: int,
        rng: np.random.Generator,
        *,
        fed: bool = True,
        age: int = 0,
        alike: bool = False,
        **named: Any,
    ) -> Trial:
        """Return the log of a run of H steps.

        Args:
            asked: the command at a step, of what is measured.
            H: number of steps.
            rng: source of the noise.
            fed: whether commands depend on what is measured.
            age: of the samples that the program acts on, in fifths of a step.
            alike: whether the log has the noise of these samples.
            named: further fields of the trial.
        """
        fine, sent, noise = self.driven(asked, H, rng, fed=fed, age=age)
        own = self.noise * rng.normal(size=(H + 1, fine.shape[1]))
        logged = fine[::5] + (np.vstack([noise, own[-1:]]) if alike else own)
        names = (self.robot.model.state_names, self.robot.model.input_names)
        return Trial(logged, sent, self.robot.dt, *names, **named)

    def driven(
        self,
        asked: Callable[[int, Array], Array],
        H: int,
        rng: np.random.Generator,
        *,
        fed: bool,
        age: int,
    ) -> tuple[Array, Array, Array]:
        """Return the states at every fifth of a step, the commands, and the noise acted on."""
        robot, n = self.robot, self.robot.model.n
        fine, inputs, noise = [np.array(robot.start, float)], list[Array](), list[Array]()
        for k in range(H):
            noise.append(self.noise * rng.normal(size=n) if fed else np.zeros(n))
            inputs.append(asked(k, fine[max(5 * k - age, 0)] + noise[-1]))
            for _ in range(5):
                a = inputs[max(k - self.late, 0)]
                fine.append(_step(robot, fine[-1], a, self.values, self.size, robot.dt / 5))
        return np.array(fine), np.array(inputs), np.array(noise)


def driven(robot: Robot, rng: np.random.Generator, count: int = 2) -> list[Trial]:
    """Return trials of the real robot, which differs from its crude model by seed."""
    real = Real.drawn(robot, rng)
    return [by_hand(real, round(rng.uniform(6, 12) / robot.dt), rng) for _ in range(count)]


def by_hand(real: Real, H: int, rng: np.random.Generator, **named: Any) -> Trial:
    """Return the log of H steps of sines and steps, held by its feedback if the robot has one."""
    wanted, held = _excited(real.robot, rng, H), real.robot.held

    def asked(k: int, x: Array) -> Array:
        return held(x, wanted[k]) if held else wanted[k]

    return real.run(asked, H, rng, fed=held is not None, **named)


def _step(robot: Robot, x: Array, a: Array, values: Array, size: float, dt: float) -> Array:
    after = robot.model.system.step(x[None], a[None], values, dt)[0]
    if size:
        s, sent = (
            Named("state", robot.model.state_names, x),
            Named("input", robot.model.input_names, a),
        )
        for name, rate in robot.lacks(s, sent, size).items():
            after[robot.model.state_names.index(name)] += dt * rate
    return np.asarray(after)


def _excited(robot: Robot, rng: np.random.Generator, H: int) -> Array:
    """Return inputs (H, m): sines and steps within the reach."""
    t, found = robot.dt * np.arange(H), []
    for low, high in robot.reach:
        rates, phases = rng.uniform(0.15, 0.9, 2), rng.uniform(0, 6.3, 2)
        wave = np.sin(6.28 * rates[:, None] * t + phases[:, None]).sum(axis=0) / 2
        steps = np.repeat(rng.uniform(-1, 1, H // 20 + 1), 20)[:H]
        mixed = np.clip(0.7 * wave + 0.5 * steps, -1, 1)
        found.append(low + (high - low) * (mixed + 1) / 2)
    return np.array(found).T


# --- faults -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fault:
    """What was done to the trials: its kind, and the signals that may be named for it."""

    name: str
    kind: str
    signals: tuple[frozenset[str], ...]
    trials: list[Trial]


def _set(trials: Sequence[Trial], change: Callable[[dict[str, Array]], None]) -> list[Trial]:
    """Return the trials with a change made to their columns by name."""
    found = []
    for trial in trials:
        columns = {n: np.array(trial.states[:, i]) for i, n in enumerate(trial.state_names)}
        columns |= {n: np.array(trial.inputs[:, j]) for j, n in enumerate(trial.input_names)}
        change(columns)
        states = np.stack([columns[n] for n in trial.state_names], axis=1)
        inputs = np.stack([columns[n][: trial.steps] for n in trial.input_names], axis=1)
        found.append(replace(trial, states=states, inputs=inputs))
    return found


def _times(trials: Sequence[Trial], names: Sequence[str], by: float) -> list[Trial]:
    """Return the trials with some columns multiplied."""
    return _set(trials, lambda c: c.update({n: by * c[n] for n in names}))


def faults(robot: Robot, trials: list[Trial], rng: np.random.Generator) -> Iterator[Fault]:
    """Yield the faults that a robot's log can have; which signal has it is drawn."""
    model, dt = robot.model, robot.dt
    units = {**model.states, **model.inputs}

    def some_of(*wanted: str, draw: bool = False) -> list[str]:
        names = [n for n in model.states if units[n] in wanted]
        return [str(rng.choice(names))] if draw and names else names

    def shifted(names: Sequence[str], steps: float) -> list[Trial]:
        def moved(x: Array) -> Array:
            at = np.arange(len(x))
            return np.interp(at - steps, at, x)

        return _set(trials, lambda c: c.update({n: moved(c[n]) for n in names}))

    def exchanged(*pairs: tuple[str, str]) -> list[Trial]:
        def change(c: dict[str, Array]) -> None:
            for a, b in pairs:
                k = min(len(c[a]), len(c[b]))
                c[a], c[b] = (np.concatenate([c[y][:k], c[x][k:]]) for x, y in ((a, b), (b, a)))

        return _set(trials, change)

    def fault(name: str, kind: str, names: Sequence[str], changed: list[Trial]) -> Fault:
        return Fault(name, kind, (frozenset(names),), changed)

    yield Fault("sound", "none", (), trials)
    drawn = [some_of(unit, draw=True) for unit in ("rad", "rad/s", "m", "m/s")]
    angle, rate, length, speed = drawn
    turning, lengths, speeds = some_of("rad", "rad/s"), some_of("m"), some_of("m/s")
    a, b = model.input_names[:2]
    same = [n for n in model.inputs if units[n] == units[b]]
    factors = {"rad": DEGREES, "%": 0.01, "N": 1000.0, "N m": 1000.0, "1": 100.0}
    heading = angle if "heading" in model.roles else []
    joints = [(q, w) for q, w in (("q1", "w1"), ("th", "w")) if {q, w} <= {*units}]
    for name, names, by in (
        ("angle: degrees", angle, DEGREES),
        ("angles: degrees", turning, DEGREES),
        ("rate: degrees", rate, DEGREES),
        ("rate: rpm", rate, RPM),
        ("rate: sign", rate, -1.0),
        ("position: mm", length, 1e3),
        ("positions: mm", length and lengths, 1e3),
        ("positions: feet", length and lengths, 3.28084),
        ("position: sign", length, -1.0),
        ("speeds: km/h", speeds, 3.6),
        ("speeds: knots", speeds, 1.943844),
        ("lengths: mm", speed and [*lengths, *speeds], 1e3),
        ("heading: sign", length and heading, -1.0),
        ("joint: sign", [n for pair in joints[:1] for n in pair], -1.0),
        ("commands: unit", same, factors[units[b]]),
    ):
        if names:
            yield fault(name, "sign" if by == -1.0 else "unit", names, _times(trials, names, by))
    yield fault("degrees once", "unit", angle, [*_times(trials, angle, DEGREES)[:1], *trials[1:]])
    if not robot.held:
        yield fault("reversed once", "sign", [b], [*_times(trials, [b], -1.0)[:1], *trials[1:]])
    # a rate
    if rate:
        (r,), noise = rate, max(robot.noise)
        yield fault(
            "rate: scale", "scale", rate, _times(trials, rate, float(rng.choice([0.75, 1.3])))
        )
        dead = _set(trials, lambda c: c.update({r: noise * rng.normal(size=len(c[r]))}))
        yield fault("rate: noise", "dead", rate, dead)
        none = _set(trials, lambda c: c.update({r: np.full(len(c[r]), 0.0)}))
        yield fault("rate: zero", "dead", rate, none)
        yield fault("noise once", "dead", rate, [dead[0], *trials[1:]])
        yield fault("late rate", "late", rate, shifted(rate, float(rng.uniform(0.06, 0.15)) / dt))
    # places
    if length:
        pair = (lengths[0], lengths[1])
        yield fault("positions exchanged", "exchange", pair, exchanged(pair))
        late = float(rng.uniform(0.12, 0.25)) / dt
        yield fault("late positions", "late", lengths, shifted(lengths, late))
    if length and heading:
        (psi,), pair = heading, (length[0], heading[0])
        yield fault("heading exchanged", "exchange", pair, exchanged(pair))
        turn = float(rng.choice([np.pi / 2, -0.7, 1.2]))
        off = _set(trials, lambda c: c.update({psi: c[psi] + turn}))
        yield fault("heading: offset", "offset", [psi], off)
        compass = _set(trials, lambda c: c.update({psi: np.pi / 2 - c[psi]}))
        yield fault("compass heading", "sign", [psi], compass)
        if "r" in units:
            both = _set(compass, lambda c: c.update({"r": -c["r"]}))
            yield fault("compass, gyro", "sign", [psi, "r"], both)
    others = [("x", "vx"), ("psi", "r")]
    for pair in [*joints, *(one for one in others if {*one} <= {*units})][:1]:
        yield fault("velocity exchanged", "exchange", pair, exchanged(pair))
    if "q2" in units:
        both = (frozenset({"q1", "q2", "w1", "w2"}), frozenset({"tau1", "tau2"}))
        swapped = exchanged(("q1", "q2"), ("w1", "w2"))
        yield Fault("joints exchanged", "exchange", both, swapped)
    # commands
    yield fault("commands exchanged", "exchange", (a, b), exchanged((a, b)))
    early = max(2, round(0.25 / dt))
    moved = [
        replace(t, states=t.states[early:], inputs=t.inputs[: t.steps - early]) for t in trials
    ]
    yield fault("states early", "clock", model.state_names, moved)
    # samples
    name = str(rng.choice(model.state_names))
    every = int(rng.integers(3, 6))
    hold = _set(
        trials, lambda c: c.update({name: np.repeat(c[name][::every], every)[: len(c[name])]})
    )
    yield fault("held values", "held", [name], hold)

    def sticks(c: dict[str, Array]) -> None:
        for at in range(30, len(c[name]) - 30, 60):
            c[name][at : at + 20] = c[name][at]

    yield fault("stuck", "stuck", [name], _set(trials, sticks))

    gone = 40 * float(np.std(trials[0].states[:, model.state_names.index(name)])) + 5

    def drops(c: dict[str, Array]) -> None:
        c[name][10::31] = gone

    yield fault("drop-outs", "dropout", [name], _set(trials, drops))

    yield from conditions(robot, trials, rng, angle, rate, length and lengths)


def conditions(
    robot: Robot,
    trials: Sequence[Trial],
    rng: np.random.Generator,
    angle: Sequence[str],
    rate: Sequence[str],
    lengths: Sequence[str],
) -> Iterator[Fault]:
    """Yield logs with much noise, of a robot that stands, and of six trials of which one is wrong.

    Args:
        robot: the robot.
        trials: of it.
        rng: source of what is drawn.
        angle: an angle of the model, if it has one.
        rate: a rate of turn, likewise.
        lengths: its positions.
    """

    def shaken(trial: Trial, size: float) -> Trial:
        noise = size * np.array(robot.noise) * rng.normal(size=trial.states.shape)
        return replace(trial, states=trial.states + noise)

    def at_rest(trial: Trial) -> Trial:
        moves = np.array([unit.endswith("/s") for unit in robot.model.states.values()])
        still = np.broadcast_to(np.where(moves, 0.0, trial.states[0]), trial.states.shape)
        return shaken(replace(trial, states=still, inputs=0.0 * trial.inputs), 1.0)

    noisy, rest = [shaken(one, 5.0) for one in trials], [at_rest(one) for one in trials]
    many = [*trials, *driven(robot, rng, 4)]
    named = (("noisy", noisy), ("at rest", rest), ("one at rest", [rest[0], trials[1]]))
    for name, logs in (*named, ("six", many)):
        yield Fault(f"{name}: sound", "none", (), logs)
    first, *others = many
    for name, kind, names, by, some in (
        ("noisy: degrees", "unit", angle, DEGREES, noisy),
        ("one at rest: degrees", "unit", angle, DEGREES, [rest[0], trials[1]]),
        ("six: degrees", "unit", angle, DEGREES, many),
        ("one of six: degrees", "unit", angle, DEGREES, [first]),
        ("noisy: rate's sign", "sign", rate, -1.0, noisy),
        ("one of six: sign", "sign", rate, -1.0, [first]),
        ("noisy: millimetres", "unit", lengths, 1e3, noisy),
    ):
        rest_of = others if name.startswith("one of six") else []
        if names:
            changed = [*_times(some, names, by), *rest_of]
            yield Fault(name, kind, (frozenset(names),), changed)


# --- candidates -----------------------------------------------------------------------------------

SECONDS, TRIALS = 4.0, 6  # of a manoeuvre, and of the search for it
APART, CLOSE = 0.01, 0.05  # rms difference of two plans' commands, of their size: none, and little


LOGS = {True: "samples acted on", False: "later samples"}


def task_of(robot: Robot, rng: np.random.Generator) -> Task:
    """Return the manoeuvre to follow what the crude model does when it is driven by hand."""
    model, H = robot.model, round(SECONDS / robot.dt)
    crude = Real(robot, model.values, 0.0, 0, np.zeros(model.n))
    target = by_hand(crude, H, rng)
    size = np.maximum(target.states.std(axis=0), 1e-3)
    reach = np.ptp(target.inputs, axis=0)
    place = np.array([not unit.endswith("/s") for unit in model.states.values()])
    weights = np.where(place, 1.0, 0.1) / size**2
    reward = Reward(weights, weights, 0.01 / reach**2, 0.1 / reach**2)
    low, high = target.inputs.min(axis=0) - reach / 4, target.inputs.max(axis=0) + reach / 4
    start, past = np.array(robot.start, float), target.inputs[0]
    return Task(model, robot.dt, target.states, reward, start, past, low, high)


def run_of(
    real: Real, ran: Candidate, rng: np.random.Generator, said: str, *, exact: bool = True
) -> Trial:
    """Return the log of a candidate's run, which is said to be another's.

    An exact log has the samples that the program acted on, another one later ones, with a noise of
    their own.
    """
    act = Runner(ran.policy).action
    return real.run(
        lambda k, x: act(k * real.robot.dt, x),
        ran.policy.horizon,
        rng,
        age=0 if exact else int(rng.integers(0, 8)),
        alike=exact,
        candidate=said,
        start_inputs=ran.policy.past,
    )


def searched(task: Task, real: Real, rng: np.random.Generator) -> Search:
    """Return a search after its first trials on a robot."""
    search = Search(task)
    for _ in range(TRIALS):
        if (one := search.ask()) is None:
            break
        search.tell(run_of(real, one, rng, one.id))
    return search


def runs(
    robot: Robot, rng: np.random.Generator, wrong: int, hand: int
) -> Iterator[tuple[str, str]]:
    """Yield the kind of a run that is said to be a candidate's, and what was told of it.

    Args:
        robot: the robot.
        rng: source of what is drawn.
        wrong: number of runs of another candidate.
        hand: number of runs by hand.
    """
    from grounded.accounts.returned import suspicion

    task, real = task_of(robot, rng), Real.drawn(robot, rng)
    search = searched(task, real, rng)
    some = {one.id: one for one in search.candidates}

    def told(trial: Trial, ran: str = "") -> str:
        seen = suspicion(task, trial, some[trial.candidate], search.candidates)
        if not seen.other:
            return "refused" if seen.why else "taken"
        return "named" if seen.other == ran else "another"

    for one in some.values():
        for exact, log in LOGS.items():
            yield f"own candidate, {log}", told(run_of(real, one, rng, one.id, exact=exact))
    far = {(a, b): _apart(a, b) for a, b in permutations(some.values(), 2)}
    pairs = [pair for pair, off in far.items() if off > APART]
    for k in rng.integers(0, len(pairs), wrong) if pairs else ():
        (own, ran), exact = pairs[k], bool(rng.random() < 0.5)
        near = "" if far[own, ran] > CLOSE else ", near"
        trial = run_of(real, ran, rng, own.id, exact=exact)
        yield f"another, {LOGS[exact]}{near}", told(trial, ran.id)
    for _ in range(hand):
        own = some[str(rng.choice([*some]))]
        trial = by_hand(real, task.horizon, rng, candidate=own.id, start_inputs=task.past)
        yield "by hand", told(trial)


# --- logs of runs, through `ingest` --------------------------------------------------------------


def ingested(which: str, seed: int, count: int) -> Iterator[tuple[str, str]]:
    """Yield the kind of a table in which a run begins somewhere, and what `ingest` says of it.

    Its rows are fifths of a step, each with a noise of its own. The program acted on rows of some
    age, and the robot waited before.
    """
    robot, rng = ROBOTS[which](), np.random.default_rng([seed, 33, [*ROBOTS].index(which)])
    task, real = task_of(robot, rng), Real.drawn(robot, rng)
    search = searched(task, real, rng)
    with TemporaryDirectory() as name:
        here = workspace_of(Path(name), which, task)
        some = [here.save_candidate(one) for one in search.candidates]
        for k in range(count):
            kind = ("own", "own", "own", "another", "by hand")[k % 5]
            own = some[int(rng.integers(0, len(some)))]
            far = [one for one in some if one.id != own.id and _apart(one, own) > CLOSE]
            if kind == "another" and not far:
                continue
            ran = far[int(rng.integers(0, len(far)))] if kind == "another" else own
            begun = log_of(
                Path(name) / "log.csv", real, task, None if kind == "by hand" else ran, rng
            )
            try:
                read = read_log_file(here.forget(), Path(name) / "log.csv", own.id, False)
                read = recognised(here, Path(name) / "log.csv", read, None)
            except GroundedError as error:
                said = error.finding.facts.get("other") if error.finding else ""
                yield kind, "named" if said == ran.id else "another" if said else "refused"
            else:
                off = abs(1e-9 * read.cut.start_ns - begun) if read.cut else 0.0
                yield kind, "taken" if off < 0.3 * robot.dt else "misplaced"


def workspace_of(place: Path, which: str, task: Task) -> Folder:
    """Return a workspace of a task, which reads tables."""
    model = task.model
    rows = np.column_stack([task.dt * np.arange(task.horizon + 1), task.target])
    np.savetxt(
        place / "target.csv", rows, "%.9g", ",", header=f"t,{','.join(model.states)}", comments=""
    )
    given = f'from benchmarks.accounts import ROBOTS\n\nmodel = ROBOTS["{which}"]().model\n'
    (place / "model.py").write_text(given)
    ends = zip(model.inputs, task.low, task.high, strict=True)
    limits = "".join(f"{name} = [{low!r}, {high!r}]\n" for name, low, high in ends)
    weights = ", ".join(f"{name} = 1.0" for name in model.states)
    start = zip((*model.states, *model.inputs), (*task.start, *task.past), strict=True)
    begins = ", ".join(f"{name} = {value!r}" for name, value in start)
    signals = [("state", one) for one in model.states] + [("input", one) for one in model.inputs]
    log = "".join(f'[log.{kind}.{name}]\npath = "/csv.{name}"\n' for kind, name in signals)
    (place / "grounded.toml").write_text(
        f'[model]\nfile = "model.py"\n[task]\ndt = {task.dt}\nhorizon = {task.horizon}\n'
        f'target = "target.csv"\nstart = {{ {begins} }}\n[reward]\nstate = {{ {weights} }}\n'
        f"[limits]\n{limits}{log}".replace("np.float64(", "").replace(")", "")
    )
    return Folder(place)


def log_of(
    path: Path, real: Real, task: Task, ran: Candidate | None, rng: np.random.Generator
) -> float:
    """Write the table of a candidate's run, or of one by hand; return when it began [s]."""
    robot, H, wait = real.robot, task.horizon, int(rng.integers(10, 60))
    wanted, hold = _excited(robot, rng, H), robot.held or (lambda x, want: want)
    act = Runner(ran.policy).action if ran else None
    age, size = int(rng.integers(0, 8)), real.noise
    fine, sent, noise = real.driven(
        lambda k, x: act(k * robot.dt, x) if act else hold(x, wanted[k]), H, rng, fed=True, age=age
    )
    states = np.vstack([np.repeat(fine[:1], wait, axis=0), fine])
    states = states + size * rng.normal(size=states.shape)
    for k in range(len(noise)):  # the rows that the program acted on
        states[wait + max(5 * k - age, 0)] = fine[max(5 * k - age, 0)] + noise[k]
    after = np.repeat(sent[-1:] if robot.held else 0 * sent[-1:], 1, axis=0)
    inputs = np.vstack(
        [np.repeat(task.past[None], wait, axis=0), np.repeat(sent, 5, axis=0), after]
    )
    t = 100 + robot.dt / 5 * np.arange(len(states))
    names = ",".join(("t", *robot.model.state_names, *robot.model.input_names))
    np.savetxt(path, np.column_stack([t, states, inputs]), "%.9g", ",", header=names, comments="")
    return float(t[wait])


def _apart(a: Candidate, b: Candidate) -> float:
    """Return the rms difference of two plans' commands, relative to their size."""
    u, v = a.predicted_inputs, b.predicted_inputs
    size = np.maximum(np.abs(u).max(axis=0), np.abs(v).max(axis=0)) + 1e-12
    return float(np.sqrt((((u - v) / size) ** 2).mean()))


# --- what was named -----------------------------------------------------------------------------

KINDS = {
    "degrees": "unit",
    "delay": "late",
    "lag": "late",
    "scale": "scale",
    "mismatch": "mismatch",
}
QUIET = {"saturated", "beyond", "constant", "copy", "quantised", "missing", "smoothed", "time step"}
CODES = {"folded": "unit", "compass": "sign", "reversed": "sign"}


def named(model: Model, trials: Sequence[Trial]) -> tuple[list[tuple[str, frozenset[str]]], bool]:
    """Return kinds and signals of what `sound_trials` names, and whether it refused."""
    from grounded.accounts.finding import UnusableTrials
    from grounded.accounts.sound_trials import sound_trials

    try:
        found = sound_trials(model, trials).findings
    except UnusableTrials as error:
        first = [one for one in error.findings if "tied" not in one.facts]
        kinds = [one.code.partition(".")[2] for one in first]
        signals = frozenset(name for one in first for name in one.about)
        return [(CODES.get(kinds[0], kinds[0]), signals)], True
    every: dict[str, set[str]] = defaultdict(set)
    for finding in found:
        if finding.kind not in QUIET:
            kind = KINDS.get(finding.kind, finding.kind)
            if finding.kind == "stuck" and np.isnan(finding.share):
                kind = "dead"
            every[kind] |= {*finding.signal.split("+")}
    return [(kind, frozenset(some)) for kind, some in every.items()], False


def verdict(fault: Fault, found: Sequence[tuple[str, frozenset[str]]]) -> str:
    """Return right, part, silent or wrong."""
    if fault.kind == "none":
        return "right" if not found else "wrong"
    same = [signals for kind, signals in found if kind == fault.kind]
    others = [kind for kind, _ in found if kind != fault.kind]
    if any(signals in fault.signals for signals in same) or (same and fault.kind == "clock"):
        return "part" if set(others) - {"late", "scale", "offset"} else "right"
    if same:
        touches = any(signals & expected for signals in same for expected in fault.signals)
        return "part" if touches else "wrong"
    return "wrong" if found else "silent"


MARKS = ("right", "part", "silent", "wrong")
RUNS = ("taken", "named", "refused", "another")
Counts = defaultdict[str, Counter[str]]


def main() -> None:
    """Print the matrix of faults, the honest runs, and the runs of candidates."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", default="0,2,4")
    parser.add_argument("--robots", default=",".join(ROBOTS))
    parser.add_argument("--faults", default="")
    parser.add_argument("--honest", type=int, default=20, help="honest runs of each robot")
    parser.add_argument("--wrong", type=int, default=300, help="runs of another candidate, in all")
    parser.add_argument("--by-hand", type=int, default=32, help="runs by hand, in all")
    parser.add_argument("--ingest", type=int, default=0, help="tables of each robot and seed")
    parser.add_argument("--all", action="store_true")
    args = parser.parse_args()
    seeds, robots = [int(s) for s in args.seeds.split(",")], args.robots.split(",")
    each, said = [(which, seed) for which in robots for seed in seeds], print if args.all else _no

    if args.ingest:
        logs, began = Counts(Counter), time.process_time()
        for which, seed in each:
            for kind, told in ingested(which, seed, args.ingest):
                logs[kind][told] += 1
                said(f"{told:8}{which:6}{seed:3} {kind}")
        rows = [
            (k, *(row[n] for n in ("taken", "misplaced", *RUNS[1:]))) for k, row in logs.items()
        ]
        print(table(("table", "taken", "misplaced", *RUNS[1:]), rows))
        spent = (time.process_time() - began) / sum(map(Counter.total, logs.values()))
        return print(f"{spent:.2f} s CPU each, with the searches")

    # every fault, as it was named
    counts, names, began = Counts(Counter), Counts(Counter), time.process_time()
    for which, seed in each:
        robot, rng = ROBOTS[which](), np.random.default_rng([seed, [*ROBOTS].index(which)])
        for fault in faults(robot, driven(robot, rng), rng):
            if args.faults and fault.name not in args.faults.split(","):
                continue
            found, refused = named(robot.model, fault.trials)
            kind = verdict(fault, found)
            counts[fault.name][kind] += 1
            names[fault.name].update([one for one, _ in found] or ["-"])
            told = "; ".join(f"{k} {'+'.join(sorted(s))}" for k, s in found)
            said(f"{kind:7}{which:6}{seed:3} {fault.name:32} {'refused' * refused:8}{told}")
    total = sum(counts.values(), Counter[str]())
    rows = [
        (name, *(row[mark] for mark in MARKS), ", ".join(f"{k} {n}" for k, n in top))
        for name, row in counts.items()
        for top in [names[name].most_common(4)]
    ]
    cases = max(sum(total.values()), 1)
    share = f"{100 * total['right'] / cases:.1f} % right"
    rows.append(("all", *(total[mark] for mark in MARKS), share))
    print(table(("true fault", *MARKS, "named"), rows))
    print(f"{cases} cases, {(time.process_time() - began) / cases:.2f} s CPU each")

    # honest runs, of which nothing is to be told
    refusals = stories = logs = 0
    for which, k in ((which, k) for which in robots for k in range(args.honest)):
        robot = ROBOTS[which]()
        rng = np.random.default_rng([seeds[0], 77, k, [*ROBOTS].index(which)])
        found, refused = named(robot.model, driven(robot, rng, 1 + k % 3))
        logs, refusals, stories = logs + 1, refusals + refused, stories + bool(found)
        if found:
            said("honest", which, k, "refused" * refused, found)
    print(f"honest: {refusals} of {logs} refused, a story told of {stories}")

    # runs that are said to be a candidate's
    ran, pairs = Counts(Counter), [(which, seed) for seed in seeds for which in robots]
    for k, (which, seed) in enumerate(pairs if args.wrong or args.by_hand else ()):
        rng = np.random.default_rng([seed, 55, [*ROBOTS].index(which)])
        shares = (n // len(pairs) + (k < n % len(pairs)) for n in (args.wrong, args.by_hand))
        for kind, told in runs(ROBOTS[which](), rng, *shares):
            ran[kind][told] += 1
            said(f"{told:8}{which:6}{seed:3} {kind}")
    if ran:
        print(
            table(("run", *RUNS), [(k, *(row[n] for n in RUNS)) for k, row in sorted(ran.items())])
        )


def _no(*words: object) -> None:
    """Print nothing."""


if __name__ == "__main__":
    main()
