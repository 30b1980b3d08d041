"""Small models, tasks and trials: a search takes milliseconds on them, a diagnosis seconds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from grounded.model import Model, Param
from grounded.plant import Plant
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import Trial
from grounded.utility import Reward

DT = 0.05  # [s]


def cart_dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    return {"x": s.v, "v": (a.force - p.drag * s.v) / p.mass}


def rover_dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    speed = p.gain * np.where(a.speed > p.dead, a.speed, 0.0)
    return {"x": speed * np.cos(s.psi), "y": speed * np.sin(s.psi), "psi": p.yaw * a.turn}


def branching_step(s: Any, a: Any, p: Any, dt: float) -> dict[str, Any]:
    """Step with a Python `if` on the state, which no tracer can follow."""
    pull = -p.k * s.x if s.x > 0 else -2 * p.k * s.x
    v = s.v + dt * (a.force + pull)
    return {"x": s.x + dt * v, "v": v}


cart = Model(
    name="cart",
    states={"x": "m", "v": "m/s"},
    inputs={"force": "N"},
    params={"mass": Param(1.0, "kg", 0.1, 10.0), "drag": Param(0.2, "N s/m", 0.0, 5.0)},
    roles={"position": ("x",), "speed": "v"},
    derivative=cart_dynamics,
)
rover = Model(
    name="rover",
    states={"x": "m", "y": "m", "psi": "rad"},
    inputs={"speed": "m/s", "turn": "rad/s"},
    params={"gain": Param(1.0, "1", 0.1, 10.0), "yaw": Param(1.0), "dead": Param(0.05, "m/s")},
    angles=("psi",),
    roles={"position": ("x", "y"), "heading": "psi"},
    derivative=rover_dynamics,
)
black_box = Model(
    name="black box",
    states={"x": "m", "v": "m/s"},
    inputs={"force": "N"},
    params={"k": Param(1.0)},
    step=branching_step,
)


def cart_task(**changes: Any) -> Task:
    """Return a task of two seconds: one metre forward, from rest to rest."""
    t = np.linspace(0.0, 1.0, 41)
    x = 10 * t**3 - 15 * t**4 + 6 * t**5
    target = np.column_stack([x, np.full(41, np.nan)])
    fields: dict[str, Any] = {"model": cart, "dt": DT, "target": target}
    fields |= {"state": [10.0, 0.0], "limit": 5.0, "effort": 0.01, "change": 0.01}
    other = {"model": changes.pop("model")} if "model" in changes else {}
    return replace(plain_task(**fields | changes), **other)


def rover_task(**changes: Any) -> Task:
    """Return a task of one and a half circles: the heading passes pi and 2 pi."""
    t = 0.05 * np.arange(61)
    psi = 3.0 * t
    target = np.column_stack([np.sin(psi) / 3, (1 - np.cos(psi)) / 3, psi])
    fields: dict[str, Any] = {
        "past": np.array([0.5, 0.0]),
        "low": np.array([-2.0, -6.0]),
        "high": np.array([2.0, 6.0]),
        "latency": np.array([0.05, 0.02]),
    }
    fields |= {"terminal": 1.0, "effort": 0.01, "change": np.array([0.02, 0.03])}
    return plain_task(rover, DT, target, [10.0, 10.0, 1.0], np.inf, **fields | changes)


def plain_task(
    model: Model, dt: float, target: Any, state: Any, limit: float, **changes: Any
) -> Task:
    """Return a task from rest, with |inputs| <= limit and weights of zero but for the state's.

    `terminal`, `effort` and `change` are the other weights, for all inputs alike.
    """
    n, m = model.n, model.m
    weights = {name: changes.pop(name, 0.0) for name in ("terminal", "effort", "change")}
    spread = [np.broadcast_to(weights[k], size) for k, size in zip(weights, (n, m, m), strict=True)]
    fields: dict[str, Any] = {
        "model": model,
        "dt": dt,
        "target": np.asarray(target, float),
        "reward": Reward(np.broadcast_to(np.asarray(state, float), n), *spread),
        "start": np.zeros(n),
        "past": np.zeros(m),
        "low": np.full(m, -limit),
        "high": np.full(m, limit),
    }
    return Task(**fields | changes)


def speed_rover() -> Model:
    """Return a robot driven by speed commands, in NumPy."""
    return Model(
        states={"x": "m", "y": "m", "psi": "rad", "v": "m/s", "w": "rad/s"},
        inputs={"linear": "m/s", "angular": "rad/s"},
        params={"lag": Param(0.12, "s", 0.05, 0.5)},
        angles=("psi",),
        derivative=lambda s, a, p: {
            "x": s.v * np.cos(s.psi),
            "y": s.v * np.sin(s.psi),
            "psi": s.w,
            "v": (a.linear - s.v) / p.lag,
            "w": (a.angular - s.w) / p.lag,
        },
    )


def speed_rover_task(model: Model) -> Task:
    """Return a task for it: accelerate at 0.5 m/s^2 to 1 m/s, in a gentle turn."""
    t = DT * np.arange(81)
    v, w = np.minimum(0.5 * t, 1.0), 0.4 * np.sin(0.8 * t)
    psi = np.cumsum(w) * DT
    x, y = np.cumsum(v * np.cos(psi)) * DT, np.cumsum(v * np.sin(psi)) * DT
    target, weights = np.column_stack([x, y, psi, v, w]), [1.0, 1.0, 1.0, 1.0, 0.0]
    limits = {"low": np.array([-0.3, -1.8]), "high": np.array([1.5, 1.8])}
    return plain_task(model, DT, target, weights, np.inf, change=0.01, **limits)


def pushed_cart(
    friction: float = 0.0,
    dead: float = 0.0,
    trials: int = 4,
    steps: int = 120,
    noise: float = 1.0,
    seed: int = 0,
) -> tuple[Model, list[Trial]]:
    """Return a crude model, v' = k u - v / tau, and noisy trials of a cart that differs."""
    model = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "1"},
        params={"k": Param(2.0, "m/s^2", 0.1, 10.0), "tau": Param(1.0, "s", 0.1, 10.0)},
        roles={"position": ("x",), "speed": "v"},
        derivative=lambda s, a, p: {"x": s.v, "v": p.k * a.u - s.v / p.tau},
        name="cart",
    )
    rng, found = np.random.default_rng(seed), []
    for _ in range(trials):
        t = np.arange(steps) * DT
        u = 0.6 * np.sin(rng.uniform(1, 3) * t + rng.uniform(0, 6)) + 0.4 * np.sin(
            rng.uniform(3, 6) * t
        )
        x, states = np.zeros(2), [np.zeros(2)]
        for value in u:
            force = np.sign(value) * max(abs(value) - dead, 0)
            for _ in range(10):
                v = x[1]
                rate = 2.0 * force - v - friction * np.tanh(v / 0.01)
                x = x + DT / 10 * np.array([v, rate])
            x = x + noise * np.array([0.0003, 0.003]) * rng.standard_normal(2)
            states.append(x)
        y = np.array(states) + noise * np.array([0.002, 0.01]) * rng.standard_normal((steps + 1, 2))
        found.append(Trial(y, u[:, None], DT, ("x", "v"), ("u",), start_inputs=np.zeros(1)))
    return model, found


