"""propose and status in a workspace: ask the search, and write the candidate's file."""

from __future__ import annotations

import math
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grounded.errors import GroundedError, NextCommand
from grounded.result import Result, figure
from grounded.search.scatter import NoiseSoFar, noise_cost, noise_missed
from grounded_trials.wording import ranges, rendered, what_became
from grounded_trials.workspace.candidates.exported_files import to_run
from grounded_trials.workspace.candidates.handover import (
    INSPECT,
    Void,
    check_log,
    checked_candidate,
    outside_limits,
    unmapped,
)
from grounded_trials.workspace.candidates.search_state import answered, planned, standing_in
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import (
    Since,
    left_out,
    readable_diagnosis,
    since_diagnosis,
    usable_ids,
)
from grounded_trials.workspace.next_step import doubted, next_command, not_adopted, not_ingested
from grounded_trials.workspace.off_target import OffTarget, off_target_of
from grounded_trials.workspace.placing import FromStarts, from_starts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from grounded.diagnosis.report import Diagnosis
    from grounded.figures.figure import Figure
    from grounded.search.candidate import Candidate
    from grounded.search.standing import Proposal, Standing
    from grounded_trials.workspace.identity import StoredTrial

PROPOSE = NextCommand("propose")
MOSTLY = 0.5  # share of a loss that is told if it is due to where runs began


@dataclass(frozen=True, eq=False, repr=False)
class Proposed(Result):
    """The result of `propose`."""

    proposal: Proposal
    file: Path | None  # the candidate's file; None if the search has ended
    then: NextCommand
    noise_cost: float = 0.0  # expected cost of sensor noise in its log, beyond what is predicted
    off_target: tuple[OffTarget, ...] = ()  # errors of the predicted run, in units
    lacks: str = ""  # what the last diagnosis found and the model lacks
    noise_in_log: float = 0.0  # expected cost of all of the sensor noise in its log
    from_starts: FromStarts | None = None  # from where runs began so far; None: too few are known

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
        found = self.proposal.to_json() | {"file": str(self.file) if self.file else None}
        errors = [one.to_json() for one in self.off_target]
        age = self.candidate.sample_age if self.candidate else None
        begun = self.from_starts and {
            "utility_change": self.from_starts.change,
            "std": self.from_starts.std,
            "runs": self.from_starts.runs,
        }
        found |= {"noise_cost": self.noise_cost, "off_target": errors, "sample_age_s": age}
        return found | {"from_usual_starts": begun}


@dataclass(frozen=True, eq=False, repr=False)
class Status(Result):
    """The result of `status`: where the search stands, and what to do next."""

    standing: Standing
    then: NextCommand
    again: NextCommand  # runs or exports the best candidate once more; `next` once it is exported
    outdated: str = ""  # why the last diagnosis is outdated
    notes: tuple[str, ...] = ()  # notes on the end of the search, and on trials that don't count
    discarded: dict[str, str] = field(default_factory=dict)  # t0004 -> why it is set aside
    off_target: tuple[OffTarget, ...] = ()  # errors of the best candidate's runs, in units
    diagnosis: Diagnosis | None = None  # the last one; None if there is none or it is damaged
    since: Since | None = None  # what changed since the diagnosis

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
        found = self.standing.to_json() | {"discarded": self.discarded}
        if found["best"] is not None:
            found["best"] |= {"off_target": [one.to_json() for one in self.off_target]}
        return found


