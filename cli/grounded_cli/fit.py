"""grounded fit: estimate the model's parameters from trials, with intervals."""

from __future__ import annotations

from collections.abc import Iterator

from grounded.diagnosis.telling import instrument_lines
from grounded.engine import Engine, cores
from grounded.fit import Fit
from grounded.result import listed
from grounded_cli.console.options import names_of
from grounded_cli.console.terminal import (
    field,
    lines,
    next_line,
    number,
    open_workspace,
    show,
    stages,
    table,
    tell,
)
from grounded_trials.wording import or_zero, shown
from grounded_trials.workspace.fitting import Fitted

HELD_OUT = (
    "rms, open loop, of each group of trials (or piece of a single log), predicted with values "
    "from the others"
)


def fit(
    trials: str | None, params: str | None, latency: bool, apply: bool, jobs: int | None
) -> Iterator[Fitted]:
    """Fit parameters; print them with their intervals and held-out errors."""
    workspace, names = open_workspace(), names_of(params, "--params", "a1,L")
    chosen, engine = names_of(trials, "--trials", "t0001,t0002"), Engine(jobs or cores())
    with stages() as stage:
        done = workspace.fit(
            names or None,
            trials=chosen,
            latency=latency,
            apply=apply,
            engine=engine,
            progress=stage,
        )
    yield done
    found = done.fit
    corrected = instrument_lines(one for one in done.preflight if one.corrected)
    for k, line in enumerate(corrected):
        show(field("sensors" if k == 0 else "", line))
    show("\n" * bool(corrected) + _parameters(found))
    if found.prediction_error:
        show(f"\n{_errors(found)}")
        show("\n".join(lines(HELD_OUT, "  ", "  ")))
    tell(done.findings)
    show(field("written", "[model] params" if apply else "nothing"))
    show(next_line(done.then))


def _parameters(found: Fit) -> str:
    rows = []
    for name, e in found.params.items():
        own = (e.low, e.high, e.start, e.value)
        low, high, start, value = (number(or_zero(v, *own)) for v in own)
        given = f", given {listed(e.only_with)}" * bool(e.only_with)
        interval = f"{low} .. {high}{given}" if e.identified else "not identified"
        interval = "at its bound" if name in found.at_bounds else interval
        rows.append((name, start, value, interval, shown(e.unit)))
    return table(rows, ("parameter", "before", "fitted", "95 % interval", "unit"))


def _errors(found: Fit) -> str:
    rows = [
        (f"{name}, {row.horizon_s:.3g} s ahead", *(number(e, 3) for e in ends), shown(unit))
        for name, unit in found.prediction_error[0].unit_by_channel.items()
        for row in found.prediction_error
        for ends in [(row.crude[name], row.with_effects[name])]
    ]
    return table(rows, ("held-out error", "before", "after", "unit"))
