"""Guess: the probable signal of a state or input, and several as [log] and [estimate]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
DRIFT = 2e-4  # of a signal's range: the smallest standard deviation proposed for it


def mapping_toml(
    states: Sequence[Guess],
    inputs: Sequence[Guess],
    *,
    simulated: bool = False,
    layout: Layout = AS_IT_SAYS,
) -> str:
    """Format guesses as a [log] table, with comments where a person should check.

    `simulated`: header stamps are on another clock than the log; `layout` is what the log's table
    does not say.
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
    lines += _estimate(states)
    return "\n".join(lines) + "\n"


def _table(kind: str, guess: Guess, clock: str) -> list[str]:
    """Return the lines of a signal; one without a path has its best rival, as a comment."""
    head = f"[log.{kind}.{key(guess.name)}]"
    path, *rivals = [*filter(None, [guess.path]), *guess.others] or [""]
    if not path:
        return [f"# {head}  # nothing in the log fits"]
    lines = [f"path = {_quote(path)}"]
    field = guess.field
    if field is not None and field.low is not None and field.high is not None:
        low, high = extent(field.low, field.high)
        lines[0] += f"  # {low:.4g} to {high:.4g} in this log"
    lines += [f"scale = {guess.scale:.10g}"] * (guess.scale != 1.0)
    lines += [f'clock = "{guess.clock}"'] * (guess.clock != clock)
    lines += ["unwrap = true"] * path.endswith("@rpy.yaw")
    others = f"; or {', '.join(rivals[:ALTERNATIVES])}" * bool(rivals)
    if not guess.path:
        head += f"  # no name in the log fits; to use this, remove the # of each line{others}"
        return [f"# {line}" for line in (head, *lines)]
    why = [f"# {'; '.join(one.sentence for one in guess.reasons)}"] * bool(guess.reasons)
    return [head + f"  # unsure{others}" * (not guess.sure), *why, *lines]


def _estimate(states: Sequence[Guess]) -> list[str]:
    """Return an [estimate] table for the states that the log does not contain."""
    missing, known = [guess.name for guess in states if not guess.path], estimating(states)
    if not missing or not known:
        return []
    deviations = ", ".join(
        f"{guess.name} = {abs(guess.scale) * _deviation(guess):.2g}" for guess in known
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


def _quote(path: str) -> str:
    return f"'{path}'" if '"' in path and "'" not in path else '"' + path.replace('"', '\\"') + '"'
