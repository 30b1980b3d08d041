"""A Cessna 172 in JSBSim, and a crude model with eight states.

The simulator has engine, propeller, sideslip, flaps and 6 degrees of freedom. The crude model flies
at constant speed without sideslip: a roll rate with a lag, a short period, and a turn that is
coordinated after a second. Its numbers are a third off those of the simulator's step responses.
Inputs are deflections (of 1) from the trim, elevator positive nose down, as in JSBSim.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.foreign.robots import Robot, minimum_jerk, task_of
from grounded.model import Model, Param
from grounded.task import Task

G = 9.81
FOOT = 0.3048
TRIM = 0.0224  # [rad] angle of attack and pitch of the trimmed flight at 90 knots
SURFACES = ("aileron", "elevator", "rudder")
MEASURED = {
    "phi": "attitude/phi-rad", "theta": "attitude/theta-rad", "psi": "attitude/psi-rad",
    "p": "velocities/p-rad_sec", "q": "velocities/q-rad_sec", "r": "velocities/r-rad_sec",
    "alpha": "aero/alpha-rad", "h": "position/h-sl-ft",
}  # fmt: skip


class Cessna:
    """JSBSim's c172p, trimmed at 90 knots and 3000 ft; `wind` [m/s] from the west sets in then."""

    timestep = 1 / 60

    def __init__(self, wind: float = 0.0) -> None:
        import jsbsim

        self.jsbsim, self.wind = jsbsim, wind

    def reset(self) -> None:
        """Make a new aircraft; a trim that starts from a used one differs in its last digits."""
        self.jsbsim.FGJSBBase().debug_lvl = 0
        f = self.f = self.jsbsim.FGFDMExec(str(Path(self.jsbsim.__file__).parent))  # its data
        f.set_debug_level(0)
        f.load_model("c172p")
        f.disable_output()
        f.set_dt(self.timestep)
        f["ic/h-sl-ft"], f["ic/vc-kts"] = 3000.0, 90.0
        f.run_ic()
        f["propulsion/set-running"] = -1
        f["simulation/do_simple_trim"] = 1
        f["atmosphere/wind-east-fps"] = self.wind / FOOT
        self.trim = {name: f[f"fcs/{name}-cmd-norm"] for name in SURFACES}
        self.height, self.psi = f["position/h-sl-ft"], 0.0

    def measure(self) -> np.ndarray:
        x = np.array([self.f[name] for name in MEASURED.values()])
        self.psi += (x[2] - self.psi + np.pi) % (2 * np.pi) - np.pi  # unwrapped
        x[2], x[7] = self.psi, (x[7] - self.height) * FOOT
        return x

    def advance(self, u: np.ndarray) -> None:
        for name, value in zip(SURFACES, u, strict=True):
            self.f[f"fcs/{name}-cmd-norm"] = self.trim[name] + float(value)
        self.f.run()


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """Return ds/dt."""
    turn = s.q * np.sin(s.phi) + s.r * np.cos(s.phi)
    coordinated = G / p.v * np.sin(s.phi)
    incidence = s.alpha - TRIM
    return {
        "phi": s.p + np.tan(s.theta) * turn,
        "theta": s.q * np.cos(s.phi) - s.r * np.sin(s.phi),
        "psi": turn / np.cos(s.theta),
        "p": p.Lp * s.p + p.La * a.aileron,
        "q": p.Mq * s.q + p.Ma * incidence + p.Me * a.elevator,
        "r": p.Nr * (coordinated - s.r) + p.Nd * a.rudder,
        "alpha": s.q - p.Za * incidence + G / p.v * (np.cos(s.phi) - 1),
        "h": p.v * (np.sin(s.theta) - np.cos(s.phi) * np.sin(s.alpha)),
    }


def model() -> Model:
    return Model(
        name="cessna",
        states={
            "phi": "rad", "theta": "rad", "psi": "rad", "p": "rad/s", "q": "rad/s", "r": "rad/s",
            "alpha": "rad", "h": "m",
        },
        inputs=dict.fromkeys(SURFACES, "1"),
        params={
            "v": Param(48.4, "m/s", 40.0, 60.0),
            "Lp": Param(-4.0, "1/s", -15.0, -2.0),
            "La": Param(5.0, "1/s^2", 2.0, 15.0),
            "Mq": Param(-3.0, "1/s", -10.0, -1.0),
            "Ma": Param(-8.0, "1/s^2", -30.0, -3.0),
            "Me": Param(-10.0, "1/s^2", -20.0, -2.0),
            "Nr": Param(1.0, "1/s", 0.5, 6.0),
            "Nd": Param(-1.2, "1/s^2", -3.0, -0.2),
            "Za": Param(1.5, "1/s", 0.5, 5.0),
        },
        angles=("psi",),
        derivative=dynamics,
    )  # fmt: skip


def task() -> Task:
    """Return the task: a turn of 30 degrees in 9 s at constant height, 3 s of straight flight."""
    dt, H, crude = 0.1, 120, model()
    t = dt * np.arange(H + 1)
    psi = minimum_jerk(np.zeros(1), np.array([np.radians(30)]), (t - 0.5) / 9.0)[:, 0]
    target = np.full((H + 1, 8), np.nan)
    target[:, 2], target[:, 7] = psi, 0.0
    target[:, 0] = np.arctan(48.4 / G * np.gradient(psi, dt))
    start = np.zeros(8)
    start[[1, 6]] = TRIM
    return task_of(
        crude,
        dt,
        target,
        start,
        0.5,
        state={"psi": 100.0, "phi": 10.0, "h": 0.05},
        input=0.5,
        change=2.0,
    )


def robot(wind: float = 0.0) -> Robot:
    return Robot(Cessna(wind))
