"""Unmodelled effects, one family a file; `Library` lists them, `wrap` adds one to a model."""

from __future__ import annotations

from grounded.effects.family import (
    Effect,
    Family,
    InputFamily,
    MemoryFamily,
    ParamFamily,
    Quantity,
    RateFamily,
    Scales,
    SensorDelayFamily,
    SensorFamily,
    Site,
    scales_of,
)
from grounded.effects.memory import memory_of, memory_start
from grounded.effects.registry import Library
from grounded.effects.wrap import acting_order, param_name, wrap, wrapping_order

__all__ = [
    "Effect",
    "Family",
    "InputFamily",
    "Library",
    "MemoryFamily",
    "ParamFamily",
    "Quantity",
    "RateFamily",
    "Scales",
    "SensorDelayFamily",
    "SensorFamily",
    "Site",
    "acting_order",
    "memory_of",
    "memory_start",
    "param_name",
    "scales_of",
    "wrap",
    "wrapping_order",
]