def propose_in(workspace: Folder) -> Proposed:
    """Propose the next candidate, or the outstanding one again while its trial is missing.

    An outstanding candidate that has become void, and was not run, is replaced.

    Raises:
        GroundedError: if the candidate must not be handed over (see `handover`), a stored file is
            damaged, the task can't be planned, or [log] lacks an input or counts a delay twice (see
            `check_log`).
    """
    if not workspace.config.task.target:
        raise GroundedError(
            "there is no manoeuvre to learn: [task] names no target. Draw one with `grounded "
            "target`; `fit` and `diagnose` need none",
            NextCommand("target", ("SHAPE",)),
        )
    check_log(workspace)
    before, told = workspace.candidate_ids(), bool(workspace.noted.since)
    proposal, void = _handed_over(workspace)
    proposal = replace(proposal, standing=answered(workspace, proposal.standing))
    candidate = proposal.candidate
    notes = [f"{name} was not run and is void: {why}" for name, why in void.items()]
    left = _disowned(proposal.standing, workspace.discarded())
    if candidate is not None and proposal.is_new:
        notes = notes or left or _void(workspace, before)
    elif candidate is not None:
        notes += left
    if told:  # when the candidate that replaced them was handed out
        notes = [note for note in notes if note not in left]
    instead = f"; run {candidate.id} instead" if candidate is not None else ""
    notes = [f"{note}{instead}" for note in notes]
    held: list[str] = []
    if not proposal.standing.trials and (candidate is None or proposal.is_new):
        from grounded_trials.workspace.candidates.at_rest import held_before
        from grounded_trials.workspace.candidates.first_plan import left_open

        held = held_before(workspace, _other_model(workspace, before))
        notes += left_open(workspace, proposal, held)
    from grounded_trials.workspace.intake.remarks.gone_wrong import unanswered

    status = status_of(workspace, proposal.standing)
    if lacks := not_adopted(workspace, status.diagnosis) if candidate else "":
        notes.append(f"the last diagnosis found that {lacks}")
    if doubt := proposal.standing.doubt:
        since = status.since
        if doubted(proposal.standing, since, usable_ids(workspace)):
            notes.append(f"{doubt}: `{rendered(NextCommand('diagnose'), workspace.address)}`")
    proposal = replace(proposal, notes=(*proposal.notes, *notes))
    if candidate is None:
        _, asked = unanswered(workspace)
        if asked is not None:  # who proposes goes on; no candidate is handed out to show it
            digest = workspace.store.find(asked.arguments[0]).digest
            gone_on = {"note": "restore", "trial": digest, "why": ""}
            with suppress(GroundedError):  # a folder that can't be written
                workspace.notes.add(gone_on, again=False)
            vars(workspace).pop("noted", None)
            status = status_of(workspace, proposal.standing)
        ended = replace(proposal, standing=status.standing)
        then = PROPOSE if held else status.then  # after [task] start is changed, as noted
        return Proposed(ended, None, then)
    path = workspace.candidate_path(candidate.id)
    # the user should first correct the held input; a second `propose` hands the candidate out
    then = PROPOSE if held else to_run(workspace, candidate.id)
    if not held and proposal.is_new and not proposal.standing.trials:
        from grounded_trials.workspace.candidates.rest_at_end import to_end_at_rest

        if (rest := to_end_at_rest(workspace, candidate)) is not None:
            note = (
                "`next:` draws the same line so that the plan comes to rest. To run "
                f"{candidate.id} as it is: `{rendered(then, workspace.address)}`"
            )
            then = rest
            proposal = replace(proposal, notes=(*proposal.notes, note))
    noises = NoiseSoFar(workspace.task_trials(), workspace.base_model.n)
    same = [t for t in proposal.standing.history if t.candidate.id == candidate.id]
    noise = noises.before([candidate.id], candidate.seen)
    cost = same[0].noise_missed if same else noise_missed(workspace.task, candidate, noise)
    whole = noise_cost(workspace.task, candidate.policy, noise)
    predicted = off_target_of(workspace.task, [candidate.predicted_run])
    off_target = tuple(replace(one, end_std=0.0) for one in predicted)  # no log's last sample
    if not candidate.grounded:  # a run that no sensor measured
        off_target = tuple(replace(one, noise=0.0) for one in off_target)
    begun = from_starts(workspace, candidate)
    return Proposed(proposal, path, then, cost, off_target, lacks, whole, begun)


def _handed_over(workspace: Folder) -> tuple[Proposal, dict[str, str]]:
    """Write and check the next candidate; also return outstanding ones that are void: id -> why."""
    void: dict[str, str] = {}
    while True:
        seen = workspace.names()
        proposal = _proposal(workspace, void)
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
                raise GroundedError(
                    f"{proposal.standing.sentence}, but {'; '.join(error.reasons)}. Undo what was "
                    f"changed, or run {candidate.id} regardless with --anyway"
                ) from None
            void[candidate.id] = "; ".join(error.reasons)
        else:
            return replace(proposal, notes=(*proposal.notes, *handed.notes)), void


