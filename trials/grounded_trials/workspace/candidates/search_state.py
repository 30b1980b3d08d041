"""Where the search of a workspace stands, by its stored trials and candidates.

How a search ended is remembered, so that the end is not planned again by every command: whether a
step is worth a trial takes as long to find as a candidate does, up to half a minute of CPU. The end
follows from the files alone, so it is kept in the cache of compiled models, one file a workspace,
with a digest of all that it was made from. The workspace stores no end.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import grounded
from grounded.checks import refused
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, Weight, found
from grounded.search.planner import model_fingerprint
from grounded.search.standing import Ending, Phase, Proposal, Standing, ended, standing
from grounded.trial import Trial
from grounded_trials.workspace.folder import Contents, Folder
from grounded_trials.workspace.identity import StoredTrial, other_task

if TYPE_CHECKING:
    from grounded.search.candidate import Candidate
    from grounded.search.standing import Proposal

KIND = ".ended"
MODEL = "the model was changed"  # why a candidate is void
UNSAID = (Ending.NOT_ALLOWED, Ending.GAINS)  # ends that are told with the refused candidate


def standing_in(
    workspace: Folder, *, ahead: bool = False, contents: Contents | None = None
) -> Standing:
    """Return the standing of the search in a workspace.

    `ahead` also plans the next candidate, without writing it, which shows whether the search has
    anything left to gain.
    """
    contents = contents or workspace.read()
    now = standing_of(workspace, contents)
    if ahead and now.phase is Phase.PROPOSE and now.incumbent is not None:
        now = planned(workspace, contents).standing
    return answered(workspace, now)


def standing_of(workspace: Folder, contents: Contents, without: Collection[str] = ()) -> Standing:
    """Return the standing of the search by what a folder holds, without some trials."""
    task, options = workspace.task, workspace.config.search
    if (key := frozenset(without)) not in contents.standings:
        trials = list[Trial]()
        for one in contents.trials:
            if one.trial.id not in key and workspace.fits(one.trial):
                trials.append(one.trial)
        known = (task, contents.candidates, trials, options)
        contents.standings[key] = standing(*known, workspace.planner.fingerprint)
    return contents.standings[key]


def answered(workspace: Folder, now: Standing) -> Standing:
    """Return the standing, which asks for no diagnosis if there is one of all that it knows."""
    if not now.asks:
        return now
    from grounded_trials.workspace.last_diagnosis import readable_diagnosis, since_diagnosis

    if (found := readable_diagnosis(workspace.reports)) is None:
        return now
    return now.answered() if since_diagnosis(workspace, found).settled else now


def asked_about(workspace: Folder) -> tuple[StoredTrial, Finding] | None:
    """Return the last trial, and why `ingest` told to discard it, unless the user has decided."""
    last = next((t for t in reversed(workspace.trials()) if workspace.fits(t.trial)), None)
    why = workspace.noted.asked.get(last.stored.digest) if last else None
    if last is None or why is None:
        return None
    decided = {last.stored.path.stem, last.stored.digest} & workspace.noted.kept
    return None if decided else (last, Finding.from_json(json.loads(why)))


def undecided(workspace: Folder, now: Standing) -> Standing:
    """Return the standing as it waits for the user to discard the last trial, or to go on with it.

    The verdict of a search that counts that trial would contradict the advice to discard it.
    """
    asked = asked_about(workspace)
    trial = asked[0].stored.id if asked else ""
    ran = next((t for t in now.history if trial in [one.id for one in t.trials]), None)
    if ran is None:
        return now
    made, then = ran.candidate, NextCommand("discard", (trial,))
    why = found("search.discard_first", trial, trial=trial, candidate=made.id, then=then)
    history = tuple(replace(t, asked=True) if t is ran else t for t in now.history)
    waits = replace(now, phase=Phase.AWAIT, outstanding=made, missing=1, history=history)
    return replace(waits, findings=(why,), ending=Ending.NONE)


def planned(
    workspace: Folder, contents: Contents, tick: Callable[[str], None] | None = None
) -> Proposal:
    """Ask the search for a proposal, unless it is known to have ended with these contents."""
    from grounded.compile.run.jit import store
    from grounded.search.improve import propose

    task, options, planner = workspace.task, workspace.config.search, workspace.planner
    trials = [t.trial for t in contents.trials if workspace.fits(t.trial)]
    now = standing_of(workspace, contents)
    planning = now.phase is Phase.PROPOSE and now.incumbent is not None
    if planning and (known := known_end(workspace, contents, now)) is not None:
        return Proposal(known, None, is_new=False)
    name = workspace.next_id()
    made = propose(
        task, contents.candidates, trials, options, identity=name, planner=planner, tick=tick
    )
    end = made.standing.ending
    if planning and made.candidate is None and end not in (Ending.NONE, *UNSAID):
        findings = [one.to_json() for one in made.standing.findings]
        known_by = {"of": _digest(workspace, contents), "ending": end, "findings": findings}
        store(_place(workspace), json.dumps(known_by).encode(), KIND)
    return made


def known_end(workspace: Folder, contents: Contents, now: Standing) -> Standing | None:
    """Return the end of a search that was planned before; None if it goes on or is not known."""
    from grounded.compile.run.jit import stored

    kept = json.loads(stored(_place(workspace), KIND) or b"{}")
    if not kept or kept["of"] != _digest(workspace, contents):
        return None
    return ended(now, Ending(kept["ending"]), *map(Finding.from_json, kept["findings"]))


def _place(workspace: Folder) -> str:
    return hashlib.sha256(str(workspace.folder.resolve()).encode()).hexdigest()


def _digest(workspace: Folder, contents: Contents) -> str:
    """Return a digest of all that the end of a search follows from, with the version of the code.

    A stored trial's name has a hash of its contents.
    """
    planner, config = workspace.planner, workspace.config
    trials = [(one.stored.path.name, one.trial.candidate) for one in contents.trials]
    models = [model_fingerprint(task) for task in (planner.task, planner.plan)]
    digest = hashlib.sha256(repr((_version(), workspace.task.hash, models, trials)).encode())
    files = [workspace.candidate_path(one.id) for one in contents.candidates]
    for path in (config.file, workspace.folder / (config.model.file or config.file.name), *files):
        data = path.read_bytes() if path.is_file() else b""
        digest.update(repr((path.name, len(data))).encode() + data)
    return digest.hexdigest()


@cache
def _version() -> tuple[str, int]:
    """Return the version, and when the method's code last changed [ns]."""
    code = Path(grounded.__file__).parent.rglob("*.py")
    return grounded.__version__, max((path.stat().st_mtime_ns for path in code), default=0)


