"""The model is right in form: one of its own parameters differs from its nominal value.

p = nominal + d
"""

from __future__ import annotations

import numpy as np

from grounded.effects.family import ParamFamily, Quantity, Site


def _shift(site: Site) -> tuple[Quantity, ...]:
    param = site.model.params[site.target]
    low = -np.inf if param.low is None else param.low - param.value
    high = np.inf if param.high is None else param.high - param.value
    return (Quantity("d", param.unit, low=low, high=high),)


parameter = ParamFamily(
    name="parameter",
    equation="p = nominal + d",
    sentence="the parameter {target} is off by {d}",
    targets=lambda model: model.param_names,
    quantities=_shift,
    lookalikes=("input_gain", "rate_gain", "viscous_friction", "first_order_lag"),
)

FAMILIES = (parameter,)
