"""How fast a state can move: a servo follows its command with a lag, but at a limited speed.

    s' = clip(model, -r, r)

Not `rate_limit`, which bounds the command before the lag: here the lag's own rate is bounded, so
large moves go at r until the target is near. It applies to states that follow an input by
themselves: their rate depends on themselves and on inputs alone and falls with the state. It acts
on the mean rate of each quarter of a step: the limit ends within a step where the target is near,
and a lag much shorter than a step is no trouble. A step that it does not touch is the model's own.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.effects import places
from grounded.effects.family import Quantity, RateFamily, Site, Values, per

PARTS = 4  # of a step


def _slew(site: Site) -> tuple[Quantity, ...]:
    spread = site.scales.spread(site.target)
    fastest = spread / site.scales.dt
    grid = tuple(float(v) for v in np.geomspace(0.5 * fastest, 0.1 * spread, 12))
    unit = per(site.unit(site.target))
    return (Quantity("r", unit, grid, 0.0, np.inf, start=2 * fastest, places=6),)


def _slew_rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    rate = own[site.target]
    return {site.target: np.minimum(np.maximum(rate, -c["r"]), c["r"]) - rate}


slew_limit = RateFamily(
    name="slew_limit",
    equation="s' = clip(model, -r, r)",
    sentence="{target} moves by at most {r}",
    targets=places.following,
    quantities=_slew,
    lookalikes=("rate_limit", "first_order_lag", "saturation"),
    rate=_slew_rate,
    needs_own=True,
    parts=PARTS,
)

FAMILIES = (slew_limit,)
