"""The state of the search, DERIVED from candidates and stored trials; it is never stored itself.

The real system is run by people, so the paper's loop can't be a while loop. The candidates, in the
order of their proposal, and their trials determine:

    the incumbent    the best candidate so far, pi_theta^(i); its trials measure the next bias
    outstanding      the candidate that was proposed and has not been run often enough
    tried            the steps from the incumbent that did not improve (step 6)
    in doubt         a loss that may be luck: the incumbent is run again before it is accepted; or
                     that other start states explain, by the model: that run is repeated

Two trials of a candidate that agree to the last bit show that the system is deterministic, unless
other repeats differ: from then on nothing is run twice.

The same candidates and trials give the same state, at any time and in any process. A `Proposal` is
a state with what to run next.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from grounded.errors import NextCommand
from grounded.figures.figure import Figure
from grounded.result import Result, document, figure, html_table, percent, spread
from grounded.search.candidate import BY_STEP, LITTLE, Candidate, Tried, Way
from grounded.search.certainty import (
    LUCK,
    MANY,
    error_between,
    explained,
    few,
    judged,
    last_improvement,
    missed_by_start,
    runs_needed,
    runs_to_show,
)
from grounded.search.pictures import search_figure
from grounded.search.scatter import Repeats
from grounded.search.starts import Starts
from grounded.search.step.step_size import SearchOptions, Step, losers_of
from grounded.task import Task
from grounded.trial import Trial

if TYPE_CHECKING:
    from grounded.search.planner import Planner

Phase = Literal["propose", "await-trial", "converged", "stopped"]
Ending = Literal[
    "",  # the search goes on
    "nothing promised",  # the grounded model predicts no further gain
    "no step improved",  # step 7: real trials lost down to the smallest step
    "every step loses",  # already in the grounded model
    "too doubtful",  # other models that explain the trials predict a large loss
    "model diverges",  # when grounded on the best trial
    "crashed",  # every first policy crashed
    "not allowed",  # the next candidate violates [limits] or [safety]
    "gains too large",  # of the next candidate: a state that hardly moves, or weights
    "too little gained",  # by the last candidates
    "below the noise",  # steps lost, and the next promises less than a trial can show
    "trials used up",
]
PATIENCE = 4  # candidates in a row that may gain less than the tolerance each
LOST = 2  # steps in a row without improvement after which a diagnosis is suggested
AGAIN = 2  # runs of the best candidate after which a search that doubts its model ends
WILD = 100.0  # a trial worse than predicted, and than the best, by this factor: diagnose
MAX_CAUTION = 3  # times the first policy is made again, each time more gently, after a crash


@dataclass(frozen=True, eq=False, repr=False)
class Standing(Result):
    """The state of a search, with a sentence that describes it."""

    phase: Phase
    iteration: int  # accepted improvements so far
    incumbent: Tried | None
    outstanding: Candidate | None
    missing: int  # trials that the outstanding candidate still needs
    step: Step | None  # the next step, if a candidate is to be made
    way: Way
    caution: int
    history: tuple[Tried, ...]
    trials: int
    sentence: str
    ending: Ending = ""
    then: NextCommand | None = None  # a command that helps now
    doubt: str = ""  # why a diagnosis helps more than the next trial
    missed: str = ""  # the end of `sentence`, if that asks for a diagnosis

    def answered(self) -> Standing:
        """Return the standing after the diagnosis that it asked for."""
        if not self.missed:
            return self
        sentence = self.sentence.removesuffix(self.missed)
        return replace(self, sentence=sentence, then=None, doubt="", missed="")

    @property
    def asks_again(self) -> bool:
        """Whether another run of the best candidate may settle the doubt that ended the search."""
        few = self.incumbent is not None and len(self.incumbent.trials) < AGAIN
        return self.ending == "too doubtful" and few

    @property
    def utilities(self) -> list[float]:
        """Utility of the first policy, then of each accepted improvement."""
        return [t.utility for t in self.history if t.accepted]

    @property
    def outcome(self) -> str:
        """The phase in words; "converged" only if the model predicts no further gain."""
        if self.ending in ("", "nothing promised"):
            return {"propose": "going on", "await-trial": "waiting"}.get(self.phase, self.phase)
        return self.ending

    @property
    def less_in_log(self) -> str:
        """Why the candidate that waits for its first run may show less than the best; or ""."""
        made = self.outstanding
        waiting = (t for t in self.history if t.candidate is made and not t.trials)
        tried = next(waiting, None)
        if made is None or tried is None or self.incumbent is None:
            return ""
        return made.less_in_log(self.incumbent, tried.noise_missed)

    @property
    def lead_doubt(self) -> str:
        """A clause on what may explain the best one's lead on the model's own policy; or ""."""
        best, own = self.incumbent, self.history[0] if self.history else None
        if best is None or own is None or own.candidate.base or not own.utilities:
            return ""
        if best.candidate is own.candidate or not (why := explained(own, best, self.history)):
            return ""
        return f"{why} its lead on the model's own policy"

    def verdict(self, tried: Tried) -> str:
        """Return the verdict on a candidate, see `Tried.verdict`."""
        return tried.verdict(tried.candidate is (self.outstanding or self.history[-1].candidate))

    def summary(self) -> str:
        """Return the phase, the number of trials and the best candidate."""
        best = self.incumbent
        known = f"best {best.candidate.id}, utility {best.utility:.4g}" if best else "none yet"
        return f"{self.outcome}: trials {self.trials}, {known}"

    def to_json(self) -> dict[str, Any]:
        """Return the document of `grounded status --json`, with the whole history."""
        best = self.incumbent
        return document(
            phase=self.phase,
            iteration=self.iteration,
            best=best
            and {
                "candidate": best.candidate.id,
                "utility": best.utility,
                "lead_doubt": self.lead_doubt or None,
            },
            utilities=self.utilities,
            trials=self.trials,
            outstanding=self.outstanding.id if self.outstanding else None,
            missing=self.missing,
            sentence=self.sentence,
            ending=self.ending or None,
            certainty=last_improvement(self.history),
            history=[t.to_json() | {"verdict": self.verdict(t)} for t in self.history],
        )

    def table(self) -> tuple[list[tuple[str, ...]], tuple[str, ...]]:
        """Return (rows, header) of all candidates, as `grounded status` prints them."""
        header = ("id", "iter", "alpha", "damp", "predicted", "utility", "+-", "runs", "")
        return [self.row(one) for one in self.history], header

    def row(self, tried: Tried) -> tuple[str, ...]:
        """Return a candidate's row of the table."""
        return (
            tried.candidate.id,
            str(tried.candidate.iteration),
            f"{tried.candidate.alpha:g}",
            figure(tried.candidate.damping, 2) if tried.candidate.base else "-",
            figure(tried.promised),
            figure(tried.utility),
            spread(tried.standard_error),
            str(len(tried.trials)),
            self.verdict(tried),
        )

    def _repr_html_(self) -> str:
        """Return the candidates as a table and the phase as a sentence, for Jupyter."""
        from html import escape

        phase = f"<p>{escape(self.outcome)}: {escape(self.sentence)}</p>"
        whole = f"<details><summary>The whole document</summary>{super()._repr_html_()}</details>"
        return f"<b>Search</b>{html_table(*self.table())}{phase}{whole}"

    def figures(self) -> Sequence[Figure]:
        """Return the figure of utilities by candidate and step sizes."""
        found = search_figure(self)
        return () if found is None else (found,)


