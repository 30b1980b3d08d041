"""The parts of the page as values: tables, figures, sentences, commands.

The template lays them out, and escapes every text, since names may come from untrusted files.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from grounded.diagnosis.parts import Diagnosis, Estimate, Ranked
from grounded.diagnosis.telling import weighed_beside
from grounded.errors import NextCommand
from grounded.figures.figure import Figure
from grounded.frozen import Array
from grounded.model import Model
from grounded.result import begun, listed
from grounded.search.pictures import MOST_DRAWN, few
from grounded_trials.report.findings import (
    Findings,
    by_state,
    compared,
    off_prediction,
    off_target,
    rms,
)
from grounded_trials.report.forecast import forecast_error
from grounded_trials.wording import (
    extent,
    figure,
    labelled,
    legend,
    or_zero,
    percent,
    rendered,
    shown,
    spread,
    with_unit,
)
from grounded_trials.workspace.last_diagnosis import Since

# columns of errors from which the table of forecasts has a row for each trial instead
ROWS_FROM = 4
MOST_COLUMNS = 6  # of errors beside a trial; more take a row for each model
UNKNOWN = "–"


@dataclass(frozen=True)
class Block:
    """A part of a section; `kind` selects its layout.

    text, soft, heading    a sentence
    command                a command to copy; `name` is its id
    verdict                `lines`, one below the other; `strong` ones are the items of a list
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


def drawn(figure: Figure | None, wide: bool = False, title: bool = False) -> list[Block]:
    """Return a figure's blocks, with its title as a heading if `title`; [] for None."""
    if figure is None:
        return []
    heading = [Block("heading", figure.title)] if title else []
    return [*heading, Block("figure", name=figure.name, figure=figure, wide=wide)]


def table(
    name: str, header: Sequence[str], rows: Sequence[Sequence[str]], strong: Iterable[int] = ()
) -> Block:
    """Return a table that can be copied."""
    return Block("table", name=name, header=header, rows=rows, strong=frozenset(strong))


def candidate_table(findings: Findings) -> list[Block]:
    """Return the candidates with their trials; of many, a part and the number left out."""
    rows, best = [], findings.standing.incumbent
    kept, left = few(findings.history, MOST_DRAWN)
    for tried in kept:
        c = tried.candidate
        cells = {
            "candidate": c.id,
            "from": c.base or "-",
            "iter.": str(c.iteration),
            "alpha": f"{c.alpha:g}",
            "damping": figure(c.damping, 2) if c.base else "-",
            "predicted utility": figure(tried.promised),
            "real utility": figure(tried.utility),
            "std. error": spread(tried.standard_error),
            "verdict ": findings.standing.verdict(tried),
            "trials ": " ".join(t.id for t in tried.trials) or "none",
        }
        rows.append(cells)
    strong = {k for k, t in enumerate(kept) if best and t.candidate is best.candidate}
    made = table("candidates", list(rows[0]), [list(cells.values()) for cells in rows], strong)
    words = f"{left} more"
    more = [
        Block("text", words),
        Block("command", rendered(NextCommand("status"), findings.folder), "c-status"),
    ]
    why = legend("", [t.candidate.iteration for t in kept])
    less = findings.standing.less_in_log
    told = [f"{begun(words)}." for words in (why, less.sentence if less else "") if words]
    return [made, *(Block("soft", words) for words in told), *more * bool(left)]


def error_table(findings: Findings) -> list[Block]:
    """Return by state the rms errors from target and prediction, and the rms bias."""
    task, runs = findings.task, [run for _, run in compared(findings)]
    if findings.best is None:
        return []
    columns = {f"off target, {r.candidate.id}": rms(off_target(findings, r)) for r in runs}
    columns |= {f"off prediction, {r.candidate.id}": rms(off_prediction(findings, r)) for r in runs}
    columns |= {f"bias in 1 s, {r.candidate.id}": rms(r.residual) / task.dt for r in runs}
    rows = by_state(task.model, [*columns.values()])
    return [table("errors", ("state", "unit", *columns), rows)]


def forecast_table(findings: Findings) -> list[Block]:
    """Return the rms prediction error at the horizon `ahead_s` in the best run and every log.

    Unlike the errors of the diagnosis, these are not held out.
    """
    run = findings.lately
    trials = ([run.trial] if run is not None else []) + [log.trial for log in findings.logs]
    if not trials:
        return []
    planners = [(findings.plain, findings.crude)]
    if findings.better is not None:
        planners.append((findings.better.name, findings.better.planner))
    model, ahead = findings.task.model, findings.ahead_s
    names = [(t.id or t.candidate, words) for t in trials for words, _ in planners]
    errors = [forecast_error(planner, t, ahead) for t in trials for _, planner in planners]
    title = Block("heading", f"Prediction error {ahead:.3g} s ahead, rms")
    if len(errors) <= max(ROWS_FROM, model.n):
        words = (f"{trial}, {name}" for trial, name in names)
        made = table("forecasts", ("state", "unit", *words), by_state(model, errors))
    else:  # many logs are rows: as columns they left the screen
        ids = [trial.id or trial.candidate for trial in trials]
        made = _of_trials(ids, [words for words, _ in planners], errors, model)
    return [title, made]


