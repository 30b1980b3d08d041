"""Real systems whose authors published what the model lacks (../shared/data, each SOURCE.md)."""

import numpy as np

from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import diagnose
from shared_data import data, needs_data


def emps():
    """A motor and a ball screw without friction, 100 Hz (force averaged over a step)."""
    model = Model(
        name="emps",
        states={"q": "m", "v": "m/s"},
        inputs={"u": "V"},
        params={"M": Param(95.109, "kg"), "g": Param(35.1507, "N/V")},
        derivative=lambda s, a, p: {"q": s.v, "v": p.g * a.u / p.M},
        roles={"position": ("q",), "speed": "v"},
    )
    trials = []
    for name in ("emps_estimation", "emps_validation_pulses"):
        log = np.load(data("emps_prismatic_axis", f"{name}.npz"))
        q, u = log["q_m"], log["u_motor_V"]
        smooth = np.convolve(np.pad(q, 4, "edge"), np.ones(9) / 9, "valid")
        v = np.gradient(smooth, 1e-3)
        n = (len(q) - 1) // 10
        states = np.stack([q[::10][: n + 1], v[::10][: n + 1]], axis=1)
        inputs = u[: n * 10].reshape(n, 10).mean(axis=1)[:, None]
        trials.append(Trial(states, inputs, 0.01, ("q", "v"), ("u",), start_inputs=inputs[0]))
    return model, trials


def servo():
    """A servo that goes where it is told within a few hundredths of a second; 50 Hz."""
    model = Model(
        name="servo",
        states={"position": "1"},
        inputs={"command": "1"},
        params={"tau": Param(0.02, "s")},
        derivative=lambda s, a, p: {"position": (a.command - s.position) / p.tau},
    )
    log = np.load(data("hobby_servo_real_and_sim_twin", "servo_real_sim.npz"))
    trials = []
    for i in range(32):
        run = log[f"run{i:02d}"].astype(float)
        names = (("position",), ("command",))
        held = np.zeros(1)
        trials.append(Trial(run[:, 1:2], run[:-1, :1], 0.02, *names, start_inputs=held))
    return model, trials


def dart_steering():
    """Heading rate proportional to speed and steering at once; slow runs, 10 Hz."""
    log = np.load(data("dart_small_car", "steering_sine_10Hz.npz"), allow_pickle=True)
    runs = []
    for i in range(11):
        run = log[f"run{i:02d}"].astype(float)
        on = np.flatnonzero(run[:, 6] > 0)
        run = run[on[0] + 8 : on[-1] - 4] if len(on) else run[:0]
        if len(run) >= 20:
            runs.append((run[:, [4]], run[:-1, [8, 5]]))
    w = np.concatenate([y[:-1, 0] for y, _ in runs])
    x = np.concatenate([u[:, 0] * u[:, 1] for _, u in runs])
    model = Model(
        name="heading rate",
        states={"w": "rad/s"},
        inputs={"steering": "1", "speed": "m/s"},
        params={"k": Param(float(w @ x / (x @ x)), "rad/m")},
        step=lambda s, a, p, dt: {"w": p.k * a.speed * a.steering + 0 * s.w},
    )
    names = (("w",), ("steering", "speed"))
    return model, [Trial(y, u, 0.1, *names, start_inputs=u[0]) for y, u in runs]


def dart_throttle():
    """A linear motor; straight runs at one throttle each, 10 Hz."""
    log = np.load(data("dart_small_car", "throttle_steps_rubber_10Hz.npz"), allow_pickle=True)
    trials = []
    for i in range(26):
        run = log[f"run{i:02d}"].astype(float)
        if not 0.19 < run[:, 7].max() < 0.36:
            continue
        on = np.flatnonzero(run[:, 7] > 0.01)
        run = run[max(on[0] - 5, 0) : on[-1]]
        names = (("v",), ("throttle",))
        trials.append(Trial(run[:, [5]], run[:-1, [7]], 0.1, *names, start_inputs=np.zeros(1)))
    model = Model(
        name="motor",
        states={"v": "m/s"},
        inputs={"throttle": "1"},
        params={"a": Param(17.0, "m/s^2"), "tau": Param(0.8, "s")},
        derivative=lambda s, a, p: {"v": p.a * a.throttle - s.v / p.tau},
        roles={"speed": "v"},
    )
    return model, trials


@needs_data
def test_emps_has_dry_and_viscous_friction_of_the_published_size():
    found = diagnose(*emps())
    assert {"coulomb_friction:v", "viscous_friction:v"} <= set(found.effects)
    dry = found.values("coulomb_friction:v")["c"]
    viscous = found.values("viscous_friction:v")["k"]
    assert abs(dry / (20.394 / 95.109) - 1) < 0.05
    assert abs(viscous / (203.5 / 95.109) - 1) < 0.05
    assert found.gap["before"] > 20 * found.gap["after"]


@needs_data
def test_the_servo_has_a_rate_limit_and_a_delay():
    found = diagnose(*servo())
    assert {"rate_limit:command", "delay:command"} <= set(found.effects)
    assert 1.3 < found.values("rate_limit:command")["r"] < 1.9
    assert 0.015 < found.values("delay:command")["d"] < 0.06


@needs_data
def test_the_dart_steers_late():
    found = diagnose(*dart_steering())
    late = [e for e in found.effects if e in ("first_order_lag:steering", "delay:steering")]
    assert len(late) == 1  # beside a response that saturates
    assert 0.05 < next(iter(found.values(late[0]).values())) < 0.18


@needs_data
def test_the_dart_throttle_has_a_dead_zone():
    found = diagnose(*dart_throttle())
    assert found.ranking[0].effect == "dead_zone:throttle"
    assert 0.15 < found.values("dead_zone:throttle")["c"] < 0.22
    alike = {one.like: one.share for one in found.lookalikes if one.effect == "dead_zone:throttle"}
    assert 0.75 < alike["coulomb_friction:v"] < 1
    assert "dead_zone:throttle is nearly inseparable from" in found.sentence
