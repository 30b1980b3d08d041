"""grounded diagnose: where the model is wrong, which effect causes it, how far the gap shrinks."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial
from typing import TYPE_CHECKING

import click

from grounded.errors import GroundedError
from grounded_cli.console import completion as complete
from grounded_cli.console.options import as_json, chosen_trials, parallel
from grounded_cli.console.terminal import (
    field,
    lines,
    names_in,
    number,
    remark,
    show,
    show_json,
    stages,
    table,
    tinted,
)
from grounded_cli.console.workspace_option import in_workspace, next_line, open_workspace
from grounded_trials.wording import percent, with_unit

if TYPE_CHECKING:
    from grounded.accounts.finding import Finding
    from grounded.diagnosis.report import Diagnosis
    from grounded.engine import Engine

REGIONS = 3  # named in the details


@click.command("diagnose")
@chosen_trials
@click.option(
    "--max-effects",
    type=click.IntRange(1, 12),
    metavar="K",
    help="Claim at most K effects, 1 to 12 (default: 3, more if they leave a gap).",
)
@click.option("--without", multiple=True, metavar="F1,F2,...", help="Families to exclude.")
@click.option(
    "--compare",
    nargs=2,
    metavar="A B",
    shell_complete=complete.trials,
    help="Two groups of trials, T1,T2 T3,T4: report what changed.",
)
@click.option(
    "--probe", is_flag=True, help="Write the most informative next trial, even without a tie."
)
@partial(parallel, by_itself=True)
@click.option("--instruments", is_flag=True, help="Check the sensors only; takes some seconds.")
@click.option(
    "--details", is_flag=True, help="Also rival effects, whole trials, look-alikes, utilities."
)
@in_workspace
@as_json
def command(
    trials: tuple[str, ...],
    max_effects: int | None,
    without: tuple[str, ...],
    compare: tuple[str, str] | None,
    probe: bool,
    engine: Engine,
    instruments: bool,
    details: bool,
    json_: bool,
) -> None:
    """Explain the sim-to-real gap from the stored trials; keeps reports/diagnosis.json.

    The verdict is one effect, several, none (the rest is noise, or cannot be told from it) or
    unknown (a gap that no known effect explains). If two effects tie, a probe is written: a
    candidate whose trial would tell them apart.
    """
    workspace = open_workspace()
    from grounded_trials.workspace.diagnosing import unheld_in, unwritten_in
    from grounded_trials.workspace.last_diagnosis import left_out

    first, second = map(names_in, compare or ("", ""))
    if compare and (trials or not (first and second) or {*first} & {*second}):
        raise GroundedError(
            "--compare takes two groups of different trials, like --compare t0001,t0002 "
            "t0003,t0004, and no --trials"
        )
    if instruments:
        findings = workspace.preflight(trials)
        alone = unheld_in(workspace, trials)
        if json_:
            odd = [one.to_json() for one in findings]
            return show_json({"preflight": odd, "unheld": list(alone)})
        _instruments(findings, workspace.base_model.inputs)
        _unheld(alone, bool(findings))
        return show(f"\n{next_line(workspace.status().then)}")
    families = [name for text in without for name in names_in(text)]
    with stages() as tell:
        found = workspace.diagnose(
            trials or first,
            max_effects=max_effects,
            without=families,
            compare=second,
            probe=probe,
            engine=engine,
            progress=tell,
        )
    for note in [*([] if trials or first else left_out(workspace)), *unwritten_in(workspace)]:
        remark("note", note)
    if json_:
        show_json(found.to_json())
    else:
        model = workspace.base_model
        nominal = {name: param.value for name, param in model.params.items()}
        _show(found, nominal, model.inputs, details=details)
        show("\n" + field("next trial", found.next_trial))
        if found.probe:
            from grounded_cli.propose import show_extent

            show_extent(workspace.candidate(found.probe)[0], workspace.task)
        assert found.then is not None
        show(f"\n{next_line(found.then)}")


def _show(
    found: Diagnosis, nominal: dict[str, float], inputs: Collection[str] = (), *, details: bool
) -> None:
    """Print a diagnosis: what a person needs to decide, or with `details` everything."""
    from grounded.diagnosis.tables import error_table
    from grounded_trials.report.diagnosis_notes import caveats, held_out, pattern_line
    from grounded_trials.report.diagnosis_words import (
        agreement_lines,
        correction_line,
        error_lines,
        in_vain,
    )

    show(_verdict(found))
    _instruments(found.preflight, inputs)
    for text in caveats(found):
        show(field("caveats", text))
    if found.prediction_error:
        rows, header = error_table(found, whole_trials=details)
        show("\n" + table(rows, header))
        adopted = "model.py: without what was adopted; now: with it; " * ("now" in header)
        _note(f"{adopted}open loop, {held_out(found)}")
    if not found.no_cause:
        _effects(found, details=details)
    _places(found, details=details)
    if details:
        for title, text in error_lines(found, nominal):
            show(field(title, text))
        for text in in_vain(found):
            show(field("dropped", text))
        if text := pattern_line(found):
            show(field("pattern", text))
    if found.correction is not None and (details or found.correction.adoptable):
        show(field("correction", correction_line(found.correction)))
    for title, text in agreement_lines(found):
        show(field(title, text))


def _instruments(findings: Sequence[Finding], inputs: Collection[str]) -> None:
    """Print what is odd in the sensors and in the commands."""
    from grounded.diagnosis.tables import instrument_lines

    sent = [one for one in findings if one.signal in inputs]
    seen = [one for one in findings if one.signal not in inputs]
    for title, some in (("sensors", seen), ("commands", sent)):
        for k, line in enumerate(instrument_lines(some)):
            show(field(title if k == 0 else "", line))


def _unheld(alone: Sequence[str], odd: bool) -> None:
    """Name the sensors that have no other sensor to be checked against."""
    if alone:
        of = "its" if len(alone) == 1 else "their"
        text = f"{', '.join(alone)}: no other sensor to compare with, so {of} sign, unit and delay"
        show(field("unchecked", f"{text} were not checked"))
    if not odd:
        show("no fault found in the sensors" + " by themselves" * bool(alone))


def _note(text: str) -> None:
    """Print what the columns of a table mean."""
    show("\n".join(lines(text, "  ", "  ")))


def _verdict(found: Diagnosis) -> str:
    """Return the kind of verdict, then a line per cause and sentence."""
    from grounded_trials.report.diagnosis_words import verdict_lines

    causes, others = verdict_lines(found)
    shown = [field("verdict", found.kind).replace(found.kind, tinted(found.kind), 1)]
    for line in (*(f"- {cause}" for cause in causes), *others):
        shown += lines(line, "  ", "    ")
    return "\n".join(shown)


def _places(found: Diagnosis, *, details: bool) -> None:
    """Print where the gap lies: a line, or with `details` a table of channels and regions."""
    from grounded.diagnosis.error_report import furthest
    from grounded_trials.report.diagnosis_notes import LEAST_SHARE, regions, where_line

    if not (line := where_line(found)):
        return
    if not details:
        return show("\n" + field("where", line))
    channels = [c for c in found.where.channels if c.share >= LEAST_SHARE]
    rows = [(c.name, percent(c.share), with_unit(number(c.rms, 3), c.unit)) for c in channels]
    show("\n" + table(rows, ("where", "share of the gap", "rms")))
    row = furthest(found.prediction_error)
    ahead = f" {row.horizon_s:.3g} s ahead" if row else ""
    _note(
        "share: of the squared one-step errors beyond the noise; rms: of the predictions of the "
        f"model before this diagnosis{ahead}"
    )
    for text in regions(found, REGIONS):
        show(field("", text))


def _effects(found: Diagnosis, *, details: bool) -> None:
    """Print the claimed effects and what ties with them, or with `details` all rivals."""
    from grounded.diagnosis.tables import WITHOUT, effect_table, of_delays, of_rivals
    from grounded_trials.report.diagnosis_notes import deviations

    rows, header = effect_table(found, rivals=details)
    tied = " (a tied effect: in place of the claimed one)" * bool(found.indistinguishable)
    if rows:
        show("\n" + table(rows, header))
        _note(
            f"{WITHOUT}; evidence: log-likelihood lost without it"
            + tied
            + f"; {of_rivals(found)}" * ("alone [nats]" in header)
            + f"; {deviations(found)}"
            + (f"; {rows_apart}" if (rows_apart := of_delays(found)) else "")
        )
