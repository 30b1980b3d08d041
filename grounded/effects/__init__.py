"""Unmodelled effects that a model may lack, one file per kind of physics.

Read `family` first, which defines an effect, then any of the kinds: `actuator`, `joint`,
`rate`, `geometry`, `medium`, `sensor`. `grounded.places` finds where effects can act.
`registry` has the `Library` of all families: it lists the effects that apply to a model and builds
an effect from its name. `wrap` adds an effect to a model and returns a plain model again; `sensed`
handles delayed logs beside true values. A new family is a value in one of these files, or comes
from your own package by the entry point group `grounded.effects`.
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
    acting_order,
    joining_order,
    scales_of,
    wrapping_order,
)
from grounded.effects.joint import one_friction
from grounded.effects.memory import memory_of, memory_start
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
    "joining_order",
    "memory_of",
    "memory_start",
    "one_friction",
    "param_name",
    "scales_of",
    "wrap",
    "wrapping_order",
]
