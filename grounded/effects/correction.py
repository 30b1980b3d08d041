"""`correction`, a smooth curve added to a state's rate. It is never a candidate for a cause.

    s' = model + sum_k w_k g_k(r) / sum_k g_k(r)   (s<-r)

with Gaussian bells g_k at KNOTS points from lo to hi, constant beyond them. A diagnosis fits it to
what no effect explains (`grounded.diagnosis.hypotheses.leftover`). Once adopted, it is part of
the model like any effect.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.effects.family import (
    Quantity,
    RateFamily,
    Site,
    Values,
    coupled,
    from_source,
)
from grounded.result import per_second

KNOTS = 7
WIDTH = 0.7  # standard deviation of a bell, in distances between knots


def bells(r: Any, lo: Any, hi: Any) -> list[Any]:
    """Return the KNOTS normalised basis functions at r, which sum to 1."""
    apart = (hi - lo) / (KNOTS - 1)
    inside = np.minimum(np.maximum(r, lo), hi)
    found = [
        np.exp(-0.5 * ((inside - lo - k * apart) / (WIDTH * apart)) ** 2) for k in range(KNOTS)
    ]
    total = sum(found)
    return [one / total for one in found]


def _targets(model: Any) -> list[str]:
    sources = [*model.state_names, *model.input_names]
    return [f"{s}<-{r}" for s in model.state_names for r in sources]


def _quantities(site: Site) -> tuple[Quantity, ...]:
    target, source = coupled(site)
    ends = [Quantity(n, site.unit(source), fixed=True) for n in ("lo", "hi")]
    unit = per_second(site.unit(target))
    return (*ends, *[Quantity(f"w{k}", unit, fixed=True) for k in range(KNOTS)])


def _rate(s: Any, a: Any, own: Any, t: Any, c: Any, site: Site) -> Values:
    values = bells(from_source(s, a, site), c["lo"], c["hi"])
    return {coupled(site)[0]: sum(c[f"w{k}"] * g for k, g in enumerate(values))}


correction = RateFamily(
    name="correction",
    equation="s' = model + curve(r)   (s<-r)",
    sentence="{driven} lacks a rate that depends on {source}: a correction, not a cause",
    targets=_targets,
    quantities=_quantities,
    rate=_rate,
)
