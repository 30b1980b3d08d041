"""Estimate the parameters of a model from trials, with confidence intervals.

A fit is a diagnosis without candidates: its data, its likelihood, its held-out errors and its
notion of what trials identify are those of `grounded.diagnosis`. Read `parameters` (the function
`fit`), then `result`.
"""

from __future__ import annotations

from grounded.fit.parameters import fit
from grounded.fit.result import Fit, FittedValue

__all__ = ["Fit", "FittedValue", "fit"]
