"""What comes next: one table for every command, the page, JSON and Python, see `NEXT`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from grounded.errors import GroundedError, NextCommand
from grounded.findings import found
from grounded.search.standing import LOST, Ending, Phase, Standing
from grounded_trials.workspace.candidates.exporting import to_run
from grounded_trials.workspace.candidates.search_state import standing_in
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import (
    Since,
    readable_diagnosis,
    since_diagnosis,
    usable_ids,
)
from grounded_trials.workspace.target_state import PROPOSE, TARGET, to_plan, undrawn
from grounded_trials.workspace.user_files.task_file import seen_in

if TYPE_CHECKING:
    from grounded.diagnosis.parts import Diagnosis

DIAGNOSE = NextCommand("diagnose")
EXPORT = NextCommand("export", ("best", "--runner"))
REPORT = NextCommand("report", ("--html",))
TRUE = 0.05  # of a utility: a prediction that misses by less came true


@dataclass(frozen=True, eq=False)
class Situation:
    """What decides what comes next; each property is a condition of `NEXT`, or a command there.

    Args:
        workspace: the workspace, whose model may have changed since the diagnosis.
        now: the standing of its search.
        diagnosis: the last diagnosis, or None.
        usable: the trials that a diagnosis can use now, in order of arrival.
    """

    workspace: Folder
    now: Standing
    diagnosis: Diagnosis | None
    usable: Sequence[str]

    @cached_property
    def since(self) -> Since:
        """What changed since the diagnosis."""
        if self.diagnosis is None:
            return Since()
        return since_diagnosis(self.workspace, self.diagnosis, self.usable)

    # conditions

    always = True

    @property
    def lacks_what_was_found(self) -> bool:
        """A better model plans better, at any point of the search."""
        return bool(self.adopt) and (not self.since.newer or _none_stood(self.now))

    @property
    def plan_leaves_safety(self) -> bool:
        """Proposing again would not help: another target does."""
        return self.now.ending is Ending.NOT_ALLOWED and not self.now.trials

    @property
    def log_not_stored(self) -> bool:
        """The log that the workspace was made from was not ingested."""
        return self.diagnosis is None and bool(not_ingested(self.workspace))

    @property
    def search_asks(self) -> bool:
        """The search asks for a command, and trials enough exist to answer it."""
        unsure = self.now.doubt and not doubted(self.now, None, self.usable)
        return self.diagnosis is None and bool(self.now.then) and not unsure

    @property
    def never_diagnosed(self) -> bool:
        """Logs before the first candidate, or an ended search, were not diagnosed."""
        logs = not self.now.history or self.now.phase is not Phase.PROPOSE
        return self.diagnosis is None and bool(self.usable) and logs

    @property
    def diagnosis_is_old(self) -> bool:
        """Newer logs, another model or the search's doubt ask for another diagnosis."""
        if self.diagnosis is None:
            return False
        logs = self.adopt is not None and not self.now.history
        other = _of_another_model(self.workspace, self.diagnosis, self.since)
        return logs or other or doubted(self.now, self.since, self.usable)

    @property
    def not_settled(self) -> bool:
        """An ended search was not diagnosed with all of its trials and its model."""
        if self.diagnosis is None:
            return False
        since = self.since
        done = since.settled or _came_true(self.workspace, self.now, self.diagnosis)
        return bool(since.repeats) or not done

    @property
    def again_tells(self) -> bool:
        """Another run of the best candidate may settle the doubt that ended the search."""
        return self.now.asks_again and self.diagnosis is not None

    @property
    def nothing_known(self) -> bool:
        """The trials can't identify any cause."""
        return self.diagnosis is not None and bool(self.diagnosis.no_cause)

    @property
    def nothing_to_plan(self) -> bool:
        """The trials can't identify any cause, and no manoeuvre was drawn yet."""
        return self.nothing_known and undrawn(self.workspace)

    @property
    def diagnosed(self) -> bool:
        """There is a diagnosis."""
        return self.diagnosis is not None

    # commands

    @cached_property
    def adopt(self) -> NextCommand | None:
        """The command that acts on the claims of the diagnosis, if it is of this model."""
        if self.diagnosis is None or self.since.changed:
            return None
        from grounded_trials.workspace.adoption import to_adopt  # slow, and seldom needed

        return to_adopt(self.workspace, self.diagnosis)

    @property
    def run(self) -> NextCommand:
        """One more trial of the candidate that waits, or of the best."""
        return another_trial(self.workspace, self.now)

    @property
    def ingest(self) -> NextCommand:
        """The log that the workspace was made from."""
        return NextCommand("ingest", ("--data", not_ingested(self.workspace)))

    @property
    def record(self) -> NextCommand:
        """The drive that tells the uncertain parameters; any other log if there are none."""
        params = self.workspace.base_model.params.values()
        uncertain = any(one.uncertain for one in params)
        return NextCommand("excite") if uncertain else NextCommand("ingest", ("--data", "LOG"))

    @property
    def asked(self) -> NextCommand | None:
        """The command that the search asks for."""
        return self.now.then

    @property
    def propose(self) -> NextCommand:
        """The next candidate; `target` if no manoeuvre was drawn yet."""
        return to_plan(self.workspace)

    target, diagnose, export = TARGET, DIAGNOSE, EXPORT