def _proposal(workspace: Folder, without: Collection[str]) -> Proposal:
    """Ask the search for a proposal as if some (void) candidates had never been proposed."""
    contents = workspace.read()
    candidates = tuple(c for c in contents.candidates if c.id not in without)
    return planned(workspace, replace(contents, candidates=candidates))


def _not_run(workspace: Folder, before: Sequence[str]) -> tuple[Candidate, dict[str, str]] | None:
    """Return the last candidate of the search with its metadata if no trial ran it, else None."""
    for name in reversed(before):
        made, meta = workspace.candidate(name)
        if meta.get("kind") == "search":
            return (
                None if any(t.trial.candidate == name for t in workspace.trials()) else (made, meta)
            )
    return None


def _disowned(now: Standing, aside: Collection[str]) -> list[str]:
    """Explain which latest candidates, never run, are void since a trial was discarded."""
    found = []
    for tried in reversed(now.history):
        if not tried.gone or tried.accepted:
            break
        if tried.void:
            name = tried.candidate.id
            found.append(
                f"{name} was not run and is void: {ranges(tried.gone)}, which it was made from, "
                f"{'is' if len(tried.gone) == 1 else 'are'} {what_became(tried.gone, aside)}. If "
                f"the robot has run it meanwhile, ingest that log with --candidate {name}: it "
                "counts"
            )
    return found


def _lost_by_starts(now: Standing) -> list[str]:
    """Name the steps from the best candidate whose losses are mostly due to where runs began.

    Their utilities in the table include that: one of -0.96 beside -0.51 was itself 0.04 worse.
    """
    if (best := now.incumbent) is None:
        return []
    own = best.candidate.id
    steps = [t for t in now.history if t.accepted is False and t.candidate.base == own]
    lost = {t.candidate.id: (best.utility - t.utility, t.excused(best)) for t in steps}
    return [
        f"{name} lost to {own} by {figure(loss)}; by the model {figure(due)} of that "
        "is due to where their runs began"
        for name, (loss, due) in lost.items()
        if math.isfinite(loss) and due > MOSTLY * loss
    ]


def _other_model(workspace: Folder, before: Sequence[str]) -> bool:
    """Return whether the search's last candidate was planned with another model, and never run."""
    last = _not_run(workspace, before)
    if last is None or last[1].get("task") != workspace.task.hash:
        return False
    return last[0].model != workspace.planner.fingerprint


def _void(workspace: Folder, before: Sequence[str]) -> list[str]:
    """Explain why the search's last candidate, never run, is replaced; [] if it is not."""
    if (last := _not_run(workspace, before)) is None:
        return []
    made, meta = last
    if meta.get("task") == workspace.task.hash:
        same = made.model == workspace.planner.fingerprint
        why = "the trial that it followed was set aside" if same else "the model was changed"
        why += " since it was made"
    elif (made.policy.state_names, made.policy.input_names) != (
        workspace.base_model.state_names,
        workspace.base_model.input_names,
    ):
        why = "it is for another robot"
    else:
        wider = list(outside_limits(workspace.task, made.policy))
        why = "; ".join(wider) or "the task was changed since it was made"
    return [f"{made.id} was not run and is void: {why}"]


def status_of(workspace: Folder, standing: Standing, notes: tuple[str, ...] = ()) -> Status:
    """Return a standing with the command to type next and the state of the last diagnosis.

    Raises:
        GroundedError: if a stored file is damaged.
    """
    usable = usable_ids(workspace)
    found = readable_diagnosis(workspace.reports)
    since = since_diagnosis(workspace, found, usable) if found else None
    then = next_command(workspace, standing, found, usable)
    if lost := unmapped(workspace):
        then = INSPECT
    return Status(
        _asking(workspace, standing, then),
        then,
        again_best(workspace, standing),
        since.sentence if since else "",
        (
            *notes,
            *_nothing_stored(workspace),
            *([f"{lost}: `propose` and `export` refuse until it does"] if lost else ()),
            *(_disowned(standing, workspace.discarded()) if standing.phase != "propose" else ()),
            *_lost_by_starts(standing),
            *_namesakes(workspace),
            *not_counted(uncounted(workspace, workspace.trials(), standing)),
            *left_out(workspace),
        ),
        workspace.discarded(),
        off_target_of(workspace.task, standing.incumbent.trials if standing.incumbent else ()),
        found,
        since,
    )


