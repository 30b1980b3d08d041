"""propose and status in a workspace: ask the search, and write the candidate's file."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, found, settle
from grounded.result import Result
from grounded.search.difference import in_question, last_gain
from grounded.search.noise import noise_cost, noise_missed, sensor_noise
from grounded.search.standing import Phase
from grounded_trials.wording import rendered
from grounded_trials.workspace.candidates.handover import (
    Void,
    check_log,
    checked_candidate,
    disowned,
    in_words,
)
from grounded_trials.workspace.candidates.search_state import (
    answered,
    asked_about,
    overtaken,
    planned,
    standing_in,
    undecided,
)
from grounded_trials.workspace.candidates.trust import Extent, extent_of, much_noise, promises
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import Since, left_out
from grounded_trials.workspace.next_step import Situation, to_run
from grounded_trials.workspace.off_target import OffTarget, off_target_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from grounded.diagnosis.parts import Diagnosis
    from grounded.figures import Figure
    from grounded.search.candidate import Candidate
    from grounded.search.standing import Proposal, Standing


@dataclass(frozen=True, eq=False, repr=False)
class Proposed(Result):
    """The result of `propose`."""

    proposal: Proposal
    file: Path | None  # the candidate's file; None if the search has ended
    then: NextCommand
    findings: tuple[Finding, ...] = ()  # what to know before the run, the heaviest first
    noise_cost: float = 0.0  # expected cost of sensor noise in its log, beyond what is predicted
    off_target: tuple[OffTarget, ...] = ()  # errors of the predicted run, in units
    again: bool = False  # whether the candidate was run before
    promises: Mapping[str, Finding] = field(default_factory=dict)  # by the label of a line
    extent: tuple[Extent, ...] = ()  # where the predicted run goes

    @property
    def candidate(self) -> Candidate | None:
        """The candidate to run next; None if the search has ended."""
        return self.proposal.candidate

    @property
    def standing(self) -> Standing:
        """The standing of the search."""
        return self.proposal.standing

    def summary(self) -> str:
        """Return the candidate, or the end of the search."""
        return self.proposal.summary()

    def to_json(self) -> dict[str, Any]:
        """Return the document of `propose --json`; candidate is null if the search has ended."""
        told = self.proposal.to_json() | {"file": str(self.file) if self.file else None}
        errors = [one.to_json() for one in self.off_target]
        age = self.candidate.sample_age if self.candidate else None
        every = [*self.standing.findings, *self.findings, *self.promises.values()]
        told |= {"notes": list(self.notes)}
        told |= {"findings": [one.to_json() for one in every]}
        return told | {"noise_cost": self.noise_cost, "off_target": errors, "sample_age_s": age}


@dataclass(frozen=True, eq=False, repr=False)
class Status(Result):
    """The result of `status`: where the search stands, and what to do next."""

    standing: Standing
    then: NextCommand
    findings: tuple[Finding, ...] = ()  # on the end of the search, and on trials that don't count
    certainty: tuple[Finding, ...] = ()  # of the last gain, and of what waits
    discarded: dict[str, str] = field(default_factory=dict)  # t0004 -> why it is set aside
    off_target: tuple[OffTarget, ...] = ()  # errors of the best candidate's runs, in units
    diagnosis: Diagnosis | None = None  # the last one; None if there is none or it is damaged
    since: Since | None = None  # what changed since the diagnosis
    adopted: tuple[tuple[str, str], ...] = ()  # name and values of what was adopted
    noise: float | None = None  # how much of the best's cost is sensor noise, if it is much

    def summary(self) -> str:
        """Return the phase and the best candidate."""
        return self.standing.summary()

    def _repr_html_(self) -> str:
        """Return the candidates, the outcome and the next command as HTML."""
        from html import escape

        then = escape(rendered(self.then))
        return f"{self.standing._repr_html_()}<p>next: <code>{then}</code></p>"

    def figures(self) -> Sequence[Figure]:
        """Return the figure of the utility by candidate."""
        return self.standing.figures()

    def to_json(self) -> dict[str, Any]:
        """Return the document of `status --json`, with the whole history."""
        told = self.standing.to_json() | {"discarded": self.discarded}
        every = (*self.standing.findings, *self.certainty, *self.findings)
        told |= {"findings": [one.to_json() for one in every]}
        if told["best"] is not None:
            told["best"] |= {"off_target": [one.to_json() for one in self.off_target]}
        return told


def propose_in(workspace: Folder, tick: Callable[[str], None] | None = None) -> Proposed:
    """Propose the next candidate, or the outstanding one again while its trial is missing.

    An outstanding candidate that has become void, and was not run, is replaced.

    Args:
        workspace: the workspace.
        tick: called with a line of progress during a long first plan.

    Raises:
        GroundedError: if the candidate must not be handed over (see `handover`), a stored file is
            damaged, the task can't be planned, or [log] lacks an input or counts a delay twice (see
            `check_log`).
    """
    if not workspace.config.task.target:
        raise GroundedError(found("plan.no_target", then=NextCommand("target", ("SHAPE",))))
    check_log(workspace)
    if doubted := asked_about(workspace):  # who proposes goes on with it
        workspace.note(note="restore", trial=doubted[0].stored.digest, why="")
    changed = [*filter(None, [overtaken(workspace, ran=True)])]
    proposal, void = _handed_over(workspace, tick)
    proposal = replace(proposal, standing=answered(workspace, proposal.standing))
    candidate, now = proposal.candidate, proposal.standing
    notes = [found("plan.void", name, candidate=name, why=why) for name, why in void.items()]
    left = _disowned(now, workspace.discarded())
    if candidate is not None:
        notes = notes + left if not proposal.is_new else notes or left or changed
        notes = [one.also(instead=candidate.id) for one in notes]
    if not now.trials and (candidate is None or proposal.is_new):
        from grounded_trials.workspace.candidates.first_plan import left_open  # not for `status`

        notes += left_open(workspace, candidate)
    status = status_of(workspace, now)
    if now.doubt and Situation(workspace, now, status.diagnosis).doubted:
        notes.append(now.doubt)
    if candidate is None:
        return _ended(workspace, proposal, status, notes)
    return _told(workspace, proposal, notes)


def _ended(
    workspace: Folder,
    proposal: Proposal,
    status: Status,
    notes: Sequence[Finding],
) -> Proposed:
    """Return that there is nothing to run."""
    best, converged = proposal.standing.incumbent, status.standing.phase is Phase.CONVERGED
    if best and converged and best.candidate.model != workspace.planner.fingerprint:
        notes = [*notes, found("plan.no_better", best.candidate.id)]
    over = replace(proposal, standing=status.standing)
    return Proposed(over, None, status.then, settle((*proposal.findings, *notes)))


def _told(workspace: Folder, proposal: Proposal, notes: Sequence[Finding]) -> Proposed:
    """Return a candidate with what it promises and how far that can be trusted."""
    made, now, task = proposal.candidate, proposal.standing, workspace.task
    assert made is not None
    same = [t for t in now.history if t.candidate.id == made.id]
    noise = sensor_noise(workspace.task_trials(), workspace.base_model.n)
    cost = same[0].noise_missed if same else noise_missed(task, made, noise)
    whole = noise_cost(task, made.policy, noise)
    ahead = off_target_of(task, [made.predicted_run])
    if not made.grounded:  # a run that no sensor measured
        ahead = tuple(replace(one, noise=0.0) for one in ahead)
    again = any(t.trials for t in same)
    slow = workspace.planner.plan.model.system.note
    notes = [*notes, *([found("plan.model", what=slow)] if slow else [])]
    return Proposed(
        proposal,
        workspace.candidate_path(made.id),
        to_run(workspace, made.id),
        settle((*proposal.findings, *notes)),
        cost,
        ahead,
        again,
        promises(workspace, made, now, cost, whole),
        extent_of(made, task),
    )


def _handed_over(
    workspace: Folder, tick: Callable[[str], None] | None
) -> tuple[Proposal, dict[str, str]]:
    """Write and check the next candidate; also return outstanding ones that are void: id -> why."""
    void: dict[str, str] = {}
    while True:
        seen = workspace.names()
        contents = workspace.read()  # as if the void ones had never been proposed
        kept = tuple(one for one in contents.candidates if one.id not in void)
        proposal = planned(workspace, replace(contents, candidates=kept), tick)
        candidate = proposal.candidate
        if candidate is None:
            return proposal, void
        if proposal.is_new:
            candidate = workspace.save_candidate(candidate, seen)
            if candidate is None:  # another process stored something meanwhile
                workspace.forget_trials()
                continue
            proposal = replace(proposal, candidate=candidate)
        else:
            workspace.bring_back(candidate.id)
        try:
            handed = checked_candidate(workspace, candidate.id, now=proposal.standing)
        except Void as error:
            if proposal.is_new:
                raise
            if any(t.trial.candidate == candidate.id for t in workspace.trials()):
                raise
            void[candidate.id] = in_words(error.reasons)
        else:
            return replace(proposal, findings=(*proposal.findings, *handed.findings)), void


def _disowned(now: Standing, aside: Collection[str]) -> list[Finding]:
    """Return which latest candidates, never run, are void since a trial was discarded."""
    void = []
    for tried in reversed(now.history):
        if not tried.gone or tried.accepted:
            break
        if tried.void:
            void.append(disowned(tried, aside))
    return void


def status_of(workspace: Folder, standing: Standing, notes: Sequence[Finding] = ()) -> Status:
    """Return a standing with the command to type next and the state of the last diagnosis."""
    standing = undecided(workspace, standing)
    here = Situation(workspace, standing)
    last, then = here.diagnosis, here.then
    gone = () if standing.phase is Phase.PROPOSE else _disowned(standing, workspace.discarded())
    asked = asked_about(workspace)
    every = [
        *notes,
        *([asked[1]] if asked else []),
        *gone,
        *filter(None, [overtaken(workspace)]),
        *uncounted(workspace, standing),
        *left_out(workspace),
        *here.since.findings,
    ]
    best = standing.incumbent
    return Status(
        standing,
        then,
        settle(every),
        _certainty(standing),
        workspace.discarded(),
        off_target_of(workspace.task, best.trials if best else ()),
        last,
        here.since if last else None,
        _adopted(workspace),
        much_noise(best.noise_cost, best.utility) if best else None,
    )


def _adopted(workspace: Folder) -> tuple[tuple[str, str], ...]:
    """Return what was adopted, without slow imports if nothing was."""
    if not (workspace.config.model.effects or workspace.config.model.params):
        return ()
    from grounded_trials.workspace.adoption import adopted_rows

    return adopted_rows(workspace)


def _certainty(now: Standing) -> tuple[Finding, ...]:
    """Return how certain the last gain is, and what the run that waits can show."""
    gain, waiting = last_gain(now.history), now.outstanding
    ran = {t.candidate.id for t in now.history if t.trials}
    small = None
    if gain and waiting and waiting.id not in ran and now.incumbent is not None:
        small = in_question(waiting, now.incumbent, now.missing)
    return tuple(one for one in (gain and gain.to_finding(), small) if one)


def status_in(workspace: Folder) -> Status:
    """Return where the search stands; it waits if its last trial should be discarded first."""
    return status_of(workspace, standing_in(workspace, ahead=True))


def uncounted(workspace: Folder, now: Standing) -> list[Finding]:
    """Return which trials of this model only serve fit and diagnose; [] for none.

    They ran a candidate of another task, or a probe.
    """
    own = {"", *(tried.candidate.id for tried in now.history)}
    fitting = (one for one in workspace.trials() if workspace.fits(one.trial))
    names = [one.stored.id for one in fitting if one.trial.candidate not in own]
    return [found("search.uncounted", *names)] if names else []
