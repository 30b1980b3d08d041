"""A MuJoCo robot whose armature, damping, dry friction and delay are withheld, taken home.

    python benchmarks/taken_home.py [--seeds 3]

Logs of the robot, driven in open loop, are diagnosed with a file that lacks the four numbers; the
causes are adopted, `export --model` writes the file, and plain MuJoCo with it runs new commands.
Printed of each robot: the four numbers with their +- and the true ones, and the rms error of the
positions after 1 s, of the diagnosis on held-out data and of MuJoCo with the written file.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import mujoco as mj
import numpy as np

from grounded.frozen import Array
from grounded.result import with_error
from grounded_trials import Workspace

DT, STEP, SECONDS, TRIALS = 0.02, 0.002, 6.0, 5
NOISE = 5e-4, 5e-3  # rad, rad/s
XML = """<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="{step}" integrator="implicitfast"/>
  <worldbody>
    <body name="link" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" {joint}/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="0.8"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" gear="3" {motor}/></actuator>
</mujoco>
"""
MODEL = """from grounded.adapters import mujoco

given = ("hinge.armature", "hinge.damping", "hinge.frictionloss")
model = mujoco.model("arm.xml", params=given)
"""


def commands(rng: np.random.Generator) -> Array:
    """Return a multisine with steps (T,)."""
    t = DT * np.arange(round(SECONDS / DT))
    waves = [
        a * np.sin(2 * np.pi * f * t + rng.uniform(0, 6))
        for a, f in zip((0.5, 0.4, 0.2), rng.uniform(0.2, 3, 3), strict=True)
    ]
    steps = np.repeat(rng.uniform(-0.4, 0.4, 1 + len(t) // 40), 40)[: len(t)]
    return np.asarray(np.sum(waves, axis=0) + steps)


def run(model: Any, u: Array) -> Array:
    """Return the states of plain MuJoCo (T + 1, 2) under commands held over a control step."""
    data, path = mj.MjData(model), []
    for now in (*u, 0.0):
        path.append([data.qpos[0], data.qvel[0]])
        data.ctrl[0] = now
        mj.mj_step(model, data, round(DT / STEP))
    return np.array(path)


def log(path: Path, model: Any, u: Array, rng: np.random.Generator) -> None:
    """Write a run with noise as a table."""
    x = run(model, u) + rng.normal(size=(len(u) + 1, 2)) * NOISE
    rows = np.column_stack([DT * np.arange(len(u) + 1), x, np.append(u, u[-1])])
    np.savetxt(path, rows, delimiter=",", header="t,hinge,hinge_vel,motor", comments="", fmt="%.9g")


def study(seed: int) -> None:
    """Withhold four numbers of a drawn robot, find them, and predict with the file they go to."""
    rng = np.random.default_rng(seed)
    true = {
        "hinge.armature": rng.uniform(0.01, 0.03),
        "hinge.damping": rng.uniform(0.05, 0.2),
        "hinge.frictionloss": rng.uniform(0.1, 0.3),
        "motor.delay": rng.uniform(0.01, 0.05),
    }
    joint = " ".join(f'{n.partition(".")[2]}="{v}"' for n, v in true.items() if "hinge" in n)
    motor = f'delay="{true["motor.delay"]}" nsample="40" interp="linear"'
    robot = mj.MjModel.from_xml_string(XML.format(step=STEP, joint=joint, motor=motor))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "arm.xml").write_text(XML.format(step=STEP, joint="", motor=""))
        (folder / "model.py").write_text(MODEL)
        for k in range(TRIALS):
            log(folder / f"run{k}.csv", robot, commands(rng), rng)
        w = Workspace.create(folder / "w", log=folder / "run0.csv", model=folder / "model.py")
        for k in range(TRIALS):
            w.ingest(folder / f"run{k}.csv", data=True)
        found = w.diagnose()
        print(f"  {found.kind}: {', '.join(found.effects)}")
        w.adopt(*found.effects)
        done = w.export_model(folder / "found.xml")
        for one in done.findings:
            print(f"  {one.sentence}")
        values = {one.name: one.now for one in done.values}
        for name, value in true.items():
            now = values.get(name)
            told = "not found" if now is None else with_error(now.value, now.std)
            print(f"  {name:20} true {value:.4f}, {told}")
        ahead = next(row for row in found.prediction_error if row.horizon_s == 1.0)
        off = new_runs(robot, mj.MjModel.from_xml_path(str(done.file)), rng)
        print(
            f"  1 s ahead, of the diagnosis: {ahead.with_effects['hinge']:.5f} rad (without causes"
        )
        print(f"  {ahead.crude['hinge']:.5f}); MuJoCo with the file, new runs: {off:.5f} rad")


def new_runs(robot: Any, written: Any, rng: np.random.Generator) -> float:
    """Return the rms error of the position 1 s after the start of new runs."""
    sent = [commands(rng) for _ in range(20)]
    off = np.array([run(written, u) - run(robot, u) for u in sent])
    return float(np.sqrt((off[:, round(1 / DT), 0] ** 2).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    for seed in range(parser.parse_args().seeds):
        print(f"seed {seed}")
        study(seed)


if __name__ == "__main__":
    main()
