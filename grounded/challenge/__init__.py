"""The blind challenge: cases whose answer is sealed, and the marks of a diagnosis.

    for case in make("single", 200, seed): write its trials; seal its label elsewhere
    judge(label, diagnosis, oracle(...)), summary(marks)

Nothing in `grounded.diagnosis` outside this folder imports it: the diagnosis can't reach the truth.
"""

from __future__ import annotations

from grounded.challenge.cases import KINDS, Case, make, sealed
from grounded.challenge.score import Oracle, judge, oracle, study, summary, task_of

__all__ = [
    "KINDS",
    "Case",
    "Oracle",
    "judge",
    "make",
    "oracle",
    "sealed",
    "study",
    "summary",
    "task_of",
]
