"""Call an exported policy's runner with random times and states; count exceptions and bad inputs.

Run by hand, with any Python from 3.8 on and NumPy: python benchmarks/fuzz_runner.py [CALLS] [SEED].
NumPy's floating-point errors and all warnings are raised. Exits with 1 if anything broke.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(HERE / "tests" / "support"))


def main() -> None:
    """Print what the calls led to."""
    from fuzzed_runner import fuzz

    calls, seed = ([int(word) for word in sys.argv[1:]] + [100_000, 0][len(sys.argv) - 1 :])[:2]
    with tempfile.TemporaryDirectory() as folder:
        found = fuzz(HERE / "grounded" / "onboard.py", Path(folder), calls, seed)
    raised = sum(found.raised.values())
    print(
        f"Python {sys.version.split()[0]}, NumPy {np.__version__}: {found.calls} calls, "
        f"{found.used} of them used: {raised} exceptions {dict(found.raised)}, "
        f"{len(found.outside)} outside the limits"
    )
    sys.exit(1 if raised or found.outside else 0)


if __name__ == "__main__":
    main()
