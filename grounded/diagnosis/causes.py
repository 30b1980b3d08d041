"""A cause in the words of its effect's family, with its values and their +-."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from grounded.diagnosis.levels import ALIKE, SURE
from grounded.diagnosis.parts import Estimate, TrialValue
from grounded.result import listed, number, with_unit

if TYPE_CHECKING:  # whoever reads a diagnosis needs none of what makes it
    from grounded.effects import Effect


def meaning(effect: Effect, params: Mapping[str, Estimate]) -> str:
    """Fill names and values into the sentence of an effect's family; starts in lower case."""
    from grounded.effects import ParamFamily

    family, site = effect.family, effect.site
    if "d" in params and isinstance(family, ParamFamily) and site.target in site.model.params:
        own = site.model.params[site.target]
        return _changed(site.target, params["d"], own.value, own.unit)
    if "d" in params and effect.known:
        return _changed(effect.name, params["d"], effect.quantities[0].known, "s")
    constants = {q.name: Estimate(q.start, 0.0, None, q.unit) for q in effect.quantities if q.fixed}
    words = _words(effect, {**constants, **params})
    # a part is left out if its quantities are zero, or not known
    told = {n for n, e in params.items() if e.value != 0 and not abs(e.value) <= SURE * e.std}
    told |= {n for n, e in constants.items() if e.value}

    def kept(match: re.Match[str]) -> str:  # parts whose quantities are estimated and not zero
        parts = match[1].split(" & ")
        some = [p for p in parts if {*re.findall(r"\{(\w)[%}]", p)} <= told]
        return listed(some or (parts[1:] and parts[:1]))

    def signed(match: re.Match[str]) -> str:
        name, positive, negative = match.groups()
        less = name in params and params[name].value < 0
        if less:
            words[name] = words[name].removeprefix("-")
        return negative if less else positive

    def filled(match: re.Match[str]) -> str:
        name, percent, more, less = match.groups()
        if percent is None or name not in params:
            return words.get(name, match.group(0))
        value = 100 * family.ratio(name, params[name].value)
        side = more if value >= 0 else less
        return f"{number(value)} %" if more is None else f"{number(abs(value))} % {side}"

    turned = family.turned if acts_reversed(params) else ""
    text = re.sub(r"\[([^]]*)\]", kept, turned or family.sentence)
    text = re.sub(r"\{(\w+)>([^{}|]+)\|([^{}|]+)\}", signed, text)
    return re.sub(r"\{(\w+)(%)?(?:([^{}|]+)\|([^{}|]+))?\}", filled, text)


def in_words(sentence: str, target: str = "") -> str:
    """Return a family's sentence at a target, "" for any: <names> for values, both choices."""
    driven, _, source = target.partition("<-")
    words = {"target": target, "driven": driven, "source": source}
    words |= {"s": "s", "es": "es", "has": "has"}
    text = re.sub(r"[\[\]]", "", sentence.replace(" & ", " and "))
    text = re.sub(r"\{\w+>([^{}|]+)\|([^{}|]+)\}", r"\1 (or \2)", text)
    text = re.sub(r"\{(\w+)%([^{}|]+)\|([^{}|]+)\}", r"{\1} \2 (or \3)", text)
    return re.sub(r"\{(\w+)%?\}", lambda match: words.get(match[1]) or f"<{match[1]}>", text)


def _changed(name: str, by: Estimate, was: float, unit: str) -> str:
    return f"{name} = {by.moved(was).text}, was {with_unit(number(was), unit)}"


def _words(effect: Effect, known: Mapping[str, Estimate]) -> dict[str, str]:
    """Return words by slot of a family's sentence: the values, and the names they act on."""
    from grounded import places
    from grounded.effects.medium import factors

    site, targets = effect.site, effect.site.targets
    model, (driven, _, source) = site.model, site.target.partition("<-")
    words = {name: with_unit(number(e.value), e.unit) for name, e in known.items()}
    one = len(targets) == 1
    words.setdefault("s", "s" if one else "")
    centre = [name for name in places.position(model) if f"{name}0" in known]  # of a patch
    axes = [*model.roles.get("position", ())][:2]
    axes = axes if len(axes) == 2 else ["the first axis", "the second"]
    words |= {
        "has": "has" if one else "have",
        "es": "es" if one else "",
        "place": listed(f"{name} = {words[f'{name}0']}" for name in centre),
        "least": "near zero",
        "target": listed(targets),
        "driven": driven,
        "source": "its speed" if driven in model.inputs and not one else source,
        "axis_1": axes[0],
        "axis_2": axes[1],
    }
    if "L" in known and known["L"].value > 0:
        words["least"] = f"at {words['L']}, its smallest"
    if "{product}" in effect.family.sentence:
        words["product"] = " * ".join(factors(site))
    return words


def acts_reversed(params: Mapping[str, Estimate]) -> bool:
    """Return whether the values of an effect are a gain that reverses the sign."""
    return "g" in params and params["g"].value < -1


def sign_only(name: str, params: Mapping[str, Estimate]) -> bool:
    """Return whether an effect is an input of the wrong sign and of the modelled strength.

    Its sign is to be flipped; a reversed input of another strength is adopted.
    """
    gain = name.startswith("input_gain:") and acts_reversed(params)
    return gain and abs(-1 - params["g"].value - 1) < ALIKE


def furthest_apart(values: Sequence[TrialValue]) -> tuple[TrialValue, TrialValue]:
    """Return the two values that differ by most standard deviations, the smaller one first.

    The extremes are often values that a trial hardly determines, and prove nothing.
    """

    def apart(pair: tuple[TrialValue, TrialValue]) -> float:
        std = math.hypot(pair[0].std, pair[1].std)
        return abs(pair[1].value - pair[0].value) / std if std > 0 else 0.0

    low, high = max(itertools.combinations(values, 2), key=apart)
    return (low, high) if low.value <= high.value else (high, low)


def value_called(name: str, adopted: Iterable[str]) -> str:
    """Name a parameter of the model: `r`, or `d of delay:u` if it is an adopted effect's."""
    from grounded.effects import param_name

    effect = effect_of(name, adopted)
    return f"{name.removeprefix(param_name(effect, ''))} of {effect}" if effect else name


def effect_of(name: str, adopted: Iterable[str]) -> str:
    """Return the adopted effect that a parameter belongs to; "" if it is the model's own."""
    from grounded.effects import param_name

    of = [effect for effect in adopted if name.startswith(param_name(effect, ""))]
    return max(of, key=len, default="")