@dataclass(frozen=True, eq=False, repr=False)
class Proposal(Result):
    """What to run next, or why there is nothing: `candidate` is None if the search has ended."""

    standing: Standing
    candidate: Candidate | None
    is_new: bool  # whether the candidate was made by this call
    notes: tuple[str, ...] = ()
    refused: Candidate | None = None  # a candidate that was refused for the reasons in `notes`

    def summary(self) -> str:
        """Return the summary of the candidate, or of the standing if there is none."""
        return self.candidate.summary() if self.candidate else self.standing.summary()

    def to_json(self) -> dict[str, Any]:
        """Return the document of `grounded propose --json`; the command fills in `file`."""
        now, made = self.standing, self.candidate
        known = document(
            candidate=made and made.id,
            file=None,
            iteration=made.iteration if made else now.iteration,
            alpha=made and made.alpha,
            damping=made.damping if made and made.base else None,
            predicted_utility=made and made.predicted_utility,
            phase="await-trial" if made else now.phase,
            sentence=now.sentence,
            ending=None if made else now.ending or None,
            notes=self.notes,
        )
        best = document(best_utility=now.incumbent and now.incumbent.utility, new=self.is_new)
        return known | best if made else known


def standing(
    task: Task,
    candidates: Sequence[Candidate],
    trials: Sequence[Trial],
    options: SearchOptions,
    model: str,
    planner: Planner | None = None,
) -> Standing:
    """Derive the state of the search from stored trials (steps 6 and 7).

    Args:
        task: judges the trials.
        candidates: in order of proposal.
        trials: in order of storage; those of unknown candidates are ignored.
        options: the [search] table.
        model: fingerprint of the current planning model; a direction belongs to one model.
        planner: has that model, which tells what start states cost; None: that stays unknown.
    """
    starts = Starts(planner) if planner else None
    history, incumbent, iteration = judged(task, candidates, trials, options, model, starts)
    total = sum(len(t.trials) for t in history)
    now = Standing(
        phase="propose",
        iteration=iteration,
        incumbent=incumbent,
        outstanding=None,
        missing=0,
        step=None,
        way="",
        caution=0,
        history=history,
        trials=total,
        sentence="the first candidate is the model's own policy",
    )
    if (awaited := _awaited(now, options, model)) is not None:
        return awaited
    if total + options.repeats > options.max_trials:
        used = "all" if total >= options.max_trials else f"{total} of"
        needs = f"; a candidate needs {options.repeats}" * (total < options.max_trials)
        sentence = f"{used} {options.max_trials} trials are used up{needs} ([search] max_trials)"
        return replace(now, phase="stopped", sentence=sentence, ending="trials used up")
    if incumbent is None:
        failed = sum(t.accepted is False for t in history)
        if failed > MAX_CAUTION:
            sentence = (
                f"the first policy crashed {failed} times, although each was gentler: the model is "
                "too inaccurate to start from; correct it (fit, diagnose) and propose again"
            )
            return replace(
                now,
                phase="stopped",
                sentence=sentence,
                ending="crashed",
                then=NextCommand("diagnose"),
            )
        now = replace(now, step=options.first_step(), caution=failed)
        if failed:
            gone = history[-1].candidate.id
            now = replace(now, sentence=f"{gone} crashed: the next first policy is gentler")
        if failed < LOST or history[-1].candidate.model != model:
            return now
        why = f"{failed} policies crashed in a row: a diagnosis may show what the model lacks"
        return replace(now, sentence=why, then=NextCommand("diagnose"), doubt=why)
    own = incumbent.candidate.id
    step, way = _next_step(history, incumbent, options, model)
    if step is None:
        sentence = (
            f"no step improved on {own} down to alpha = {2.0**-options.max_halvings:g}: "
            f"{own} is the result"
        )
        return replace(now, phase="converged", sentence=sentence, ending="no step improved")
    if options.damps and (hardly := _hardly(history, options.tolerance, model)):
        ending, why = hardly
        why = f"{why}: {own} is the result"
        return let_down(replace(now, phase="converged", sentence=why, ending=ending), model)
    restarted = _restarted(history, model)
    last = history[-1]
    lost = f", since {last.candidate.id} crashed" * (last.accepted is False and bool(last.failed))
    sentence = f"improve on {own} with {step}{lost}{restarted}"
    if why := _suspicion(history, incumbent, model):
        asked = f"; {why}"
        now = replace(now, then=NextCommand("diagnose"), doubt=why, missed=asked)
        return replace(now, step=step, way=way, sentence=sentence + asked)
    return replace(now, step=step, way=way, sentence=sentence)


