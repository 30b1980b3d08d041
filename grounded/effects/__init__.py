"""Unmodelled effects: what a model may lack, one family of physics a file.

Read `family` first (what an effect is), then any of the families: `actuator`, `joint`, `friction`,
`rate`, `geometry`, `medium`, `sensor`. `places` says where in a model they can act. `registry` has
the `Library` of all families: what of it applies to a model, and the way from a name to its effect.
`wrap` adds an effect to a model, which is then a plain model again, inside what it has got already;
`order` says which of several is wrapped first; `sensed` keeps late logs apart from the true values
that move. A new family is a value in one of these files, or comes from a package of your own
by the entry point group `grounded.effects`.
"""

from __future__ import annotations

from grounded.effects.family import (
    Effect,
    Family,
    InputFamily,
    LossFamily,
    MediumFamily,
    MemoryFamily,
    ParamFamily,
    Quantity,
    RateFamily,
    Scales,
    SensorDelayFamily,
    SensorFamily,
    SensorLagFamily,
    Site,
    scales_of,
)
from grounded.effects.joint import like_a_load, one_friction
from grounded.effects.memory import memory_of, memory_start
from grounded.effects.order import acting_order, wrapping_order
from grounded.effects.plain_step import param_name
from grounded.effects.registry import Library
from grounded.effects.wrap import wrap

__all__ = [
    "Effect",
    "Family",
    "InputFamily",
    "Library",
    "LossFamily",
    "MediumFamily",
    "MemoryFamily",
    "ParamFamily",
    "Quantity",
    "RateFamily",
    "Scales",
    "SensorDelayFamily",
    "SensorFamily",
    "SensorLagFamily",
    "Site",
    "acting_order",
    "like_a_load",
    "memory_of",
    "memory_start",
    "one_friction",
    "param_name",
    "scales_of",
    "wrap",
    "wrapping_order",
]
