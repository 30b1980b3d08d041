"""Compare the solver with its peers, as time ratios within one run; run by hand.

    python -m venv /tmp/peers && /tmp/peers/bin/pip install numpy casadi crocoddyl
    python benchmarks/run.py --peers /tmp/peers/bin/python     solve alone, beside the peers
    python benchmarks/run.py process                           whole commands

Every solver gets the same problem (`peers.py`), the same start, and has to reach the best known
cost to a part in 10^4. Times are CPU times of the solve alone, least of several; building a
problem, tracing and compiling are listed separately.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import tempfile
from pathlib import Path

import llvmlite
import numpy as np
from helpers import fastest, grounded, python
from peers import CLOSE, case

from grounded.compile.problem import DescentOptions
from grounded.solve.ddp import solve

HERE = Path(__file__).parent
ROOM = os.pathsep.join(str(HERE.parent / folder) for folder in ("", "cli", "trials"))


def our_row(case):
    """Return our time, iterations and cost; an iteration is linearisation, sweep and rollout.

    An iteration is timed inside a solve, without the first rollout and the last sweep.
    """

    def ours(iterations, tolerance=0.0):
        options = DescentOptions(max_iterations=iterations, tolerance=tolerance)
        return solve(case.problem, case.u, options=options)

    best = ours(50, 1e-10).cost
    iterations = next(i for i in range(1, 50) if ours(i).cost <= best * (1 + CLOSE))
    ms, first = (1e3 * fastest(lambda i=i: ours(i), 50) for i in (iterations, 0))
    return best, {
        "peer": "grounded", "case": case.name, "ms": ms, "iterations": iterations,
        "cost": ours(iterations).cost, "iteration_ms": (ms - first) / iterations,
    }  # fmt: skip


def solve_part(options):
    """Print a row for each solver and problem."""
    with tempfile.TemporaryDirectory() as folder:
        for one in map(case, ("car", "aircraft")):
            best, ours = our_row(one)
            print(f"\n{one.name}: H = {one.problem.horizon}, nz = {one.problem.nz}")
            show(ours, ours)
            path = str(one.save(Path(folder)))
            for peer in ("crocoddyl", "casadi") if options.peers else ():
                command = [options.peers, "peers.py", peer, path, repr(best)]
                environment = os.environ | {"PYTHONPATH": ROOM}
                done = subprocess.run(
                    command, cwd=HERE, env=environment, capture_output=True, text=True
                )
                if done.returncode == 0:
                    show(json.loads(done.stdout.strip().splitlines()[-1]), ours)
                else:
                    print(f"  {peer:<24} not measured: {done.stderr.strip().splitlines()[-1:]}")


def show(row, ours):
    text = f"  {row['peer']:<24} {row.get('version', ''):<8} {row['ms']:10.3f} ms"
    text += f"  {row['iterations']} iterations, cost {row['cost']:.6g}"
    text += f", ratio {row['ms'] / ours['ms']:.1f}"
    if "backward_ms" in row:
        alone, ratio = row["backward_ms"], row["backward_ms"] / ours["iteration_ms"]
        text += f"; its backward pass alone {alone:.3f} ms, {ratio:.1f} of our iterations"
    if "iteration_ms" in row:
        text += f"; an iteration {row['iteration_ms']:.3f} ms"
    if "build_s" in row:
        text += f"; builds for {row['build_s']:.1f} s"
    print(text)


def process_part(options):
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
    parser.add_argument("--peers", help="a Python that has the peers")
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}")
    options = parser.parse_args()
    versions = f"NumPy {np.__version__}, llvmlite {llvmlite.__version__}"
    machine = platform.processor() or platform.machine()
    print(f"Python {platform.python_version()}, {versions}, {machine}")
    for part in options.parts or PARTS:
        PARTS[part](options)


if __name__ == "__main__":
    main()