ANY, ENDED = tuple(Phase), (Phase.CONVERGED, Phase.STOPPED)
# what comes next: the first row whose phase and condition hold gives the command
NEXT: tuple[tuple[tuple[Phase, ...], str, str], ...] = (
    (ANY, "lacks_what_was_found", "adopt"),
    ((Phase.AWAIT,), "always", "run"),
    (ANY, "plan_leaves_safety", "target"),
    (ANY, "log_not_stored", "ingest"),
    (ANY, "search_asks", "asked"),
    (ANY, "never_diagnosed", "diagnose"),
    ((Phase.PROPOSE,), "diagnosis_is_old", "diagnose"),
    ((Phase.PROPOSE,), "nothing_to_plan", "record"),
    ((Phase.PROPOSE,), "always", "propose"),
    (ENDED, "not_settled", "diagnose"),
    (ENDED, "again_tells", "run"),
    (ENDED, "nothing_known", "run"),
    (ENDED, "diagnosed", "export"),
    (ENDED, "always", "propose"),
)


def next_command(
    workspace: Folder, now: Standing, diagnosis: Diagnosis | None, usable: Sequence[str]
) -> NextCommand:
    """Return the command to type next by `NEXT`, see `Situation`."""
    here = Situation(workspace, now, diagnosis, usable)
    for phases, condition, command in NEXT:
        if now.phase in phases and getattr(here, condition):
            then = getattr(here, command)
            return to_plan(workspace) if then == PROPOSE else then
    raise AssertionError(now.phase)


def outlook(now: Standing, then: NextCommand) -> Standing:
    """Return the standing; of a search that has ended, also that the model may change."""
    goes_on = now.phase in (Phase.PROPOSE, Phase.AWAIT)
    if then.verb == "fit" or (then.verb == "adopt" and not goes_on):
        return now.with_finding(found("search.adopt_first", then=then, fit=then.verb == "fit"))
    return now


def not_ingested(workspace: Folder) -> str:
    """Return the log that the workspace was made from if nothing was stored or planned yet; or "".

    Its name is known until the user deletes it from [limits]. It is "LOG" if it lies elsewhere.
    """
    log = "" if workspace.store.list() or workspace.candidate_ids() else seen_in(workspace.config)
    places = (Path(log), workspace.folder.parent / log, workspace.folder / log)
    return next((str(path) for path in places if path.exists()), "LOG") if log else ""


def _of_another_model(workspace: Folder, diagnosis: Diagnosis, since: Since) -> bool:
    """Return whether a gap was found in another model, of which nothing is adopted any more.

    That is so after `adopt --undo`, which often precedes a better model.py.
    """
    model = workspace.config.model
    kept = model.effects or model.params
    return since.changed and not kept and since.usable > 0 and diagnosis.kind != "none"


