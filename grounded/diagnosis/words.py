"""What a diagnosis says in words: an effect, the verdict, what to do in the next trial."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

from grounded.diagnosis.lookalike import Likeness
from grounded.diagnosis.report import Estimate, number, quantity
from grounded.effects import Effect, ParamFamily, places
from grounded.model import Model

HINTS = {
    "dead_zone": "sweep it slowly through zero and hold small commands",
    "stall": "sweep it slowly through zero and hold small commands",
    "stiction": "start and stop often, from small commands",
    "coulomb_friction": "coast down from different speeds",
    "viscous_friction": "hold several speeds, slow and fast",
    "quadratic_drag": "hold several speeds, slow and fast",
    "delay": "step the input sharply, by different amounts",
    "first_order_lag": "step the input sharply, by different amounts",
    "rate_limit": "step the input by small and large amounts",
    "slew_limit": "step the input by small and large amounts",
    "input_bias": "use commands of both signs and of different size",
    "input_gain": "use small and large commands",
    "input_fade": "repeat the same manoeuvre early and late in one trial",
    "understeer": "drive the same curve slowly and fast",
    "rate_gain": "drive the same curve slowly and fast",
    "sensor_bias": "start from different headings and reverse direction",
    "patch": "cross the same places at other speeds and directions",
    "slope": "drive the same way in several headings",
}

GREEK = (
    "alpha|beta|gamma|delta|epsilon|zeta|eta|theta|iota|kappa|lambda|mu|nu|xi|omicron|pi|rho|sigma"
    "|tau|upsilon|phi|chi|psi|omega"
)


def called(model: Model, name: str) -> str:
    """A state or an input in a sentence: `the speed v`, `the state delta`, `the throttle`.

    Symbols get a word before them: what is short, Greek, or not letters alone.
    """
    roles = {
        "speed": (places.speed(model),),
        "heading": places.role(model, "heading"),
        "heading rate": places.role(model, "heading_rate"),
        "position": places.position(model),
        "angle": model.angles,
    }
    word = next((role for role, played in roles.items() if name in played), "")
    if not word and (len(name) <= 3 or re.fullmatch(GREEK, name) or not name.isalpha()):
        word = "input" if name in model.input_names else "state"
    return f"the {name}" if not word or name == word else f"the {word} {name}"


def meaning(effect: Effect, params: Mapping[str, Estimate]) -> str:
    """The family's sentence with names and numbers filled in; starts with a small letter."""
    model, targets = effect.site.model, effect.site.targets
    words: dict[str, str] = {name: quantity(e) for name, e in params.items()}
    words.setdefault("s", "s" if len(targets) == 1 else "")
    driven, _, source = effect.site.target.partition("<-")
    words["target"] = " and ".join(called(model, n) for n in targets)
    if isinstance(effect.family, ParamFamily):
        words["target"] = effect.site.target
    words |= {"driven": called(model, driven), "source": called(model, source)}

    def filled(found: re.Match[str]) -> str:
        name, percent, more, less = found.groups()
        if percent is None or name not in params:
            return words.get(name, found.group(0))
        value = 100 * params[name].value
        if more is None:
            return f"{number(value)} %"
        return f"{number(abs(value))} % {more if value >= 0 else less}"

    return re.sub(r"\{(\w+)(%)?(?:([^{}|]+)\|([^{}|]+))?\}", filled, effect.family.sentence)


def sentence(clauses: Iterable[str]) -> str:
    """Clauses as one sentence: first word capital (never a name: `called` puts a word before)."""
    text = "; ".join(clauses)
    return f"{text[:1].upper()}{text[1:]}."


def improvement(before: float, after: float) -> str:
    """What held-out predictions gained."""
    verb = "improve" if after < before else "go"
    return f"Held-out predictions {verb} from {number(before)} to {number(after)} times the noise."


def tied(group: Sequence[str]) -> str:
    """`A from B or C`."""
    return f"{group[0]} from {' or '.join(group[1:])}"


def nearly(alike: Sequence[Likeness]) -> str:
    """Which other effects would do nearly the same."""
    parts = []
    for name in dict.fromkeys(one.effect for one in alike):
        others = [
            f"{a.like} ({100 * a.share:.0f} % of its signal)" for a in alike if a.effect == name
        ]
        parts.append(f"{name} is nearly inseparable from {', '.join(others)}")
    return f"In these trials {'; '.join(parts)}."


def distinguishing(group: Sequence[str]) -> list[str]:
    """What to do in a trial that tells a group apart, in sentences."""
    found = []
    for name in group:
        family, _, target = name.partition(":")
        hint = HINTS.get(family)
        text = f"{hint[0].upper()}{hint[1:]} ({target})." if hint else ""
        if text and text not in found:
            found.append(text)
    return found or ["Excite every input over its whole range."]
