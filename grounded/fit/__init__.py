"""Parameters of any model from trials, with intervals.

    fit                parameters, latencies and thresholds by maximum likelihood
    prediction_error   one step and a second ahead, open loop

Read `parameters` first (the front door), then `search` (what is moved in turn), `gauss_newton` (the
climb), `point` (the likelihood and its slopes), `unknowns`, `result` (values and intervals),
`prediction`. The likelihood is that of `grounded.estimate`.
"""

from __future__ import annotations

from grounded.fit.parameters import fit
from grounded.fit.prediction import PredictionError, prediction_error
from grounded.fit.result import Fit, FittedValue

__all__ = ["Fit", "FittedValue", "PredictionError", "fit", "prediction_error"]
