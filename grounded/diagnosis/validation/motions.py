"""Values of adopted effects that the trials of one group can't determine are held."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from grounded.diagnosis.likelihood.data import Data
from grounded.effects import Library, param_name
from grounded.model import Model, Param


def without_others(data: Data, adopted: Collection[str], library: Library) -> Model:
    """Return the model with the values of adopted effects held that one motion can't determine.

    These are effects without a mechanism, if all trials are of one group: their values were found
    from other trials.

    Args:
        data: the trials.
        adopted: names of the adopted effects, whose values are parameters of the model.
        library: source of the effects.
    """
    model, held = data.model, set[str]()
    for name in adopted if len(data.groups) == 1 < data.count else ():
        of, _, target = name.partition(":")
        family = library.family(of)
        if family.loose and target in family.targets(model):
            effect = library.effect(name, model, data.scales)
            held |= {param_name(name, q.name) for q in effect.quantities}
    params = {n: Param(p.value, p.unit) if n in held else p for n, p in model.params.items()}
    return replace(model, params=params) if held else model