def _hardly(history: tuple[Tried, ...], tolerance: float, model: str) -> tuple[Ending, str] | None:
    """Return the ending and its reason if the last candidates gained too little, else None.

    Too little is less than the tolerance each on average, or in total less than the standard error
    of that gain, if repeats show it. Else a search under noise would follow lucky runs. A changed
    model is given LOST candidates of its own. A candidate that failed, perhaps because somebody
    stopped its run, measured no gain and does not count, unless all of the last ones failed.
    """
    history = tuple(t for t in history if t.accepted is not False or t.lost)
    if not all(t.crashed for t in history[-PATIENCE:]):
        history = tuple(t for t in history if not t.crashed)
    before = [t for t in history[:-PATIENCE] if t.accepted]
    last = history[-PATIENCE:]
    if not before or any(t.candidate.model != model for t in last[-LOST:]):
        return None
    old, best = before[-1], [t for t in history if t.accepted][-1]
    gained = best.gain_over(old)
    if gained == 0.0:
        return "no step improved", f"the last {PATIENCE} candidates did not improve"
    if any(t.candidate.way == BY_STEP for t in last) and before[-1].candidate.way != BY_STEP:
        return None  # the others say nothing about steps with these derivatives
    told = f"the last {PATIENCE} candidates gained {gained:.3g} in total, less than"
    if gained < PATIENCE * tolerance * abs(best.utility):
        return (
            "too little gained",
            f"{told} {100 * tolerance:g} % each on average ([search] tolerance)",
        )
    error, known = error_between(old, best, history)
    if known and gained < error:
        repeats = few(Repeats(history).near(best.utility).repeats) or " from repeats"
        return "too little gained", f"{told} its standard error of {error:.2g}{repeats}"
    return None


