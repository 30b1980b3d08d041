"""grounded diagnose: where the model is wrong, which effect causes it, how far the gap shrinks."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Any

from grounded.accounts.finding import Finding
from grounded.diagnosis.parts import Diagnosis
from grounded.diagnosis.telling import (
    FINDINGS,
    effect_table,
    error_table,
    instrument_lines,
    sentence,
    told,
)
from grounded.engine import Engine, cores
from grounded.findings import Weight
from grounded.refusals import wrong
from grounded_cli.console.options import names_of
from grounded_cli.console.terminal import (
    field,
    names_in,
    next_line,
    open_workspace,
    show,
    stages,
    table,
    tell,
    tinted,
)
from grounded_cli.propose import show_extent
from grounded_trials.wording import percent
from grounded_trials.workspace.candidates.trust import extent_of
from grounded_trials.workspace.last_diagnosis import left_out
from grounded_trials.workspace.next_step import BEFORE_TRIALS


def diagnose(
    trials: str | None,
    max_effects: int | None,
    without: tuple[str, ...],
    compare: tuple[str, str] | None,
    jobs: int | None,
    details: bool,
) -> Iterator[Any]:
    """Diagnose the trials, or compare two groups."""
    workspace, chosen = open_workspace(), names_of(trials, "--trials", "t0001,t0002")
    first, second = map(names_in, compare or ("", ""))
    if compare and (chosen or not (first and second) or {*first} & {*second}):
        raise wrong(
            "--compare", got=" ".join(compare), must="groups", like="t0001,t0002 t0003,t0004"
        )
    with stages() as stage:
        found = workspace.diagnose(
            chosen or first,
            max_effects=max_effects,
            without=[name for text in without for name in names_in(text)],
            compare=second,
            engine=Engine(jobs or cores()),
            progress=stage,
        )
    left = () if chosen or first else left_out(workspace)
    tell(left, all_=True)
    yield found
    assert found.then is not None
    _show(found, workspace.base_model.inputs, details=details)
    before = found.then.verb in BEFORE_TRIALS
    show("\n" + field("then" if before else "next trial", found.next_trial))
    if found.probe:
        show_extent(extent_of(workspace.candidate(found.probe)[0], workspace.task))
    show(f"\n{next_line(found.then)}")


def _show(found: Diagnosis, inputs: Collection[str] = (), *, details: bool) -> None:
    """Print a diagnosis: what a person needs to decide, or with `details` everything."""
    said, kind = told(found), found.kind
    first, *others = [sentence(one) for one in said.lines]
    show(field("verdict", f"{kind}: {first}").replace(kind, tinted(kind), 1))
    for label, text in zip(("errors", "open"), others, strict=False):
        show(field(label, text))
    if said.rows:
        show("\n" + table(said.rows, said.header) + "\n")
    _instruments(found.preflight, inputs)
    kept = said.findings if details else said.findings[:FINDINGS]
    for one in kept:
        show(field("note" if one.weight is Weight.NOTE else "warning", one.sentence))
    if more := len(said.findings) - len(kept):
        show(field("", f"{more} more with --details"))
    if details and not found.no_cause:
        for rows, header in (error_table(found), effect_table(found)):
            if rows:
                show("\n" + table(rows, header))
        places = [(c.name, percent(c.share)) for c in found.where.channels if c.share > 0]
        places += [(f"where {r.told}", percent(r.share)) for r in found.where.regions]
        if places:
            show("\n" + table(places, ("one-step errors", "share")))


def _instruments(findings: Sequence[Finding], inputs: Collection[str]) -> None:
    """Print what is odd in the sensors and in the commands."""
    sent = [one for one in findings if one.signal in inputs]
    seen = [one for one in findings if one.signal not in inputs]
    for title, some in (("sensors", seen), ("commands", sent)):
        for k, line in enumerate(instrument_lines(some)):
            show(field(title if k == 0 else "", line))
