"""The library of all families: effects that apply to a model, and effects by name.

Third parties add families by the entry point group `grounded.effects` (read once, by the command
line's options.py); here a library is a plain value.

In addition to the families of the other modules there is `parameter`, p = nominal + d: the model
has the right equations, and one of its own parameters differs from its nominal value.

If two effects are equivalent in a model, only the more specific one is a candidate. A constant rate
of a state may equal a bias of an input, or a parameter of the model; a gain of a rate may equal a
time constant or a wheelbase. Such rate effects are dropped (`aliases`):

    offset:s, rate_gain:s   dropped if   d rate / d p  or  d rate / d u   is k times its own rate

    rate_gain:q             dropped if   q' = c w, and nothing depends on q: sensor_scale:q

at many random states and inputs, and at other values of the parameters, too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from grounded import places
from grounded.checks import refused, unknown
from grounded.effects import actuator, elastic, geometry, joint, medium, rate, sensor
from grounded.effects.drive import speed_weights
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
    Site,
    parallel,
)
from grounded.effects.sensed import moved_model
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import derived_states, outright_states


def _shift(site: Site) -> tuple[Quantity, ...]:
    param = site.model.params[site.target]
    low, high = param.reach
    return (Quantity("d", param.unit, low=low - param.value, high=high - param.value),)


parameter = ParamFamily(
    name="parameter",
    equation="p = nominal + d",
    sentence="the parameter {target} is off by {d}",
    targets=lambda model: model.uncertain,
    quantities=_shift,
    lookalikes=("input_gain", "rate_gain", "viscous_friction", "first_order_lag"),
)

BUILT_IN: tuple[Family, ...] = (
    *actuator.FAMILIES,
    *joint.FAMILIES,
    *elastic.FAMILIES,
    *rate.FAMILIES,
    *rate.FRICTION,
    *geometry.FAMILIES,
    *medium.FAMILIES,
    *sensor.FAMILIES,
    parameter,
)


@dataclass(frozen=True)
class Library:
    """Families by name; `with_families` and `without` give other libraries."""

    families: tuple[Family, ...] = BUILT_IN

    def __post_init__(self) -> None:
        names = [family.name for family in self.families]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise refused("given.twice", "the effect families", name=twice[0])

    def with_families(self, more: Iterable[Family]) -> Library:
        """Return a library that also has these families."""
        return Library((*self.families, *more))

    def without(self, names: Iterable[str]) -> Library:
        """Return a library without these families."""
        gone = [self.family(name) for name in set(names)]
        return Library(tuple(family for family in self.families if family not in gone))

    def family(self, name: str) -> Family:
        """Return the family of that name."""
        for family in (
            *self.families,
            rate.correction,
        ):  # adopted, but never blamed
            if family.name == name:
                return family
        known = [family.name for family in self.families]
        raise unknown("effect family", name, known)

    def effect(self, name: str, model: Model, scales: Scales | None = None) -> Effect:
        """Return the effect `family:target` at a model; of joint inputs, any several will do."""
        family_name, _, target = name.partition(":")
        family = self.family(family_name)
        known = list(family.targets(model))
        if target not in known and not _part_of(family, target, known):
            there = [f"{family_name}:{t}" for t in known]
            raise unknown("effect", name, there, f"model '{model.name}'")
        return _build(family, target, model, scales or Scales())

    def candidates(self, model: Model, scales: Scales | None = None) -> tuple[Effect, ...]:
        """Return every effect that can apply to a model, in the library's order."""
        found, offered = [], [family.name for family in self.families]
        whole, model = model, moved_model(model)
        idle, outright = derived_states(model), outright_states(model)
        integrals = places.integrated(model)
        geometric = set(integrals) - set(places.velocities(model))
        pulled = f"{places.heading(model)}<-{places.speed(model)}"  # by unequal wheels
        same = aliases(model, idle | outright) | joint.renamed(model) | medium.renamed(model)
        scaled = set(sensor.sensor_scale.targets(model)) & {*places.only_read(model)}
        same |= {f"rate_gain:{name}": f"sensor_scale:{name}" for name in scaled}
        for family in self.families:
            moves = isinstance(family, LossFamily | MediumFamily | RateFamily)
            where = model if moves else whole
            for target in family.targets(where):
                driven = target.partition("<-")
                if isinstance(family, RateFamily) and {driven[0], driven[2]} & idle:
                    continue
                if isinstance(family, RateFamily) and family.needs_own and target in outright:
                    continue
                if driven[2] and integrals.get(driven[0], ("",))[0] == driven[2]:
                    continue  # equivalent to rate_gain
                if family in rate.ADDED and driven[0] in geometric and target != pulled:
                    continue
                if same.get(f"{family.name}:{target}", "").partition(":")[0] in offered:
                    continue
                found.append(_build(family, target, where, scales or Scales()))
        return tuple(found)

    def joints(self, model: Model, scales: Scales | None = None) -> tuple[Effect, ...]:
        """Return the plain dry friction of every joint, even where `candidates` has an alias."""
        family = joint.joint_friction
        if family not in self.families:
            return ()
        model = moved_model(model)
        targets = family.targets(model)
        return tuple(_build(family, target, model, scales or Scales()) for target in targets)


