"""The contents of a report as values: sentences, tables, figures, commands.

The page's template lays them out and escapes every text, since names may come from untrusted
files; the report for a terminal and the recording take the same sentences and tables.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

from grounded.diagnosis.parts import Diagnosis, Estimate
from grounded.diagnosis.pictures import accuracy_figure, credit_figure
from grounded.diagnosis.telling import error_table as held_out_table
from grounded.diagnosis.telling import weighed_beside
from grounded.errors import NextCommand
from grounded.figures.figure import Figure
from grounded.result import begun, listed, measured_alike
from grounded.search.difference import Difference, last_gain
from grounded.search.pictures import MOST_DRAWN, few, search_figure
from grounded_trials.report.figures.gap import forecast_figures, residual_figures
from grounded_trials.report.figures.paths import crash, path_figure
from grounded_trials.report.figures.runs import (
    bias_figure,
    error_figure,
    input_figure,
    state_figure,
)
from grounded_trials.report.findings import (
    Findings,
    compared,
    off_prediction,
    off_target,
    rms,
)
from grounded_trials.report.forecast import forecast_error
from grounded_trials.wording import (
    count,
    extent,
    figure,
    labelled,
    legend,
    or_zero,
    percent,
    rendered,
    shown,
    with_unit,
)
from grounded_trials.workspace.next_step import DIAGNOSE
from grounded_trials.workspace.off_target import off_target_of

OPEN = 12  # largest number of candidates whose table is shown unfolded
UNKNOWN = "–"


@dataclass(frozen=True)
class Block:
    """A part of a section; `kind` selects its layout.

    text, soft, heading    a sentence
    command                a command to copy; `name` is its id
    verdict                `lines`, one below the other
    table                  `name`, `header` (text columns end with a blank), `rows`; `strong` rows
                           are bold
    figure                 `figure`; with `wide` two panels per row
    folded                 `blocks` under the title `text`; open if `wide`
    run                    the slider that moves along the paths
    """

    kind: str
    text: str = ""
    name: str = ""
    lines: Sequence[str] = ()
    header: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    strong: frozenset[int] = frozenset()
    figure: Figure | None = None
    blocks: Sequence[Block] = ()
    wide: bool = False


def table(
    name: str, header: Sequence[str], rows: Sequence[Sequence[str]], strong: Iterable[int] = ()
) -> Block:
    """Return a table that can be copied."""
    return Block("table", name=name, header=header, rows=rows, strong=frozenset(strong))


def _drawn(figure: Figure | None, wide: bool = False, title: bool = False) -> list[Block]:
    """Return a figure's blocks, with its title as a heading if `title`; [] for None."""
    if figure is None:
        return []
    heading = [Block("heading", figure.title)] if title else []
    return [*heading, Block("figure", name=figure.name, figure=figure, wide=wide)]


# what a report begins with


def about(findings: Findings) -> str:
    """Return the task in a line, and how it is searched."""
    task = findings.task
    return (
        f"{task.model.name}: {task.horizon} steps of {task.dt:g} s ({task.horizon * task.dt:g} s), "
        f"{'closed loop' if task.feedback else 'open loop'}; {findings.method}"
    )


def counted(findings: Findings) -> list[str]:
    """Return how many trials there are, and what of them is not used or drawn."""
    now, logs = findings.standing, len(findings.logs) + findings.left_logs
    found = []
    if findings.history or not logs:
        found.append(f"{count(now.trials, 'trial')}, {count(now.iteration, 'improvement')}")
    if logs:
        found.append(f"{count(logs, 'log')} of data")
    if findings.optimum is not None:
        found.append(f"optimum {figure(findings.optimum)}")
    for left, drawn, kind in (
        (findings.left_runs, len(findings.runs), "trials"),
        (findings.left_logs, len(findings.logs), "logs"),
    ):
        if left:
            found.append(f"{drawn} of {left + drawn} {kind} drawn")
    early = [run.trial.id for run in findings.runs if crash(run) is not None]
    return [*found, f"ended early: {', '.join(early)}"] if early else found


