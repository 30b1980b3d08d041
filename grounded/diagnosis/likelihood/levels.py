"""The two levels that a diagnosis asks of evidence and of a standard error, wherever it does.

`benchmarks/decide.py --curves` shows what other levels would name.
"""

from __future__ import annotations

NATS = 3.0  # of evidence, from which one explanation is preferred; within it two tie
SURE = 2.0  # standard errors, from which a value differs from zero or one prediction is better
