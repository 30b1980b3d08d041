"""The blind challenge: generated cases with sealed labels, and the scoring of diagnoses.

    for case in make("single", 200, seed): write its trials; seal its label elsewhere
    judge(label, diagnosis, oracle(...)), summary(marks)

Read `cases` first (what a case is and how it is drawn), then `systems` (the simulated systems),
`draws` (effects, from the library and outside it), `truth` (the simulated real system), `mechanism`
(the same in MuJoCo), `score` (oracle and marks). Nothing in `grounded.diagnosis` imports this
folder, so that a diagnosis can't reach the truth.
"""

from __future__ import annotations

from grounded.challenge.cases import KINDS, Case, make, sealed
from grounded.challenge.score import Oracle, judge, of_crude, oracle, summary

__all__ = [
    "KINDS",
    "Case",
    "Oracle",
    "judge",
    "make",
    "of_crude",
    "oracle",
    "sealed",
    "summary",
]
