"""grounded diagnose: where the model is wrong, which effect makes it so, how far it shrinks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from grounded_cli import completion as complete
from grounded_cli.options import as_json, in_workspace, next_line, open_workspace, parallel
from grounded_cli.terminal import (
    field,
    lines,
    names_in,
    number,
    show,
    show_json,
    stages,
    table,
    tinted,
)
from grounded_trials.wording import percent, with_unit

if TYPE_CHECKING:
    from grounded.diagnosis.report import Diagnosis
    from grounded.engine import Engine
    from grounded.instruments.finding import Finding


@click.command("diagnose")
@click.option(
    "--trials",
    metavar="T1,T2,...",
    shell_complete=complete.trials,
    help="Only these trials (default: all).",
)
@click.option(
    "--max-effects",
    type=click.IntRange(1, 6),
    metavar="K",
    help="Blame at most K effects at once, 1 to 6 (default: 3, more where they leave a gap).",
)
@click.option("--without", multiple=True, metavar="F1,F2,...", help="Families not to blame.")
@click.option(
    "--compare",
    nargs=2,
    metavar="A B",
    shell_complete=complete.trials,
    help="Two groups of trials, T1,T2 T3,T4: what changed between them.",
)
@click.option("--probe", is_flag=True, help="Write the most instructive next trial, tie or not.")
@parallel
@click.option("--instruments", is_flag=True, help="Judge the sensors alone; takes some seconds.")
@in_workspace
@as_json
def command(
    trials: str | None,
    max_effects: int | None,
    without: tuple[str, ...],
    compare: tuple[str, str] | None,
    probe: bool,
    engine: Engine,
    instruments: bool,
    json_: bool,
) -> None:
    """Explain the sim-to-real gap from the stored trials; keeps reports/diagnosis.json.

    The verdict is one effect, several, none (what is left is noise, or can't be told from it) or
    unknown (a gap that no known effect explains). Where two effects tie, a probe candidate that
    would tell them apart is written.
    """
    workspace = open_workspace()
    from grounded.errors import GroundedError
    from grounded_trials.workspace.diagnosing import unheld_in

    chosen = names_in(trials)
    if trials is not None and not chosen:
        raise GroundedError(
            "--trials names no trial: expected some, like t0001,t0002; leave it out to take all"
        )
    first, second = map(names_in, compare or ("", ""))
    if compare and (chosen or not (first and second) or {*first} & {*second}):
        raise GroundedError(
            "--compare takes two groups of different trials, like --compare t0001,t0002 "
            "t0003,t0004, instead of --trials"
        )
    if instruments:
        findings = workspace.preflight(chosen)
        alone = unheld_in(workspace, chosen)
        if json_:
            odd = [one.to_json() for one in findings]
            return show_json({"preflight": odd, "unheld": list(alone)})
        _instruments(findings)
        return _unheld(alone, bool(findings))
    families = [name for text in without for name in names_in(text)]
    with stages() as tell:
        found = workspace.diagnose(
            chosen or first,
            max_effects=max_effects,
            without=families,
            compare=second,
            probe=probe,
            engine=engine,
            progress=tell,
        )
    if json_:
        show_json(found.to_json())
    else:
        params = workspace.base_model.params
        _tell(found, {name: param.value for name, param in params.items()})
        show("\n" + field("next trial", found.next_trial))
        if found.probe:
            from grounded_cli.propose import show_extent

            show_extent(workspace.candidate(found.probe)[0], workspace.task)
        assert found.then is not None
        show(f"\n{next_line(found.then)}")


def _tell(found: Diagnosis, before: dict[str, float]) -> None:
    from grounded.diagnosis.tables import error_table
    from grounded_trials.report.diagnosis_words import (
        agreement_lines,
        correction_line,
        error_lines,
        in_vain,
    )

    show(_verdict(found))
    _instruments(found.preflight)
    for text in found.unknowable:
        if text not in found.sentence:
            show(field("unknown", text))
    if not found.no_cause:
        if found.prediction_error:
            show("\n" + table(*error_table(found)))
            _note(f"open loop, {_held_out(found)}")
        _effects(found)
    _places(found)
    for title, text in error_lines(found, before):
        show(field(title, text))
    for text in in_vain(found):
        show(field("dropped", text))
    if found.correction is not None:
        show(field("correction", correction_line(found.correction)))
    for title, text in agreement_lines(found):
        show(field(title, text))


def _held_out(found: Diagnosis) -> str:
    """How the errors were measured, and how far ahead they tell something."""
    from grounded.diagnosis.error_report import furthest

    row = found.prediction_error[0]
    by = {
        "trials": "each trial predicted with values from the others",
        "pieces": "each piece of the log predicted with values from the others",
    }
    noise = {
        "repeats": "the scatter of repeats",
        "alike": "the scatter of trials whose commands agree to 2 %",
        "short horizon": "one step's noise, carried on",
    }
    if row.floor_at_most:
        noise["short horizon"] = (
            "at most what one step leaves, carried on (it isn't white: part of it is the model's "
            "error; repeat a trial)"
        )
    told = f"{by.get(row.held_out, 'not held out')}; noise: {noise.get(row.floor_from, 'unknown')}"
    told_of = furthest(found.prediction_error)
    if told_of and any(one.drowned for one in found.prediction_error if not one.whole_trial):
        told += (
            f"; farther ahead than {told_of.horizon_s:.3g} s noise alone grows beyond all that was "
            "measured (a robot that falls without its feedback, say): whole trials tell little"
        )
    return told


def _instruments(findings: Sequence[Finding]) -> None:
    from grounded.diagnosis.tables import instrument_lines

    for k, line in enumerate(instrument_lines(findings)):
        show(field("sensors" if k == 0 else "", line))


def _unheld(alone: Sequence[str], odd: bool) -> None:
    """What the instruments can't know: of a sensor that no other one can be held against."""
    if alone:
        of = "its" if len(alone) == 1 else "their"
        text = f"{', '.join(alone)}: no other sensor to hold against, so {of} sign, unit and delay"
        show(field("unchecked", f"{text} are not known"))
    if not odd:
        show("the sensors show nothing odd" + " by themselves" * bool(alone))


def _note(text: str) -> None:
    """What a table's columns mean."""
    show("\n".join(lines(text, "  ", "  ")))


def _verdict(found: Diagnosis) -> str:
    """The kind, then a cause or a sentence a line: they say different things."""
    from grounded_trials.report.diagnosis_words import verdict_lines

    causes, others = verdict_lines(found)
    shown = [field("verdict", found.kind).replace(found.kind, tinted(found.kind), 1)]
    for line in (*(f"- {cause}" for cause in causes), *others):
        shown += lines(line, "  ", "    ")
    return "\n".join(shown)


def _places(found: Diagnosis) -> None:
    from grounded.diagnosis.error_report import furthest

    where = found.where
    channels = [
        (c.name, percent(c.share), with_unit(number(c.rms, 3), c.unit))
        for c in where.channels
        if c.share >= 0.005  # NaN: the gap is noise
    ]
    if channels:
        show("\n" + table(channels, ("where", "share of the gap", "rms")))
        row = furthest(found.prediction_error)
        ahead = f" {row.horizon_s:.3g} s ahead" if row else ""
        _note(
            "share: of the squared errors of single steps, in units of the noise, that causes and "
            f"leftover make; rms: of the model as it was{ahead}"
        )
    for region in where.regions[:3]:
        share, time = percent(region.share), percent(region.occupancy)
        show(field("", f"{region.told}: {share} of the gap in {time} of the time"))


def _effects(found: Diagnosis) -> None:
    from grounded.diagnosis.tables import effect_table
    from grounded.diagnosis.verdict import told_apart

    if found.ranking:
        show("\n" + table(*effect_table(found)))
        _note(
            "credit: what predictions lose without it, of what they gain in all; evidence: of "
            "what is claimed or tied, what is lost without it beside the other causes; of the "
            "rest, what it gains alone; +-: one standard deviation, if the equations are right"
        )
    for group in found.indistinguishable:
        if group in found.equivalent:
            show(field("same", told_apart(group, found.equivalent)))
        else:
            show(field("tied", f"the data can't tell apart: {', '.join(group)}"))
