"""Run the foreign bench.

    python -m benchmarks.foreign [--only NAME] [--json] [--optimum] [--adopt N] [--list]

Needs mujoco, jsbsim, commonroad-vehicle-models, and the packages gymnasium, dm_control, robosuite
for the files that they ship (`pip install --no-deps` does); set-ups of a missing one are skipped
with a note.
"""

from __future__ import annotations

import argparse
import json
import sys

from benchmarks.foreign.optimum import optimum, remember
from benchmarks.foreign.setups import SETUPS, setup
from benchmarks.foreign.study import measured, results


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.foreign", description=__doc__)
    parser.add_argument("--only", action="append", help="set-ups whose names begin so")
    parser.add_argument("--json", action="store_true", help="one JSON document on stdout")
    parser.add_argument("--optimum", action="store_true", help="compute optima.json, which is slow")
    parser.add_argument("--adopt", type=int, default=0, help="diagnose after so many trials")
    parser.add_argument("--list", action="store_true", help="the names")
    asked = parser.parse_args()
    names = [n for n in SETUPS if not asked.only or n.startswith(tuple(asked.only))]
    if asked.list or not names:
        print("\n".join(SETUPS))
        return 0 if names else 2
    rows = []
    for name in names:
        try:
            one = setup(name)
        except ImportError as error:
            say(f"{name}: left out, {error}")
            continue
        say(f"{name}: {one.withheld} withheld ...")
        if asked.optimum:
            remember(name, *optimum(one, say))
        else:
            rows.append(measured(one, asked.adopt))
            say(results(rows[-1:]).splitlines()[-1])
    if asked.json:
        print(json.dumps([row.to_json() for row in rows], indent=1))
    elif rows:
        print(results(rows))
    return 0


def say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


sys.exit(main())
