"""grounded: learn a manoeuvre on a real system from a crude model and a handful of trials.

Abbeel, Quigley & Ng, "Using Inaccurate Models in Reinforcement Learning", ICML 2006.
Start reading in `grounded.search.improve`.
"""

from __future__ import annotations

from grounded.errors import GroundedError
from grounded.model import Model, Param
from grounded.policy import Policy
from grounded.trial import Trial

__version__ = "0.2.0"

__all__ = ["GroundedError", "Model", "Param", "Policy", "Trial", "__version__"]
