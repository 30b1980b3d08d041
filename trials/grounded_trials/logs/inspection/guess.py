"""Guess: the probable signal of a state or input, and several as [log] and [estimate]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from grounded.findings import Finding
from grounded.result import extent
from grounded_trials.formats.tables import AS_IT_SAYS, Layout
from grounded_trials.logs.inspection.inspect_log import FieldReport
from grounded_trials.toml_table import key


@dataclass(frozen=True)
class Guess:
    """The probable signal of a state or input in the log."""

    name: str
    path: str  # "" if nothing fits
    clock: str
    sure: bool
    others: tuple[str, ...]  # alternatives, best first
    field: FieldReport | None = None
    reasons: tuple[Finding, ...] = ()  # evidence
    scale: float = 1.0  # factor on its values: degrees, or a sign

    @property
    def extent(self) -> tuple[float, float] | None:
        """Its lowest and highest value in the log, in the model's unit; None if unknown."""
        if self.field is None or self.field.low is None or self.field.high is None:
            return None
        low, high = sorted((self.field.low * self.scale, self.field.high * self.scale))
        return low, high

    def because(self, *why: Finding, sure: bool | None = None) -> Guess:
        """Return it with more evidence, and sure or not if stated."""
        known = (*self.reasons, *(one for one in why if one not in self.reasons))
        return replace(self, reasons=known, sure=self.sure if sure is None else sure)


ALTERNATIVES = 8  # alternatives listed
LESS = 0.8  # of a value: a rounded one below it has two digits
DRIFT = 2e-4  # of a signal's range: the smallest standard deviation proposed for it


def mapping_toml(
    states: Sequence[Guess],
    inputs: Sequence[Guess],
    *,
    simulated: bool = False,
    rates: Mapping[str, str] = MappingProxyType({}),
    layout: Layout = AS_IT_SAYS,
) -> str:
    """Format guesses as a [log] table, with comments where a person should check.

    Args:
        states: one guess for each state.
        inputs: one guess for each input.
        simulated: whether header stamps are on another clock than the log.
        rates: the states whose rate is another state, {q: w}.
        layout: what the log's table does not say.
    """
    clock = "log" if simulated else "header"
    lines = ["[log]", f'clock = "{clock}"']
    if simulated:
        lines[-1] += "  # header stamps are on another clock than the log (simulation time?)"
    if layout.columns:
        lines.append(f"columns = [{', '.join(map(_quote, layout.columns))}]")
    if layout.rate:
        lines.append(f"rate = {layout.rate:.10g}  # [Hz] of the rows")
    for kind, guesses in (("state", states), ("input", inputs)):
        for guess in guesses:
            lines += ["", *_table(kind, guess, clock)]
    lines += _estimate(states, rates)
    return "\n".join(lines) + "\n"


def _table(kind: str, guess: Guess, clock: str) -> list[str]:
    head = f"[log.{kind}.{key(guess.name)}]"
    others = f"; or {', '.join(guess.others[:ALTERNATIVES])}" if guess.others else ""
    if not guess.path and not guess.others:
        return [f"# {head}  # nothing in the log fits"]
    if not guess.path:
        rest = f"  # or {', '.join(guess.others[1:ALTERNATIVES])}" * (len(guess.others) > 1)
        keys = (_scale(guess), _clock(guess, clock), _unwrap(guess.others[0]))
        more = [f"# {line}" for line in keys if line]
        what = f"no name in the log fits; to use one of these, remove all {len(more) + 2} #"
        what = what if more else what.replace("all 2", "both")
        return [f"# {head}  # {what}", f"# path = {_quote(guess.others[0])}{rest}", *more]
    lines = [head if guess.sure else f"{head}  # unsure{others}"]
    lines.append(f"path = {_quote(guess.path)}")
    field = guess.field
    if field is not None and field.low is not None and field.high is not None:
        low, high = extent(field.low, field.high)
        lines[-1] += f"  # {low:.4g} to {high:.4g} in this log"
    if guess.reasons:
        lines.insert(1, f"# {'; '.join(one.sentence for one in guess.reasons)}")
    if scale := _scale(guess):
        lines.append(scale)
    return lines + [line for line in (_clock(guess, clock), _unwrap(guess.path)) if line]


def _clock(guess: Guess, usual: str) -> str:
    return f'clock = "{guess.clock}"' * (guess.clock != usual)


def _scale(guess: Guess) -> str:
    return f"scale = {guess.scale:.10g}" * (guess.scale != 1.0)


def _unwrap(path: str) -> str:
    return "unwrap = true" * path.endswith("@rpy.yaw")


def _estimate(states: Sequence[Guess], rates: Mapping[str, str]) -> list[str]:
    """Return an [estimate] table for the states that the log does not contain.

    It is commented out if no state was found: that is for logs that lack the rates.
    """
    missing, known = [guess.name for guess in states if not guess.path], estimating(states)
    if not known and (later := [q for q in rates if q not in rates.values()]):
        deviations = ", ".join(f"{name} = 0.01" for name in later)
        return [
            "",
            f"# [estimate]  # if the log lacks {', '.join(rates[q] for q in later)}: remove both #",
            f"# measured = {{ {deviations} }}  # standard deviations, in the model's units",
        ]
    if not missing or not known:
        return []
    deviations = ", ".join(
        f"{guess.name} = {_short(abs(guess.scale) * _deviation(guess))}" for guess in known
    )
    return [
        "",
        f"[estimate]  # the smoother estimates {', '.join(missing)}",
        f"measured = {{ {deviations} }}  # standard deviations, in the model's units; check them",
        f"# add {' or '.join(missing)} if the log contains it after all",
    ]


def estimating(states: Sequence[Guess]) -> list[Guess]:
    """Return the states of the log from which [estimate] gets those that it does not contain."""
    return [guess for guess in states if guess.path and guess.field is not None]


def _deviation(guess: Guess) -> float:
    """Return its noise in this log, at least a small part of its range, since sensors drift."""
    assert guess.field is not None
    low, high = guess.field.low or 0.0, guess.field.high or 0.0
    return max(guess.field.noise, DRIFT * (high - low), 1e-6)


def _short(value: float) -> str:
    """Format a value with one digit, or two where one would be much less."""
    text = f"{value:.1g}"
    return text if float(text) > LESS * value else f"{value:.2g}"


def _quote(path: str) -> str:
    return f"'{path}'" if '"' in path and "'" not in path else '"' + path.replace('"', '\\"') + '"'