def _nothing_stored(workspace: Folder) -> list[str]:
    """Return a note that a log may be stored first, if it is not known which; [] if it is."""
    if workspace.store.list() or workspace.candidate_ids() or not_ingested(workspace):
        return []
    config = workspace.config
    if not config.log.has("state") or config.system.reachable:
        return []
    return [
        "no log is stored: with one of your robot (`ingest --data LOG`), `diagnose` finds what the "
        "model lacks; without, `propose` plans with the model as it is"
    ]


def _asking(workspace: Folder, now: Standing, then: NextCommand) -> Standing:
    """Return the standing, which asks for another run of the best one if `then` is that run."""
    if not now.asks_again or now.missed or now.incumbent is None:
        return now
    own = now.incumbent.candidate.id
    runs = then == to_run(workspace, own, "best")
    return replace(now, sentence=f"{now.sentence}; run {own} again") if runs else now


def status_in(workspace: Folder) -> Status:
    """Return where the search stands; it waits if its last trial should be discarded first."""
    from grounded_trials.workspace.intake.remarks.gone_wrong import unanswered

    asked, then = unanswered(workspace)
    if then is None:
        return status_of(workspace, standing_in(workspace, ahead=True))
    now = undecided(standing_in(workspace), then.arguments[0])
    return replace(status_of(workspace, now, asked), then=then)


def undecided(now: Standing, trial: str) -> Standing:
    """Return the standing as it waits for the user to discard a trial, or to go on with it.

    The verdict of a search that counts that trial would contradict the advice to discard it.
    """
    ran = next((t for t in now.history if trial in [one.id for one in t.trials]), None)
    if ran is None:
        return now
    sentence = f"discard {trial}, a run of {ran.candidate.id}, or go on with it: `propose`"
    history = tuple(replace(t, asked=True) if t is ran else t for t in now.history)
    waits = replace(now, phase="await-trial", outstanding=ran.candidate, missing=1, history=history)
    return replace(waits, sentence=sentence, ending="", then=None, doubt="", missed="")


def again_best(workspace: Folder, now: Standing) -> NextCommand:
    """Return the command for one more trial of the best candidate, see `to_run`."""
    if now.incumbent is None or workspace.config.system.reachable:
        return NextCommand("run", ("best",))
    best = now.incumbent.candidate.id  # "best" may be another one when the log comes in
    return to_run(workspace, best, best)


def uncounted(workspace: Folder, trials: Sequence[StoredTrial], now: Standing) -> list[str]:
    """Return trials of this model that ran no candidate of the search: of another task, or probes.

    Trials of another policy with the name of a candidate (see `_namesakes`) are left out.
    """
    own = {tried.candidate.id for tried in now.history}
    ran = [t for t in trials if t.trial.candidate and workspace.fits(t.trial)]
    return [
        t.stored.id for t in ran if "~" not in t.trial.candidate and t.trial.candidate not in own
    ]


def not_counted(names: Sequence[str]) -> list[str]:
    """Return a sentence saying that these trials only serve fit and diagnose; [] for none."""
    if not names:
        return []
    one, ran = len(names) < 2, "candidates of another task, or probes"
    return [
        f"{ranges(names)} {'counts' if one else 'count'} only as data, for fit and diagnose: "
        f"{'it' if one else 'they'} ran {ran}"
    ]


def _namesakes(workspace: Folder) -> list[str]:
    """Report trials that ran another policy of a candidate's name (after merging two folders)."""
    names: dict[str, list[str]] = {}
    for one in workspace.trials():
        if "~" in one.trial.candidate:
            names.setdefault(one.trial.candidate, []).append(one.stored.id)
    return [
        f"{', '.join(ids)} ran another policy that is also called {name.split('~')[0]}: only data, "
        "for fit and diagnose"
        for name, ids in names.items()
    ]
