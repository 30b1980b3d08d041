"""Run attacks on files, folders and commands and print what was tried and what broke.

Run by hand, in a clone: python benchmarks/attack.py [--seconds 60] [--seed 0] [--only NAME].
The seconds are for each attack. Exits with 1 if anything broke.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))


def main() -> None:
    """Print a row for each attack, and what broke."""
    from attacks import ATTACKS, KINDS, apart

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=ATTACKS)
    given = parser.parse_args()
    heads = {"silent": "silently wrong", "traceback": "tracebacks"}
    heads |= {"hang": "over 10 s", "memory": "over 1 GB"}
    print(f"| tried | times | {' | '.join(heads[k] for k in KINDS)} |\n|---|---|" + "---|" * 4)
    failures: list[str] = []
    for name in [given.only] if given.only else list(ATTACKS):
        tally = apart(name, given.seed, given.seconds)
        counts = " | ".join(str(len(tally.broken[kind])) for kind in KINDS)
        print(f"| {name} | {tally.tries} | {counts} |", flush=True)
        failures += [f"{name}: {failure}" for failure in tally.failures]
    print("\n".join(["", *failures[:40]]))
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
