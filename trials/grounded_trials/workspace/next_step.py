"""What comes next: one table for every command, the page, JSON and Python, see `NEXT`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.search.standing import LOST, Ending, Phase, Standing
from grounded_trials.store.store import hash_file
from grounded_trials.workspace.candidates.search_state import standing_in
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.new_target import PROPOSE, TARGET, to_plan, undrawn

if TYPE_CHECKING:
    from grounded.diagnosis.parts import Diagnosis
    from grounded_trials.workspace.last_diagnosis import Since

DIAGNOSE, FIT = NextCommand("diagnose"), NextCommand("fit", ("--apply",))
EXPORT = NextCommand("export", ("best", "--runner"))
REPORT = NextCommand("report", ("--html",))
FORMS = ("csv", "json", "npz")  # in which a candidate is exported
ASIDE = "set aside"  # the verdict on a run that does not count
BEFORE_TRIALS = ("adopt", "discard")  # verbs of commands that come before another trial


def exported_as(workspace: Folder, name: str) -> str:
    """Return the format in which a candidate was exported here or to the workspace; "" for none."""
    places = (at / f"{name}.{form}" for form in FORMS for at in (workspace.folder, Path()))
    return next((path.suffix[1:] for path in places if path.is_file()), "")


def not_stored(workspace: Folder, candidate: str) -> Path | None:
    """Return the trial file of the last `run` of a candidate if it was not ingested yet."""
    files = [*(workspace.folder / "runs").glob(f"{candidate}-*.mcap")]
    last = max(files, key=lambda path: (len(path.name), path.name), default=None)
    stored = last is None or workspace.store.holds(hash_file(last))
    return None if stored else last


def to_run(workspace: Folder, candidate: str, *named: str) -> NextCommand:
    """Return the command that runs a candidate: `run`, or `export` and then `next` if run by hand.

    A run that was not ingested yet is ingested first. `named` is its name in the command, () for
    the outstanding one.
    """
    if workspace.config.reachable:
        waits = not_stored(workspace, candidate)
        return NextCommand("run", named) if waits is None else NextCommand("ingest", (str(waits),))
    name = named[0] if named else candidate
    if exported_as(workspace, name):
        return NextCommand("next", ("LOG", "--candidate", candidate) if named else ("LOG",))
    return NextCommand("export", (name, "--runner"))


@dataclass(frozen=True, eq=False)
class Situation:
    """What decides what comes next."""

    workspace: Folder  # its model may have changed since the diagnosis
    now: Standing
    found: Diagnosis | None = None  # a diagnosis that was just made; None: the last one, if any

    @cached_property
    def diagnosis(self) -> Diagnosis | None:
        """The last diagnosis, or None."""
        from grounded_trials.workspace.last_diagnosis import readable_diagnosis

        return self.found or readable_diagnosis(self.workspace.reports)

    @cached_property
    def since(self) -> Since:
        """What changed since the diagnosis."""
        from grounded_trials.workspace.last_diagnosis import since_diagnosis

        return since_diagnosis(self.workspace, self.diagnosis)

    @cached_property
    def usable(self) -> int:
        """How many trials a diagnosis can use now."""
        from grounded_trials.workspace.last_diagnosis import usable_ids

        return self.since.usable if self.diagnosis else len(usable_ids(self.workspace))

    @property
    def then(self) -> NextCommand:
        """The command to type next, by `NEXT`."""
        rows = (row for row in NEXT if self.now.phase in row[0])
        then: NextCommand = next(command(self) for _, holds, command in rows if holds(self))
        return to_plan(self.workspace) if then == PROPOSE else then

    @cached_property
    def adopt(self) -> NextCommand | None:
        """The command that acts on the claims of the diagnosis, if it is of this model."""
        if self.diagnosis is None or self.since.changed:
            return None
        from grounded_trials.workspace.adoption import to_adopt  # slow, and seldom needed

        return to_adopt(self.workspace, self.diagnosis)

    @property
    def none_stood(self) -> bool:
        """Whether every policy that was run crashed."""
        return bool(self.now.history) and self.now.incumbent is None

    @property
    def nothing_known(self) -> bool:
        """Whether the trials can't identify any cause."""
        return self.diagnosis is not None and self.diagnosis.no_cause

    @property
    def doubted(self) -> bool:
        """Whether the search doubts its model, and enough new trials exist to diagnose it.

        A single run would confirm nothing.
        """
        new = self.usable if self.diagnosis is None else self.since.newer
        return bool(self.now.doubt) and new >= LOST

    @property
    def run(self) -> NextCommand:
        """One more trial: of the candidate that waits, the next or the best."""
        now, best = self.now, self.now.incumbent
        if now.outstanding is not None:
            return to_run(self.workspace, now.outstanding.id)
        if now.phase is Phase.PROPOSE or best is None:
            return to_plan(self.workspace)
        return to_run(self.workspace, best.candidate.id, "best")

    @property
    def record(self) -> NextCommand:
        """The drive that tells the uncertain parameters; any other log if there are none."""
        params = self.workspace.base_model.params.values()
        uncertain = any(one.uncertain for one in params)
        return NextCommand("excite") if uncertain else NextCommand("ingest", ("--data", "LOG"))