def _part_of(family: Family, target: str, known: Iterable[str]) -> bool:
    """Check whether a target is several of the inputs that the family takes, in their order."""
    if not isinstance(family, InputFamily | MemoryFamily):
        return False
    parts = target.split("+")
    each = dict.fromkeys(name for one in known for name in one.split("+"))
    return len(parts) > 1 and parts == [name for name in each if name in parts]


def _build(family: Family, target: str, model: Model, scales: Scales) -> Effect:
    return family.at(Site(model, tuple(target.split("+")), scales))


SAMPLES = 40
PARAMETER_FACTOR = 1.3  # factor on the parameters for the second comparison


def aliases(model: Model, idle: Iterable[str] = ()) -> dict[str, str]:
    """Return {dropped: kept} of equivalent rate effects; `idle` states have no dynamics."""
    rng, n = np.random.default_rng(0), model.n
    x, u = rng.uniform(-1, 1, (SAMPLES, n)), rng.uniform(-1, 1, (SAMPLES, model.m))
    kept = [i for i, name in enumerate(model.state_names) if name not in set(idle)]
    found: dict[str, str] = {}
    beside = np.where(model.values == 0, 0.1, PARAMETER_FACTOR * model.values)
    here, there = (_Rates(model, x, u, p, kept) for p in (model.values, beside))
    for name, own in here.named.items():
        for other, slope in here.slopes.items():
            same = parallel(slope, own) and parallel(there.slopes[other], there.named[name])
            if same and name not in found and _free(model, other):
                found[name] = other
    return found


class _Rates:
    """Rates (SAMPLES, n) that rate effects add, and slopes of the model's rates, by effect name."""

    def __init__(self, model: Model, x: Array, u: Array, p: Array, kept: list[int]) -> None:
        dt = places.probe(model, places.INSTANT_S)
        own = (model.system.step(x, u, p, dt) - x) / dt
        _, f_u, f_p = model.system.sensitivities(x, u, p, dt)
        self.named: dict[str, Array] = {}
        for i in kept:
            one = np.zeros_like(own)
            one[:, i] = 1.0
            name = model.state_names[i]
            self.named |= {
                f"offset:{name}": one[:, kept],
                f"rate_gain:{name}": (one * own)[:, kept],
            }
        for pair in joint.pairs_of(model):  # such as the mass of a cart
            tau, weights = pair.partition("<-")[0], speed_weights(model, pair)
            rates = (k * own[:, [model.state_names.index(n)]] for n, k in weights.items())
            by, rate = f_u[:, :, model.input_names.index(tau)], sum(rates)
            self.named[f"added_inertia:{pair}"] = (by * rate)[:, kept]
        for pair in joint.springs_of(model):  # such as a stiffness that is a parameter
            tau, _, q = pair.partition("<-")
            by, at = f_u[:, :, model.input_names.index(tau)], x[:, [model.state_names.index(q)]]
            self.named[f"joint_spring:{pair}"] = (by * at)[:, kept]
        inputs = {f"input_bias:{n}": f_u[:, kept, j] for j, n in enumerate(model.input_names)}
        params = {f"parameter:{n}": f_p[:, kept, k] for k, n in enumerate(model.param_names)}
        self.slopes = inputs | params


def _free(model: Model, name: str) -> bool:
    """Check whether a parameter may halve and double, so that it can replace an effect."""
    family, _, target = name.partition(":")
    if family != "parameter":
        return True
    param = model.params[target]
    if not param.uncertain:
        return False
    low, high = param.reach
    ends = (0.5 * param.value, 2 * param.value) if param.value else (-0.05, 0.05)
    return bool(low <= min(ends) and high >= max(ends))
