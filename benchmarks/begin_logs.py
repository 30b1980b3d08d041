"""Run `init --from` on every log in a folder; print the table of docs/log-reference.md.

Run by hand, in a clone: python benchmarks/begin_logs.py FOLDER. A signal is found, with reasons,
or asked for if unsure (with a guess and its rivals), or nothing in the log fits.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from grounded.errors import GroundedError
from grounded_trials.logs.inspection.guess import Guess
from grounded_trials.starting.begin import begin


def main() -> None:
    """Print a row for each log."""
    top = Path(sys.argv[1])
    print("| log | kind | found | asked: guess (rivals) | nothing fits |\n|---|---|---|---|---|")
    for path in sorted(p for p in top.rglob("*") if p.suffix in (".npz", ".mcap", ".db3", ".csv")):
        if "conformance" in path.parent.parent.name:
            continue
        with tempfile.TemporaryDirectory() as folder:
            try:
                found = begin(Path(folder) / "w", path)
            except GroundedError as error:
                print(f"| {path.name} | refused | {str(error).split(': ', 1)[-1]} | | |")
                continue
        guesses = (*found.states, *found.inputs)
        cells = (
            named([g for g in guesses if g.sure]),
            named([g for g in guesses if not g.sure and (g.path or g.others)]),
            " ".join(g.name for g in guesses if not g.path and not g.others),
        )
        print(f"| {path.name} | {found.kind} | {' | '.join(cells)} |", flush=True)


def named(guesses: Sequence[Guess]) -> str:
    """Return names with the ends of their paths."""
    rivals = [f" ({len(g.others)})" if g.others else "" for g in guesses]
    texts = [f"{g.name} `{g.path[-28:] or '?'}`" for g in guesses]
    return ", ".join(text + more for text, more in zip(texts, rivals, strict=True))


if __name__ == "__main__":
    main()