def _restarted(history: tuple[Tried, ...], model: str) -> str:
    """Return that a search goes on after losses because the model was changed since; "" if not."""
    row = list[Tried]()
    for tried in history:
        row = [] if tried.accepted else row + [tried] * tried.lost
    own = sum(tried.candidate.model == model for tried in row)
    if len(row) < PATIENCE or own >= LOST:
        return ""
    return (
        f"; the last {len(row)} candidates did not improve, but the model was changed "
        f"after {row[-1 - own].candidate.id}: {LOST} losses of its own end the search"
    )


def _due(tried: Tried, best: Tried) -> float:
    """Return the part of a loss to the best one that the start states explain by the model."""
    if tried.starts is None or not (tried.trials and best.trials):
        return 0.0
    owed = tried.starts.owed(tried, best)
    return max(-owed, 0.0) if math.isfinite(owed) else 0.0


def let_down(ended: Standing, model: str) -> Standing:
    """Return an ended search; it asks for a diagnosis if a step that promised much has lost.

    Much is more than LITTLE of the best cost, more than the step's own likely error, and not to be
    explained by noise.
    """
    best = ended.incumbent
    assert best is not None
    own, missed = best.candidate.id, list[Tried]()
    lost = losers_of(ended.history, own, model)
    for tried in ended.history:
        made = tried.candidate
        if made not in lost or made.doubtful:
            continue
        error, known = error_between(best, tried, ended.history)
        loss = best.utility - tried.utility - _due(tried, best)
        noise = max(LUCK * error if known else 0.0, tried.noise_cost)  # a plan may replay a log's
        short = loss + made.predicted_gain
        luck = short <= noise or max(loss, made.predicted_gain) <= noise
        if not luck:
            missed.append(tried)
    most = max(missed, key=lambda one: one.candidate.predicted_gain, default=None)
    if most is None or not most.candidate.predicted_gain > LITTLE * -best.utility:
        return ended
    gave = f"gave {figure(most.utility)}" if math.isfinite(most.utility) else "failed"
    cost = missed_by_start(most)
    said = figure(most.promised - cost) + " from where its runs began" * bool(cost)
    why = (
        f". But {most.candidate.id}, for which {said} was predicted, {gave}: the model is wrong "
        f"near {own}, and a diagnosis may show what it lacks"
    )
    then = NextCommand("diagnose")
    return replace(ended, sentence=ended.sentence + why, then=then, missed=why)


def _suspicion(history: tuple[Tried, ...], incumbent: Tried, model: str) -> str:
    """Return why a diagnosis would help more than the next trial; "" if there is no reason."""
    if history[-1].candidate.model != model:
        return ""  # the model has changed since: the next trial shows the effect
    lost = 0
    for tried in history:
        if tried is incumbent or tried.accepted is not False:
            lost = 0
        lost += tried.lost
    if lost >= LOST:
        return f"{lost} steps in a row did not improve: a diagnosis may show what the model lacks"
    if wild(incumbent):
        made = incumbent.candidate
        return (
            f"its trial gave {incumbent.utility:.4g}, but the model promised "
            f"{made.predicted_utility:.4g}: a diagnosis may show what the model lacks"
        )
    last = history[-1]
    if last.lost and _far_below(last, min(last.promised, incumbent.utility)):
        return (
            f"{last.candidate.id} gave {last.utility:.4g}, but {last.promised:.4g} was predicted: "
            "a diagnosis may show what the model lacks"
        )
    return ""


