"""Estimate the parameters of a model from trials, with confidence intervals.

    fit                parameters, latencies and thresholds by maximum likelihood
    prediction_error   one step and a second ahead, open loop

Read `parameters` first (the function `fit`), then `search` (the alternating search), `gauss_newton`
(the optimiser), `point` (the likelihood and its derivatives), `unknowns`, `result` (values and
intervals), `prediction`. The likelihood is that of `grounded.estimate`.
"""

from __future__ import annotations

from grounded.fit.parameters import fit
from grounded.fit.prediction import PredictionError, prediction_error
from grounded.fit.result import Fit, FittedValue

__all__ = ["Fit", "FittedValue", "PredictionError", "fit", "prediction_error"]