def improved(findings: Findings) -> list[tuple[str, str]]:
    """Return rows (value, text) of the errors and utility of the first and the best trial.

    The errors are those of `status`: rms over the run, and at the end where that is to be reached.
    Both are in one unit, lengths below 1 m in mm.
    """
    rows, task = list[tuple[str, str]](), findings.task
    runs = [[one.trial for one in findings.runs_of(r.candidate.id)] for _, r in compared(findings)]
    errors = [{one.what: one for one in off_target_of(task, own)} for own in runs]
    short = [t.id for own in runs for t in own if t.finite_steps < task.horizon]
    note = f"; {', '.join(short)} ended early" if short else ""
    for what, last in errors[-1].items() if errors else ():
        for kind in ("rms", "end"):
            values = [getattr(each[what], kind) for each in errors if what in each]
            if math.isfinite(values[-1]):
                texts = measured_alike([v for v in values if math.isfinite(v)], shown(last.unit))
                rows.append((" -> ".join(texts), f"{what} off target, {kind}{note}"))

    # the utility
    first, best = findings.first, findings.best
    if first is not None and best is not None and figure(first.utility) != figure(best.utility):
        gain, tried = "", {one.candidate.id: one for one in findings.history}
        if -math.inf < first.utility < 0 and best.utility <= 0:
            two = tried[first.candidate.id], tried[best.candidate.id]
            gain = f": {Difference(*two, findings.history).lead.sentence}"
        moved = f"{figure(first.utility)} -> {figure(best.utility)}"
        rows.append((moved, f"utility, {first.candidate.id} to {best.candidate.id}{gain}"))
    elif best is not None:
        rows.append((figure(best.utility), f"utility, {best.candidate.id}"))
    return rows


# sections


def sections(findings: Findings) -> list[tuple[str, list[Block]]]:
    """Return the page's sections (title, parts) in reading order, without empty ones."""
    paths = _drawn(path_figure(findings), wide=True)
    found = [
        ("Paths", [Block("run"), *paths] if paths and findings.runs else paths),
        ("States", _drawn(state_figure(findings))),
        ("Inputs", _drawn(input_figure(findings))),
        ("Tracking error", _drawn(error_figure(findings)) + error_table(findings)),
        ("Utility", _utility(findings)),
        ("Bias", _drawn(bias_figure(findings))),
        ("Gap: model against reality", _gap(findings)),
        ("Task and model", _task(findings)),
    ]
    return [(title, blocks) for title, blocks in found if blocks]


def _utility(findings: Findings) -> list[Block]:
    if not findings.history:
        return []
    gain = last_gain(findings.history)
    sure = gain.to_finding().sentence if gain else ""
    wide = len(findings.history) <= OPEN
    return [
        *_drawn(search_figure(findings.standing, findings.optimum)),
        *([Block("text", f"{begun(sure)}.")] if sure else []),
        Block("folded", "All candidates", blocks=_candidates(findings), wide=wide),
    ]


def _gap(findings: Findings) -> list[Block]:
    """What was diagnosed, and forecasts of the crude model beside the better one; then details."""
    diagnosis = findings.diagnosis
    ahead = [b for each in forecast_figures(findings) for b in _drawn(each, title=True)]
    ahead += forecast_table(findings)
    lacking = [b for each in residual_figures(findings) for b in _drawn(each, title=True)]
    if diagnosis is None:
        command = Block("command", rendered(DIAGNOSE, findings.folder), "c-diagnose")
        return [command, *ahead, *lacking]
    verdict = Block("verdict", lines=findings.lines)
    if diagnosis.no_cause:  # with too little data, what was fitted is no finding
        return [verdict, *ahead, *lacking]
    proof = _drawn(accuracy_figure(diagnosis), title=True)
    proof += _drawn(credit_figure(diagnosis), title=True)
    found = [verdict, *proof, *ahead, *lacking]
    found += _titled("Errors of held-out predictions", "held-out", *held_out_table(diagnosis))
    return found + _effects(diagnosis, findings.since.adopted)


def _titled(
    title: str, name: str, rows: Sequence[Sequence[str]], header: Sequence[str]
) -> list[Block]:
    """Return a table under its title; [] without rows."""
    return [Block("heading", title), table(name, header, rows)] if rows else []


def _task(findings: Findings) -> list[Block]:
    words = f"Adopted: {', '.join(findings.effects) or 'none'}."
    parameters = Block("folded", "Parameters", blocks=parameter_table(findings))
    return [Block("text", words), parameters]


# tables


def _candidates(findings: Findings) -> list[Block]:
    """Return the candidates with their trials; of many, a part and the number left out."""
    now = findings.standing
    best, header = now.incumbent, (*now.table()[1][:-1], "verdict ", "from", "trials ")
    kept, left = few(findings.history, MOST_DRAWN)
    rows = [
        (*now.row(one), one.candidate.base or "-", " ".join(t.id for t in one.trials) or "none")
        for one in kept
    ]
    strong = {k for k, t in enumerate(kept) if best and t.candidate is best.candidate}
    made = table("candidates", header, rows, strong)
    status = rendered(NextCommand("status"), findings.folder)
    more = [Block("text", f"{left} more"), Block("command", status, "c-status")] * bool(left)
    why = legend("", [t.candidate.iteration for t in kept])
    return [made, *([Block("soft", f"{begun(why)}.")] if why else []), *more]