def _came_true(workspace: Folder, now: Standing, diagnosis: Diagnosis) -> bool:
    """Return whether a search has ended as predicted, with all adopted that was found before.

    A diagnosis of that model would then find little.
    """
    best, model = now.incumbent, workspace.planner.fingerprint
    adopted = {str(effect["name"]) for effect in workspace.config.model.effects}
    found = {*diagnosis.verdict.effects}
    if not found or not found <= adopted or now.doubt or now.then:
        return False
    if best is None or best.candidate.model != model:
        return False
    return abs(best.promised - best.utility) <= TRUE * abs(best.utility)


def doubted(now: Standing, since: Since | None, usable: Sequence[str]) -> bool:
    """Return whether the search doubts its model and enough new trials exist to diagnose it.

    Args:
        now: the standing of the search.
        since: what changed since the last diagnosis; None without one.
        usable: the trials that a diagnosis can use now. A single run would confirm nothing.
    """
    return bool(now.doubt) and (len(usable) if since is None else since.newer) >= LOST


def another_trial(workspace: Folder, now: Standing) -> NextCommand:
    """Return the command for one more trial: of the outstanding, the next or the best candidate."""
    waiting = now.phase is Phase.AWAIT
    if not waiting and (now.phase is Phase.PROPOSE or now.incumbent is None):
        return PROPOSE
    if waiting and now.outstanding is not None:
        return to_run(workspace, now.outstanding.id)
    assert now.incumbent is not None
    return to_run(workspace, now.incumbent.candidate.id, "best")


def after_log(workspace: Folder, verdict: str, now: Standing | None) -> NextCommand:
    """Return the command after ingesting a log: usually `propose`, `diagnose` for data or a probe.

    Data beside a search whose candidate waits leave that next.

    Args:
        workspace: the workspace that has stored the log.
        verdict: `Ingested.verdict`.
        now: the standing of the search including the log; None for data.
    """
    if verdict == "probe":
        return DIAGNOSE
    if now is None:
        with suppress(GroundedError):  # a task that can't be planned, of which data say nothing
            handed = any(workspace.candidate_path("c").parent.glob("c*.mcap"))
            ran = handed and any(one.candidate for one in workspace.task_trials())
            if ran and (now := standing_in(workspace)).phase == "await-trial":
                return another_trial(workspace, now)
        return DIAGNOSE
    goes_on = now.phase in (Phase.PROPOSE, Phase.AWAIT) and not now.doubt
    if goes_on and not _none_stood(now):
        return PROPOSE
    return next_command(
        workspace, now, readable_diagnosis(workspace.reports), usable_ids(workspace)
    )


def _none_stood(now: Standing) -> bool:
    """Return whether every policy that was run crashed."""
    return bool(now.history) and now.incumbent is None


def after_diagnosis(workspace: Folder, found: Diagnosis) -> NextCommand:
    """Return the command after a diagnosis: adopt claims, run another trial, or read the report."""
    from grounded_trials.workspace.adoption import to_adopt

    usable = usable_ids(workspace)
    if not found.no_cause:
        if (follow := to_adopt(workspace, found)) is not None:
            return follow
        if found.probe:
            return to_run(workspace, found.probe, found.probe)
        settled = found.kind in ("none", "unknown") or found.contested  # nothing to adopt
        if not settled or not workspace.config.task.target:
            return REPORT
        return next_command(workspace, _standing_ahead(workspace), found, usable)
    here = Situation(workspace, _standing_ahead(workspace), found, usable)
    return here.record if here.nothing_to_plan else here.run


def left_open(found: Diagnosis) -> bool:
    """Return whether a diagnosis leaves something that noise is not known to explain."""
    from grounded.diagnosis.error_report import open_noise

    return found.kind != "none" or bool(open_noise(found.prediction_error))


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
    if (found := readable_diagnosis(workspace.reports)) is None:
        return DIAGNOSE
    here = Situation(workspace, _standing_ahead(workspace), found, usable_ids(workspace))
    if here.since.changed or here.since.newer:
        return DIAGNOSE
    return next_command(workspace, here.now, found, here.usable)