ANY, PLANNING, ENDED = tuple(Phase), (Phase.PROPOSE,), (Phase.CONVERGED, Phase.STOPPED)
Row = tuple[tuple[Phase, ...], Callable[[Situation], Any], Callable[[Situation], Any]]
# what comes next: the first row whose phase and condition hold gives the command
NEXT: tuple[Row, ...] = (
    # the last run should not count, and the user has not decided
    (ANY, lambda s: s.now.then and s.now.then.verb == "discard", lambda s: s.now.then),
    # a better model plans better, at any point of the search
    (ANY, lambda s: s.adopt and (not s.since.newer or s.none_stood), lambda s: s.adopt),
    ((Phase.AWAIT,), lambda s: True, lambda s: s.run),
    # proposing again would not help
    (ANY, lambda s: s.now.ending is Ending.NOT_ALLOWED and not s.now.trials, lambda s: TARGET),
    # the log that the workspace was made from is not stored
    (
        ANY,
        lambda s: not s.diagnosis and not_ingested(s.workspace),
        lambda s: NextCommand("ingest", ("--data", not_ingested(s.workspace))),
    ),
    # the search asks for a command, and trials enough exist to answer it
    (
        ANY,
        lambda s: not s.diagnosis and s.now.then and not (s.now.doubt and not s.doubted),
        lambda s: s.now.then,
    ),
    # logs before the first candidate, or an ended search, were not diagnosed
    (
        ANY,
        lambda s: (
            not s.diagnosis and s.usable and (not s.now.history or s.now.phase is not Phase.PROPOSE)
        ),
        lambda s: to_learn_from(s.workspace),
    ),
    # newer logs or the search's doubt ask for another diagnosis
    (
        PLANNING,
        lambda s: s.diagnosis and ((s.adopt and not s.now.history) or s.doubted),
        lambda s: DIAGNOSE,
    ),
    (PLANNING, lambda s: s.nothing_known and undrawn(s.workspace), lambda s: s.record),
    (PLANNING, lambda s: True, lambda s: to_plan(s.workspace)),
    # an ended search was not diagnosed with all of its trials and its model
    (
        ENDED,
        lambda s: s.diagnosis and not s.since.settled,
        lambda s: DIAGNOSE,
    ),
    # another run of the best candidate may tell a cause
    (ENDED, lambda s: s.diagnosis and s.nothing_known, lambda s: s.run),
    (ENDED, lambda s: s.diagnosis, lambda s: EXPORT),
    (ENDED, lambda s: True, lambda s: to_plan(s.workspace)),
)


def not_ingested(workspace: Folder) -> str:
    """Return the log that the workspace was made from if nothing was stored or planned yet; or "".

    Its name is known until the user deletes it from [limits]. It is "LOG" if it lies elsewhere.
    """
    log = "" if workspace.store.list() or workspace.candidate_ids() else workspace.config.seen_in
    places = (Path(log), workspace.folder.parent / log, workspace.folder / log)
    return next((str(path) for path in places if path.exists()), "LOG") if log else ""


def to_learn_from(workspace: Folder) -> NextCommand:
    """Return the command that learns from data: `diagnose`, or first `fit`.

    A model that no input moves, as a generic skeleton, has no cause to find before it is fitted.
    """
    model = workspace.base_model
    u = np.append(np.zeros((1, model.m)), np.eye(model.m), axis=0)
    x = np.zeros((len(u), model.n))
    with suppress(GroundedError), np.errstate(all="ignore"):  # `diagnose` reports a faulty model
        after = model.system.step(x, u, model.values, workspace.config.task.dt)
        if any(one.uncertain for one in model.params.values()) and (after == after[0]).all():
            return FIT
    return DIAGNOSE


def after_log(workspace: Folder, verdict: str, now: Standing | None) -> NextCommand:
    """Return the command after ingesting a log: usually `propose`, `diagnose` for data or a probe.

    Data beside a search whose candidate waits leave that next.
    """
    if verdict == "probe":
        return DIAGNOSE
    if now is None:
        with suppress(GroundedError):  # a task that can't be planned, of which data say nothing
            handed = any(workspace.candidate_path("c").parent.glob("c*.mcap"))
            ran = handed and any(one.candidate for one in workspace.task_trials())
            if ran and (now := standing_in(workspace)).outstanding:
                return Situation(workspace, now).run
        return to_learn_from(workspace)
    if verdict == ASIDE and now.outstanding:
        return Situation(workspace, now).run
    if verdict == "run again":
        now = standing_in(workspace, ahead=True)
    here = Situation(workspace, now)
    goes_on = now.phase in (Phase.PROPOSE, Phase.AWAIT) and not (now.doubt or here.none_stood)
    return PROPOSE if goes_on else here.then


def after_diagnosis(workspace: Folder, found: Diagnosis) -> NextCommand:
    """Return the command after a diagnosis: adopt claims, run another trial, or read the report."""
    here = Situation(workspace, _standing_ahead(workspace), found)
    if found.probe and not here.adopt:
        return to_run(workspace, found.probe, found.probe)
    drawn = workspace.config.task.target or here.adopt or found.no_cause
    return here.then if drawn else REPORT


def _standing_ahead(workspace: Folder) -> Standing:
    """Return the standing, one proposal ahead if that can be planned with the current model."""
    try:
        return standing_in(workspace, ahead=True)
    except GroundedError:
        return standing_in(workspace)


def after_fit(workspace: Folder) -> NextCommand:
    """Return the command after a fit that does not predict better.

    It is what else the last diagnosis suggests, or a new diagnosis if model or trials changed.
    """
    here = Situation(workspace, _standing_ahead(workspace))
    if here.diagnosis is None or here.since.changed or here.since.newer:
        return DIAGNOSE
    return here.then