def wild(tried: Tried) -> bool:
    """Return whether a first policy did so much worse than predicted that its bias is useless."""
    return not tried.candidate.base and _far_below(tried, tried.promised)


def _far_below(tried: Tried, utility: float) -> bool:
    """Return whether a candidate's runs cost more by WILD times than a utility."""
    return bool(tried.utilities) and utility - tried.utility > WILD * max(abs(utility), 1e-9)


def _awaited(now: Standing, options: SearchOptions, model: str) -> Standing | None:
    """Return the standing while it waits for a trial; None if every candidate has its trials."""
    waiting = _waiting(now, model)
    doubt = next((t for t in now.history if t.in_doubt), None)
    if doubt is not None and now.incumbent is not None:
        best, missing = now.incumbent.candidate, 1
        made = doubt.candidate if doubt.to_settle == doubt.candidate.id else best
        lost, from_start = f"{doubt.candidate.id} lost to {best.id}", ""
        if excused := doubt.excused(now.incumbent):
            from_start = ", from [task] start"
            if made is best and len(doubt.trials) > 1:  # the start may have cost the other more
                from_start += f" ({doubt.candidate.id} ran {len(doubt.trials)} times)"
            gain = doubt.gain_over(now.incumbent)
            lost += (
                f" by {figure(now.incumbent.utility - doubt.utility)}, but by the model it lost "
                f"{figure(excused)} by where the runs began, and is itself "
                f"{figure(abs(gain))} {'better' if gain > 0 else 'worse'}"
            )
        elif Repeats(now.history).near(now.incumbent.utility).known:
            lost += " by no more than noise may explain"
        else:
            lost += ", but none as good ran twice, so how much such runs differ is not known"
        sentence = f"{lost}: {made.id} is waiting for another trial{from_start}"
        gap, whole = abs(doubt.gain_over(now.incumbent)), now.incumbent
        if excused and whole.deviation > 0 and gap > 0 and runs_to_show(gap, whole) > MANY:
            sentence += (
                f". To show that difference takes {runs_needed(gap, whole)} of each of the two: if "
                f"that is too many, stop with {best.id}"
            )
        else:
            sentence += _or_stop(doubt.candidate, whole)
    elif waiting is not None:
        made, missing = waiting.candidate, options.repeats - len(waiting.trials)
        sentence = f"{made.id} is waiting for {missing} trial{'s' * (missing > 1)}"
    else:
        return None
    return replace(now, phase="await-trial", outstanding=made, missing=missing, sentence=sentence)


def _or_stop(doubted: Candidate, best: Tried) -> str:
    """Return what is at stake in another run for a loss in doubt, and how to stop; "" for much."""
    share = max(doubted.promised_over(best), 0.0) / max(abs(best.utility), 1e-300)
    if share >= LITTLE or best.is_unsteady:
        return ""
    own = best.candidate.id
    promise = f"{percent(share)} of what {own} costs" if share > 0 else f"nothing over {own}"
    return (
        f". {doubted.id} promises {promise}: if that is not worth another run, stop with {own}, "
        "the best so far (`export best`)"
    )


def _waiting(now: Standing, model: str) -> Tried | None:
    """Return the latest candidate without its trials that is still valid, or None.

    It is invalid if a trial that it was made from was discarded since: the crash for which a first
    policy was made gentler, the run that a step starts from, or any other that the search knew. The
    one that was waiting before that trial then waits again.
    """
    undecided = {t.candidate.id for t in now.history if t.accepted is None}
    failed = sum(t.accepted is False for t in now.history)
    for tried in reversed(now.history):
        made = tried.candidate
        if tried.void or (tried.gone and tried.accepted is False and made.base):
            continue
        if tried.accepted is not None or made.model != model:
            return None
        if made.base not in undecided and (made.base or made.caution <= failed):
            return tried
    return None


def _next_step(
    history: tuple[Tried, ...], incumbent: Tried, options: SearchOptions, model: str
) -> tuple[Step | None, Way]:
    """Return the next step after the trials so far, and the way to make its direction."""
    ways = options.ways(incumbent.candidate)
    for way in ways:
        if (step := options.due(history, incumbent, model, way)) is not None:
            return step, way
    return None, ways[-1]