def error_table(findings: Findings) -> list[Block]:
    """Return by state the rms errors from target and prediction, and the rms bias."""
    task, runs = findings.task, [run for _, run in compared(findings)]
    if findings.best is None:
        return []
    columns = {f"off target, {r.candidate.id}": rms(off_target(findings, r)) for r in runs}
    columns |= {f"off prediction, {r.candidate.id}": rms(off_prediction(findings, r)) for r in runs}
    columns |= {f"bias in 1 s, {r.candidate.id}": rms(r.residual) / task.dt for r in runs}
    rows = [
        (name, shown(unit), *(figure(or_zero(value, *values), 3) for value in values))
        for (name, unit), *values in zip(
            task.model.states.items(), *(c.tolist() for c in columns.values()), strict=True
        )
    ]
    return [table("errors", ("state", "unit", *columns), rows)]


def forecast_table(findings: Findings) -> list[Block]:
    """Return the rms prediction error at the horizon `ahead_s` in the best run and every log.

    Unlike the errors of the diagnosis, these are not held out. A trial has a row for each model.
    """
    run = findings.lately
    trials = ([run.trial] if run is not None else []) + [log.trial for log in findings.logs]
    if not trials:
        return []
    planners = [(findings.plain, findings.crude)]
    if findings.better is not None:
        planners.append((findings.better.name, findings.better.planner))
    states, ahead = findings.task.model.states, findings.ahead_s
    rows = [
        (t.id or t.candidate, words, *(figure(v, 3) for v in forecast_error(p, t, ahead).tolist()))
        for t in trials
        for words, p in planners
    ]
    header = ("trial", "model ", *(labelled(name, shown(unit)) for name, unit in states.items()))
    return _titled(f"Prediction error {ahead:.3g} s ahead, rms", "forecasts", rows, header)


def _effects(diagnosis: Diagnosis, adopted: Collection[str]) -> list[Block]:
    """Return the ranked effects with their parameters and 95 % intervals."""
    beside, rows = weighed_beside(diagnosis), []
    for r in diagnosis.ranking:
        nats = figure(r.evidence, 3)
        texts = {name: _interval(value) for name, value in r.params.items()}
        values = [
            f"{name} = {text if text == UNKNOWN else with_unit(text, r.params[name].unit)}"
            for name, text in texts.items()
        ]
        rows.append(
            (
                r.effect + " (adopted since)" * (r.effect in adopted),
                *((nats, "") if r.effect in beside else ("", nats)),
                figure(r.gap_after, 3),
                percent(r.shrinkage) if not r.shrinkage < 0 else "none, it grows",
                "; ".join(values) or "-",
            )
        )
    evidence = ("evidence [nats]", "evidence alone [nats]")
    header = ("effect", *evidence, "gap after", "gap closed", "parameters, 95 % ")
    strong = {i for i, r in enumerate(diagnosis.ranking) if r.effect in diagnosis.effects}
    made = table("effects", header, rows, strong)
    return [Block("heading", "Effects that were compared"), made] if rows else []


def parameter_table(findings: Findings) -> list[Block]:
    """Return the model's parameters: in model.py, current, and as diagnosed."""
    estimated = _estimated(findings.diagnosis)
    rests = findings.diagnosis.conditions if findings.diagnosis else {}
    rows = []
    for name, param in findings.task.model.params.items():
        bounded = param.low is not None or param.high is not None
        limits = _range(param.low, param.high) if bounded else "none" if param.std else "constant"
        found = _interval(estimated[name]) if name in estimated else "-"
        if name in rests and name in estimated:
            found += f", given {listed(rests[name])}"
        written = figure(findings.nominal.get(name))
        rows.append((name, written, figure(param.value), found, shown(param.unit), limits))
    header = ("parameter", "in model.py", "now", "diagnosed, 95 %", "unit", "bounds")
    return [table("parameters", header, rows)] if rows else []


def _estimated(diagnosis: Diagnosis | None) -> dict[str, Estimate]:
    """Return the parameters that a diagnosis calibrated, or claimed as an effect."""
    if diagnosis is None:
        return {}
    found = dict(diagnosis.parameters)
    then = {} if diagnosis.made is None else diagnosis.made.nominal
    for row in diagnosis.ranking:
        name = row.effect.removeprefix("parameter:")
        if row.claimed and name in then and "d" in row.params and name not in found:
            found[name] = row.params["d"].moved(then[name])
    return found


def _interval(v: Estimate) -> str:
    """Return a value and its 95 % interval as text; `UNKNOWN` if the interval is too wide."""
    if v.interval is None:
        return figure(v.value)
    low, high = v.interval
    value = or_zero(v.value, low, high)
    known = low <= v.value <= high and v.known
    low, high = extent(low, high)
    return f"{figure(value)} ({figure(low, 3)} to {figure(high, 3)})" if known else UNKNOWN


def _range(low: float | None, high: float | None) -> str:
    if low is not None and high is not None:
        low, high = extent(low, high)
    a = "−∞" if low is None or not math.isfinite(low) else f"{low:g}"
    b = "∞" if high is None or not math.isfinite(high) else f"{high:g}"
    return f"{a} to {b}"
