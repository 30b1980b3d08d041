"""Compare the solver with its peers, as time ratios within one run; run by hand.

    python -m venv /tmp/peers && /tmp/peers/bin/pip install numpy casadi crocoddyl jax
    python benchmarks/run.py --peers /tmp/peers/bin/python

Every solver gets the same problem (cases.py), the same start, and has to reach the best known cost
to a part in 10^4. Times are CPU times of the solve alone, least of several; building a problem,
tracing and compiling are listed separately. trajax is not in the registry; the same algorithm
written in JAX stands in for it.

Parts: solve, horizon, size, swarm, memory, process; all by default.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
PARTS = ("solve", "horizon", "size", "swarm", "memory", "process")
PEERS = ("crocoddyl", "casadi", "jax")


def cpu(function, repeats=20):
    """Return the least CPU seconds of a few calls."""
    from peer_data import fastest

    return fastest(function, repeats)


def our_solve(case, iterations, tolerance=0.0):
    from grounded.compile import DescentOptions
    from grounded.solve.ddp import solve

    options = DescentOptions(max_iterations=iterations, tolerance=tolerance)
    return solve(case.problem, case.u, options=options)


def our_row(case):
    """Return our time, iterations and cost; an iteration is linearisation, sweep and rollout.

    An iteration is timed inside a solve, without the first rollout and the last sweep.
    """
    from peer_data import CLOSE

    from grounded.compile import DescentOptions
    from grounded.solve.ddp import solve

    best = our_solve(case, 50, 1e-10).cost
    iterations = next(i for i in range(1, 50) if our_solve(case, i).cost <= best * (1 + CLOSE))
    ms = 1e3 * cpu(lambda: our_solve(case, iterations), 50)
    found = our_solve(case, iterations)
    start, settings = (case.problem, case.u), DescentOptions(max_iterations=0)
    first = 1e3 * cpu(lambda: solve(*start, options=settings), 50)  # a rollout and a sweep
    return best, {
        "peer": "grounded",
        "case": case.name,
        "ms": ms,
        "iterations": iterations,
        "cost": found.cost,
        "iteration_ms": (ms - first) / iterations,
    }


def peer_rows(case, best, python, folder, fatrop):
    """Return what each peer prints, or why it printed nothing."""
    path = case.save(folder)
    calls = [[peer] for peer in PEERS] + ([["casadi", "fatrop"]] if fatrop else [])
    for peer, *extra in calls:
        command = [python, f"peer_{peer}.py", str(path), repr(best), *extra]
        environment = os.environ | {"PYTHONPATH": str(HERE.parent)}
        done = subprocess.run(command, cwd=HERE, env=environment, capture_output=True, text=True)
        if done.returncode == 0:
            yield json.loads(done.stdout.strip().splitlines()[-1])
        else:
            why = (done.stderr.strip().splitlines() or ["no output"])[-1]
            yield {"peer": peer, "case": case.name, "missing": why}


def solve_part(options):
    from cases import cases

    with tempfile.TemporaryDirectory() as folder:
        for case in cases():
            best, ours = our_row(case)
            print(f"\n{case.name}: H = {case.problem.horizon}, nz = {case.problem.nz}")
            show(ours, ours)
            if options.peers:
                rows = peer_rows(case, best, options.peers, Path(folder), options.fatrop)
                for row in rows:
                    show(row, ours)


def show(row, ours):
    if "missing" in row:
        print(f"  {row['peer']:<24} not measured: {row['missing']}")
        return
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


def stretched(problem, H):
    """Make the same problem at any length: straight flight for H steps, two metres higher.

    Returns it with the inputs and gains of an LQR that holds the trimmed flight. From there every
    iteration takes a full step, so that the work per step is the same for every H.
    """
    n, m = problem.system.n, problem.system.m
    start, u = problem.start, np.tile(problem.past, (H, 1))
    moved = problem.system.step(start[None], problem.past[None], problem.p, problem.dt)[0] - start
    way = start + np.outer(np.arange(H + 1), moved * ([1.0] * 3 + [0.0] * (n - 3)))
    longer = dataclasses.replace(
        problem,
        bias=np.zeros((H, n)),
        target=way + np.array([0, 0, 2.0] + [0] * (n - 3)),
        state_weight=np.tile([1.0] * 3 + [0.0] * (n - 3), (H + 1, 1)),
        input_target=np.zeros((H, m)),
    )
    trimmed = np.hstack([way, np.tile(problem.past, (H + 1, 1))])
    gains = longer.system.backward(longer, trimmed, u, np.zeros(m))
    return longer, u, gains.K, trimmed


def horizon_part(options):
    from cases import cases

    from grounded.compile import DescentOptions
    from grounded.solve.ddp import solve

    case, settings = cases(["aircraft"])[0], DescentOptions(max_iterations=3, tolerance=0.0)
    print("\nCPU of 3 iterations against the horizon (aircraft, straight flight)")
    for H in (200, 500, 1000, 2000, 5000, 10_000, 20_000):
        start = stretched(case.problem, H)
        assert [line.alpha for line in solve(*start, options=settings).trace] == [1.0] * 3
        seconds = cpu(lambda start=start: solve(*start, options=settings), 5)
        print(f"  H = {H:6d}  {1e3 * seconds:9.3f} ms  {1e6 * seconds / H:6.3f} us a step")


def network(n, m=4, H=300):
    """Return a problem with a chain of n coupled states."""
    from grounded.compile import Problem, system_of

    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n)) / n * (np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 1)
    B = rng.normal(size=(n, m))
    states, inputs = [f"x{i}" for i in range(n)], [f"u{j}" for j in range(m)]

    def rate(s, a, p):
        x, u = np.array([s[k] for k in states]), np.array([a[k] for k in inputs])
        return dict(zip(states, A @ np.sin(x) - x + B @ u, strict=True))

    system = system_of(
        rate, kind="derivative", states=states, inputs=inputs, params=(), integrator="rk4"
    )
    free, zeros = np.full(m, np.inf), np.zeros
    return Problem(
        system, p=zeros(0), dt=0.02, start=np.ones(n), past=zeros(m), delay=zeros(m),
        bias=zeros((H, n)), target=zeros((H + 1, n)), state_weight=np.ones((H + 1, n)),
        input_target=zeros((H, m)), input_weight=np.ones(m), change_weight=np.ones(m),
        low=-free, high=free, angles=zeros(n, bool),
    )  # fmt: skip


def size_part(options):
    from grounded.solve.ddp import solve

    print("\nCPU of a whole solve against the state (a chain, m = 4, H = 300)")
    for n in (4, 8, 12, 16, 24, 32, 40):
        problem = network(n)
        u = np.zeros((300, 4))
        start = time.process_time()
        result = solve(problem, u)
        first = time.process_time() - start
        ms = 1e3 * cpu(lambda p=problem, u=u: solve(p, u), 5)
        turns = f"{len(result.trace)} iterations"
        print(f"  n = {n:3d}  {ms:8.3f} ms  {turns}; first call {first:.2f} s")


def swarm_part(options):
    from cases import cases

    from grounded.compile import DescentOptions
    from grounded.solve.ddp import solve

    case, rng = cases(["car"])[0], np.random.default_rng(0)
    p = case.problem.p
    models = [p * rng.uniform(0.95, 1.05, len(p)) for _ in range(1000)]

    def all_of_them():
        for values in models:
            problem = dataclasses.replace(case.problem, p=values)
            solve(problem, case.u, options=DescentOptions(tolerance=1e-6))

    print(f"\n1000 perturbed cars solved in one process: {cpu(all_of_them, 3):.3f} s of CPU")


def memory_part(options):
    code = (
        "import resource, sys; sys.path[:0] = sys.argv[1:]\n"
        "import numpy as np\nfrom cases import cases\nfrom run import stretched\n"
        "from grounded.compile import DescentOptions\nfrom grounded.solve.ddp import solve\n"
        "case = cases(['aircraft'])[0]\n"
        "solve(*stretched(case.problem, 20_000), options=DescentOptions(max_iterations=10))\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    )
    command = [sys.executable, "-c", code, str(HERE), str(HERE.parent)]
    peak = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    print(f"\nPeak memory of a process that solves H = 20,000, n = 16: {float(peak):.0f} MB")


def spent(command, environment):
    """Return the CPU seconds of a process and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, env=environment, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def process_part(options):
    """Time whole processes: `grounded propose` on the aircraft, cold and warm, and importing.

    Cold: no kernel in the cache. Python's own compiled modules are always there, as after the
    installation of a package.
    """
    python = sys.executable
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"GROUNDED_CACHE": str(Path(folder) / "cache")}
        environment |= {"PYTHONPYCACHEPREFIX": str(Path(folder) / "pyc")}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        bare = min(spent([python, "-c", "pass"], environment) for _ in range(5))
        print(f"\nWhole processes, CPU seconds (bare python: {bare:.3f})")
        imported = min(
            spent([python, "-c", "import grounded_cli.main"], environment) for _ in range(5)
        )
        print(f"  import grounded_cli.main    {imported:.3f}  ({imported - bare:.3f} over bare)")
        made = Path(folder) / "flight"

        def grounded(*words):
            return spent([python, "-m", "grounded_cli.main", *words, "-C", str(made)], environment)

        def proposed(identity):
            for old in (made / "candidates").glob(f"{identity}*"):
                old.unlink()  # or the outstanding one is proposed again
            return grounded("propose")

        init = [python, "-m", "grounded_cli.main", "init", str(made), "--example", "flight-figure8"]
        subprocess.run(init, check=True, capture_output=True, env=environment)
        proposed("c0001")
        environment["GROUNDED_CACHE"] = str(Path(folder) / "empty")
        print(f"  propose, first policy, cold {proposed('c0001'):.3f}")
        print(f"  propose, first policy, warm {min(proposed('c0001') for _ in range(7)):.3f}")
        grounded("run")
        grounded("ingest", *map(str, (made / "runs").glob("*.mcap")))
        proposed("c0002")
        print(f"  propose, improvement, warm  {min(proposed('c0002') for _ in range(7)):.3f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peers", help="a Python that has the peers")
    parser.add_argument("--fatrop", action="store_true", help="CasADi's fatrop too (slow to build)")
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}")
    options = parser.parse_args()
    sys.path[:0] = [str(HERE.parent / folder) for folder in ("", "cli", "trials")]
    import llvmlite

    versions = f"NumPy {np.__version__}, llvmlite {llvmlite.__version__}"
    machine = platform.processor() or platform.machine()
    print(f"Python {platform.python_version()}, {versions}, {machine}")
    for part in options.parts or PARTS:
        globals()[f"{part}_part"](options)


if __name__ == "__main__":
    main()