def candidate_named(workspace: Folder, name: str | None, now: Standing | None = None) -> str:
    """Return the id of the named candidate, of the best for `best`, of the outstanding for None."""
    if name is None:
        waiting = standing_in(workspace).outstanding
        if waiting is None:
            raise GroundedError(none_waits(workspace))
        return waiting.id
    if (name := name.lower()) != "best":
        workspace.candidate_bytes(name)  # raises if there is none
        return name
    best = (now or standing_in(workspace)).incumbent
    if best is None:
        raise refused("search.no_trial")
    return best.candidate.id


def overtaken(workspace: Folder, *, ran: bool = False) -> Finding | None:
    """Return that task or model is not the one that the search's latest candidate was made with.

    A candidate that was not run is void then. If it was run, its prediction is outdated, which
    matters where one is used or replaced: nothing is told of it without `ran`.
    """
    ran_by = {one.trial.candidate for one in workspace.whole_trials()}
    for name in reversed(workspace.candidate_ids()):
        with suppress(GroundedError):  # a damaged file is named elsewhere
            made, meta = workspace.candidate(name)
            if meta.get("kind") != "search":
                continue
            other = meta.get("task") != workspace.task.hash
            changed = not other and made.model != workspace.planner.fingerprint
            if name in ran_by:
                return found("plan.outdated", name, candidate=name) if changed and ran else None
            why = other_task(workspace.task, made) if other else MODEL
            void = found("plan.void", name, candidate=name, why=why, other=int(other))
            return void if other or changed else None
    return None


def none_waits(workspace: Folder, log: str = "", best: str = "") -> Finding:
    """Return that no candidate waits for a trial; if the model was changed, that this is why."""
    told = overtaken(workspace)
    if told is None or told.facts.get("why") != MODEL:
        told = found("search.none_waits", log=log or None)
    ran = best if told.code == "search.none_waits" else told.about[0]
    then = NextCommand("ingest", (log, "--candidate", ran)) if ran else None
    return replace(told, weight=Weight.REFUSE, then=then if log else NextCommand("propose"))


def latest_candidates(workspace: Folder, most: int) -> tuple[list[Candidate], list[Candidate]]:
    """Return the latest candidates of the task, probes and void ones too, and of earlier tasks.

    most: number of latest candidates that are looked at.
    """
    found: tuple[list[Candidate], list[Candidate]] = [], []
    for identity in workspace.candidate_ids()[-most:]:
        with suppress(GroundedError):  # a damaged file can't have been run
            candidate, meta = workspace.candidate(identity)
            found[meta.get("task") != workspace.task.hash].append(candidate)
    return found