def _of_trials(
    trials: Sequence[str], planners: Sequence[str], errors: Sequence[Array], model: Model
) -> Block:
    """Return a row for each trial with its models side by side, or one for each model of many."""
    states = [labelled(name, shown(unit)) for name, unit in model.states.items()]
    names: list[tuple[str, ...]]
    columns = np.reshape(errors, (len(trials), len(planners), model.n))
    if len(planners) * model.n > MOST_COLUMNS:
        header = ("trial", "model ", *states)
        names = [(trial, words) for trial in trials for words in planners]
        cells = columns.reshape(len(names), -1)
    else:
        header = ("trial", *(f"{state}, {words}" for state in states for words in planners))
        names = [(trial,) for trial in trials]
        cells = columns.swapaxes(1, 2).reshape(len(names), -1)
    rows = [
        (*name, *(figure(float(v), 3) for v in row)) for name, row in zip(names, cells, strict=True)
    ]
    return table("forecasts", header, rows)


def effect_table(diagnosis: Diagnosis, since: Since) -> Block:
    """Return the ranked effects with their parameters and 95 % intervals."""
    beside = weighed_beside(diagnosis)
    rows = [
        (
            r.effect + " (adopted since)" * (r.effect in since.adopted),
            figure(r.evidence, 3) if r.effect in beside else "",
            "" if r.effect in beside else figure(r.evidence, 3),
            figure(r.gap_after, 3),
            percent(r.shrinkage) if not r.shrinkage < 0 else "none, it grows",
            _params(r),
        )
        for r in diagnosis.ranking
    ]
    evidence = ("evidence [nats]", "evidence alone [nats]")
    header = ("effect", *evidence, "gap after", "gap closed", "parameters, 95 % ")
    strong = {i for i, r in enumerate(diagnosis.ranking) if r.effect in diagnosis.effects}
    return table("effects", header, rows, strong)


def _params(ranked: Ranked) -> str:
    texts = []
    for name, value in ranked.params.items():
        text = _interval(value)
        texts.append(f"{name} = {text if text == UNKNOWN else with_unit(text, value.unit)}")
    return "; ".join(texts) or "-"


def _interval(v: Estimate) -> str:
    """Return a value and its 95 % interval as text; `UNKNOWN` if the interval is too wide."""
    if v.interval is None:
        return figure(v.value)
    low, high = v.interval
    value = or_zero(v.value, low, high)
    known = low <= v.value <= high and v.known
    low, high = extent(low, high)
    return f"{figure(value)} ({figure(low, 3)} to {figure(high, 3)})" if known else UNKNOWN


def leftover_table(diagnosis: Diagnosis) -> list[Block]:
    """Return the residuals that a flexible model finds and no known effect explains."""
    rows = [
        (
            left.channel,
            with_unit(figure(left.size, 3), left.unit),
            "-" if left.region is None else left.region.told,
            "-" if left.region is None else percent(left.region.share),
            figure(left.evidence, 3),
        )
        for left in diagnosis.leftover
        if math.isfinite(left.size)
    ]
    if not rows:
        return []
    header = ("channel", "missing rate, rms", "mostly where ", "share there", "evidence [nats]")
    named = Block("heading", "What no known effect explains")
    return [named, table("leftover", header, rows)]


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
    if not rows:
        return [Block("text", "The model has no parameters.")]
    header = ("parameter", "in model.py", "now", "diagnosed, 95 %", "unit", "bounds")
    return [table("parameters", header, rows)]


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


def channel_table(findings: Findings) -> Block:
    """Return states and inputs with units, weights, limits and latency."""
    task, reward, rows = findings.task, findings.task.reward, []
    assert task.latency is not None
    for i, (name, unit) in enumerate(task.model.states.items()):
        weight = f"{reward.state[i]:g}"
        weight += f", terminal {reward.terminal[i]:g}" if reward.terminal[i] else ""
        rows.append((name, "state", shown(unit), weight, "-", "-"))
    for j, (name, unit) in enumerate(task.model.inputs.items()):
        weight = f"{reward.input[j]:g}, change {reward.input_change[j]:g}"
        delay = f"{task.latency[j]:g} s" if task.latency[j] else "-"
        rows.append((name, "input", shown(unit), weight, _range(task.low[j], task.high[j]), delay))
    return table("channels", ("name", "kind", "unit", "weight", "limits", "latency"), rows)


def _range(low: float | None, high: float | None) -> str:
    if low is not None and high is not None:
        low, high = extent(low, high)
    a = "−∞" if low is None or not math.isfinite(low) else f"{low:g}"
    b = "∞" if high is None or not math.isfinite(high) else f"{high:g}"
    return f"{a} to {b}"