def pushed_cart_task(model: Model, steps: int = 120) -> Task:
    """Return a task of a pushed cart that only bounds its inputs."""
    return plain_task(model, DT, np.zeros((steps + 1, 2)), 1.0, 1.0)


def scara(friction: float) -> Model:
    """A SCARA of two joints; the crude one has no friction, no rotors and half of the load."""

    def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
        mc = 2.1 * 0.11**2 + 0.016 + p.load * 0.25**2
        h = (2.1 * 0.11 + p.load * 0.25) * 0.3
        c, sn = np.cos(s.q2), np.sin(s.q2)
        M11 = 4.2 * 0.14**2 + 0.045 + (2.1 + p.load) * 0.3**2 + mc + 2 * h * c + p.rotor
        M12, M22 = mc + h * c, mc + 0.5 * p.rotor
        lost1 = 1.2 * np.tanh(s.w1 / 0.02) + 0.5 * s.w1
        lost2 = 0.4 * np.tanh(s.w2 / 0.02) + 0.12 * s.w2
        r1 = a.tau1 - p.friction * lost1 + h * sn * (2 * s.w1 * s.w2 + s.w2**2)
        r2 = a.tau2 - p.friction * lost2 - h * sn * s.w1**2
        det = M11 * M22 - M12**2
        w1, w2 = (M22 * r1 - M12 * r2) / det, (M11 * r2 - M12 * r1) / det
        return {"q1": s.w1, "q2": s.w2, "w1": w1, "w2": w2}

    return Model(
        states={"q1": "rad", "q2": "rad", "w1": "rad/s", "w2": "rad/s"},
        inputs={"tau1": "N m", "tau2": "N m"},
        params={
            "load": Param(0.5 + 0.4 * friction, "kg"),
            "rotor": Param(0.1 * friction, "kg m^2"),
            "friction": Param(friction, "1"),
        },
        derivative=dynamics,
    )


def scara_task() -> Task:
    """Return a task of 0.8 s from rest to rest, and 0.2 s at rest, for a SCARA."""
    t = np.clip(np.linspace(0.0, 1.0, 101) / 0.8, 0.0, 1.0)
    way = 10 * t**3 - 15 * t**4 + 6 * t**5
    q = np.array([-0.4, 1.6]) + way[:, None] * np.array([1.1, -1.0])
    fields: dict[str, Any] = {
        "terminal": [100.0, 100.0, 10.0, 10.0],
        "change": [1.6e-5, 1e-4],
        "start": np.array([-0.4, 1.6, 0.0, 0.0]),
        "low": np.array([-25.0, -10.0]),
        "high": np.array([25.0, 10.0]),
    }
    target = np.hstack([q, np.gradient(q, 0.01, axis=0)])
    return plain_task(scara(0.0), 0.01, target, [0.826, 1.0, 0.0132, 0.016], np.inf, **fields)


def a_policy(H: int = 20, feedback: bool = True) -> Policy:
    """Return a policy of random numbers, with one limited input and an angle among its states."""
    rng = np.random.default_rng(1)
    return Policy(
        feedforward=rng.normal(size=(H, 2)),
        low=np.array([-1.0, -np.inf]),
        high=np.array([0.1, np.inf]),
        dt=1 / 30,
        state_names=("v", "x", "psi"),
        input_names=("steering", "throttle"),
        depths=(2, 1),
        angles=(False, False, True),
        past=np.array([0.0, 1 / 3]),
        gain=rng.normal(size=(H, 2, 6)) if feedback else None,
        reference=rng.normal(size=(H, 6)) if feedback else None,
    )


def other(model: Model, factor: float = 1.2) -> Model:
    """Return the same robot as a real system, every parameter scaled by a factor."""
    return model.with_values({k: factor * v.value for k, v in model.params.items()})


def drive(task: Task, plant: Plant, candidate: Candidate, seed: int = 0) -> Trial:
    """Run a candidate once from the task's start."""
    start = dict(zip(task.model.state_names, map(float, task.start), strict=True))
    trial = plant.run(candidate.policy, start, np.random.default_rng(seed))
    return replace(trial, candidate=candidate.id, id=f"t-{candidate.id}-{seed}")
