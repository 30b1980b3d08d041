"""Time the solver on its two problems, and whole commands; run by hand.

    python benchmarks/run.py solve      two problems to the best known cost, to a part in 10^4
    python benchmarks/run.py process    whole commands

    car       n = 6 + 2 previous inputs, m = 2, H = 200: 10 s on a circle at 20 Hz, without the
              model's stall and braking, so that it is smooth
    aircraft  n = 12 + 4, m = 4, H = 3000: the 60 s figure-8 of section 5.1 at 50 Hz

Inputs have no limits. Times are CPU times, the least of several.
"""

from __future__ import annotations

import argparse
import os
import platform
import tempfile
from dataclasses import replace
from pathlib import Path

import llvmlite
import numpy as np
from helpers import fastest, grounded, python

from grounded.compile import DescentOptions
from grounded.experiments.car_tasks import car_task
from grounded.experiments.figure8 import flight_task
from grounded.models import aircraft, car
from grounded.search.first_guess import first_guess
from grounded.solve.ddp import solve

HERE = Path(__file__).parent
ROOM = os.pathsep.join(str(HERE.parent / folder) for folder in ("", "cli", "trials"))
CLOSE = 1e-4  # relative distance from the best known cost at which the solver is done


def smooth_dynamics(s, a, p):
    delta_dot = (p.a1 * a.steering + p.b1 - s.delta) / p.tau_delta
    v_dot = (p.a2 * a.throttle + p.b2 - s.v) / p.tau_v
    cd, sd = np.cos(s.delta), np.sin(s.delta)
    return {
        "delta": delta_dot,
        "v": v_dot,
        "x": s.v * cd * np.cos(s.psi),
        "y": s.v * cd * np.sin(s.psi),
        "psi": s.v * sd / p.L,
        "psi_rate": (v_dot * sd + s.v * cd * delta_dot) / p.L,
    }


SMOOTH = ("a1", "b1", "a2", "b2", "tau_delta", "tau_v", "L")


def case(name):
    """Return a problem, and the inputs (H, m) that the solver starts from."""
    if name == "car":
        params = {name: car.model.params[name] for name in SMOOTH}
        model = replace(car.model, name="smooth car", params=params, derivative=smooth_dynamics)
        task = replace(car_task("circle", model), latency=np.zeros(2))
    else:
        task = flight_task(aircraft.model)
    free = np.full(task.model.m, np.inf)
    problem = replace(task.problem(), low=-free, high=free, smoothing=0.0)
    if name == "car":  # the inputs of the steady circle, open loop: about 0.5 m off at the end
        return problem, np.tile([0.32, 0.55], (problem.horizon, 1))
    guess = first_guess(task)
    run = problem.system.rollout(problem, guess.inputs, guess.gain, guess.z[:-1])
    return problem, run.u[0]


def solve_part():
    """Print time, iterations and cost of each problem.

    An iteration is linearisation, sweep and rollout, timed inside a solve, without the first
    rollout and the last sweep.
    """
    for name in ("car", "aircraft"):
        problem, u = case(name)

        def ours(iterations, tolerance=0.0, problem=problem, u=u):
            options = DescentOptions(max_iterations=iterations, tolerance=tolerance)
            return solve(problem, u, options=options)

        best = ours(50, 1e-10).cost
        count = next(i for i in range(1, 50) if ours(i).cost <= best * (1 + CLOSE))
        ms, first = (1e3 * fastest(lambda i=i: ours(i), 50) for i in (count, 0))
        print(
            f"\n{name}: H = {problem.horizon}, nz = {problem.nz}: {ms:.3f} ms, {count} iterations "
            f"of {(ms - first) / count:.3f} ms, cost {ours(count).cost:.6g}"
        )


def process_part():
    """Time whole processes: `grounded propose` on the aircraft, cold and warm, and importing.

    Cold: no kernel in the cache. Python's own compiled modules are always there, as after the
    installation of a package.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = {"GROUNDED_CACHE": f"{folder}/cache", "PYTHONPYCACHEPREFIX": f"{folder}/pyc"}
        environment |= {"PYTHONPATH": ROOM, "PYTHONDONTWRITEBYTECODE": ""}

        codes = ("pass", "import grounded_cli.main")
        bare, imported = (
            min(python("-c", code, **environment).seconds for _ in range(5)) for code in codes
        )
        print(f"\nWhole processes, CPU seconds (bare python: {bare:.3f})")
        print(f"  import grounded_cli.main    {imported:.3f}  ({imported - bare:.3f} over bare)")
        made = Path(folder) / "flight"

        def ours(*words):
            return grounded("-C", made, *words, **environment).seconds

        def proposed(identity):
            for old in (made / "candidates").glob(f"{identity}*"):
                old.unlink()  # or the outstanding one is proposed again
            return ours("propose")

        grounded("init", made, "--example", "flight-figure8", **environment)
        proposed("c0001")
        environment["GROUNDED_CACHE"] = f"{folder}/empty"
        print(f"  propose, first policy, cold {proposed('c0001'):.3f}")
        print(f"  propose, first policy, warm {min(proposed('c0001') for _ in range(7)):.3f}")
        ours("run")
        ours("ingest", *(made / "runs").glob("*.mcap"))
        proposed("c0002")
        print(f"  propose, improvement, warm  {min(proposed('c0002') for _ in range(7)):.3f}")


PARTS = {"solve": solve_part, "process": process_part}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}")
    versions = f"NumPy {np.__version__}, llvmlite {llvmlite.__version__}"
    machine = platform.processor() or platform.machine()
    print(f"Python {platform.python_version()}, {versions}, {machine}")
    for part in parser.parse_args().parts or PARTS:
        PARTS[part]()


if __name__ == "__main__":
    main()
