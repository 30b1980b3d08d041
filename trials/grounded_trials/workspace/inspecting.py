"""inspect: show the contents of a log and guess a [log] table for the workspace's model."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from grounded.errors import GroundedError, NextCommand
from grounded.result import Result
from grounded_trials.formats.tables import AS_IT_SAYS, Layout
from grounded_trials.logs.inspection.assignment import assigned
from grounded_trials.logs.inspection.guess import mapping_toml
from grounded_trials.logs.inspection.inspect_log import LogReport, inspect_log
from grounded_trials.logs.log_table import layout_of, misread
from grounded_trials.plain_file import path_of
from grounded_trials.store.own_files import CANDIDATE, TRIAL
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.user_files.config import FILE


@dataclass(frozen=True, eq=False, repr=False)
class Inspected(Result):
    """A log's topics, and the [log] table that was guessed for it."""

    log: str
    report: LogReport
    log_table: str  # TOML; "" if none is guessed
    why_none: str = ""  # why no table is guessed for a log that needs one
    outside: bool = False  # inspected outside any workspace
    ran_nothing: bool = False  # no candidate was proposed yet that it could have run
    odd: tuple[str, ...] = ()  # suspicious entries of the workspace's [log]

    @property
    def format(self) -> str:
        """The format that a file written by grounded states; "" for a foreign log."""
        return self.report.meta.get("format", "")

    @property
    def stored(self) -> bool:
        """Whether it is a trial in the store of a workspace."""
        return self.format == TRIAL and Path(self.log).resolve().parent.name == "trials"

    @property
    def then(self) -> NextCommand:
        """The command to type next for this file."""
        if self.report.damage:
            return NextCommand("recover", (self.log if len(self.report.files) == 1 else "FILE",))
        if self.format == CANDIDATE:
            return NextCommand("run", (Path(self.log).stem,))
        if self.stored:
            return NextCommand("report")
        if self.format != TRIAL and not self.log_table:
            if self.outside:
                return NextCommand("init", ("DIR", "--from", self.log))
            return NextCommand("inspect", (self.log,))
        return NextCommand("ingest", (*["--data"] * self.ran_nothing, self.log))

    def summary(self) -> str:
        """Return the log and its number of messages."""
        return f"{self.log}: {self.report.messages} messages"

    def to_json(self) -> dict[str, Any]:
        """Return the document of `inspect --json`."""
        report = self.report
        return {
            "files": [str(f) for f in report.files],
            "format": self.format or None,
            "library": report.library,
            "duration_s": report.duration_s,
            "messages": report.messages,
            "topics": [vars(t) | {"fields": [vars(f) for f in t.fields]} for t in report.topics],
            "remarks": [*report.remarks, *self.odd],
            "findings": [one.to_json() for one in report.findings],
            "damage": report.damage.sentence if report.damage else "",
            "log_table": self.log_table,
        }


def inspect_in(workspace: Folder, log: str | Path, layout: Layout = AS_IT_SAYS) -> Inspected:
    """Inspect a log; guess a [log] table if it is a foreign one and undamaged.

    Args:
        workspace: the workspace whose model names the states and inputs; without a model no table
            is guessed.
        log: a log of any format, or a bag's folder.
        layout: the names and the rate of a table that does not say them; those in [log] by default.

    Raises:
        GroundedError: if the log can't be read at all.
    """
    log = path_of(log)
    if layout == AS_IT_SAYS and (workspace.folder / FILE).exists():
        with suppress(GroundedError):  # it is reported where [log] is used
            layout = layout_of(workspace.config.log)
    report = inspect_log(log, layout)
    if report.meta.get("format") or report.damage:
        return Inspected(str(log), report, "")
    try:
        model = workspace.base_model
    except GroundedError as error:
        why = f": {error}"
        if outside := not (workspace.folder / FILE).exists():
            why = ", as this folder is no workspace"
            why += ": make one from the log, or name yours with -C DIR"
        return Inspected(str(log), report, "", why, outside=outside)
    states, inputs = assigned(report, model.states, model.inputs, model)
    table = mapping_toml(states, inputs, simulated=report.simulated, layout=layout)
    odd = tuple(one.sentence for one in misread(model, workspace.log_mapping))
    ran_nothing = not workspace.candidate_ids()
    return Inspected(str(log), report, table, ran_nothing=ran_nothing, odd=odd)
