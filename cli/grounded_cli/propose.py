"""grounded propose: show what to run next, what it will do, and whether to trust it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence

from grounded_cli.console.terminal import (
    LABEL,
    field,
    next_line,
    open_workspace,
    show,
    stages,
    tell,
)
from grounded_trials.wording import with_unit
from grounded_trials.workspace.candidates.proposing import Proposed
from grounded_trials.workspace.candidates.trust import Extent


def propose(details: bool) -> Iterator[Proposed]:
    """Print what to run next, what it will do, and whether to trust it."""
    with stages() as tick:
        tick("planning")
        proposed = open_workspace().propose(tick)
    yield proposed
    tell_proposed(proposed, details=details)
    show(f"\n{next_line(proposed.then)}")


def tell_proposed(proposed: Proposed, *, details: bool = False) -> None:
    """Print what to run next; with `details` all findings."""
    standing, candidate = proposed.standing, proposed.candidate
    tell(proposed.findings, all_=details)
    if candidate is None:
        return show(field("end", standing.sentence))
    waiting = "" if proposed.proposal.is_new else " (waiting)"
    show(f"Run {candidate.id}{' once more' if proposed.again else waiting}: {proposed.file}")
    if proposed.again:
        show(field("why", standing.sentence, "  "))
    for label, one in proposed.promises.items():
        show(field(label, one.sentence, "  "))
        if label == "predicted" and proposed.off_target:
            off = "; ".join(error.finding.what for error in proposed.off_target)
            show(field("off target", off, "  "))
    show_extent(proposed.extent)


def show_extent(extent: Sequence[Extent]) -> None:
    """Print where a predicted run goes: ranges of the main states and of inputs."""
    width = max([LABEL, *(len(one.name) for one in extent)])
    for one in extent:
        text = with_unit(_span(one.low, one.high), one.unit)
        if one.limits:
            text += f", limits {re.sub(r'[.]?0+(?= |$)', '', _span(*one.limits))}"
        show(field(one.name, text, "  ", width))


def _span(low: float, high: float) -> str:
    """Format a range with two decimals, or up to six where all values are small."""
    size = max(abs(low), abs(high))
    if size < 0.5e-6:
        return "0"
    digits = 2 if not size < 1 else min(2 - math.floor(math.log10(size)), 6)
    return f"{round(low, digits) + 0.0:.{digits}f} to {round(high, digits) + 0.0:.{digits}f}"
