"""The state of the search, DERIVED from candidates and stored trials; it is never stored itself.

The real system is run by people, so the paper's loop can't be a while loop. The candidates, in the
order of their proposal, and their trials determine:

    the incumbent    the best candidate so far, pi_theta^(i); its trials measure the next bias
    outstanding      the candidate that was proposed and has not been run often enough
    tried            the steps from the incumbent that did not improve (step 6)
    in doubt         a loss that may be luck: the incumbent is run again before it is accepted

Two trials of a candidate that agree to the last bit show that the system is deterministic, unless
other repeats differ: from then on nothing is run twice.

The same candidates and trials give the same state, at any time and in any process. A `Proposal` is
a state with what to run next.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from html import escape
from typing import TYPE_CHECKING, Any

from grounded.errors import NextCommand
from grounded.findings import Finding, found
from grounded.result import Result, document, figure, html_table, spread
from grounded.search.candidate import BY_STEP, DOUBTFUL_GAIN, Candidate, Tried
from grounded.search.difference import LUCK, Difference, judged, last_gain
from grounded.search.step_size import SearchOptions, Step, losers_of
from grounded.task import Task
from grounded.trial import Trial

if TYPE_CHECKING:
    from grounded.figures import Figure


class Phase(StrEnum):
    """What the search waits for."""

    PROPOSE = "propose"  # the next candidate is to be made
    AWAIT = "await-trial"  # the outstanding candidate is to be run
    CONVERGED = "converged"  # it has ended with a result
    STOPPED = "stopped"  # it has ended without one


class Ending(StrEnum):
    """Why a search has ended."""

    NONE = ""  # it goes on
    NOTHING_PROMISED = "nothing promised"  # the grounded model predicts no further gain
    NO_STEP = "no step improved"  # step 7: real trials lost down to the smallest step
    EVERY_STEP_LOSES = "every step loses"  # already in the grounded model
    DIVERGES = "model diverges"  # when grounded on the best trial
    CRASHED = "crashed"  # every first policy crashed
    NOT_ALLOWED = "not allowed"  # the next candidate violates [limits] or [safety]
    GAINS = "gains too large"  # of the next candidate: a state that hardly moves, or weights
    DOUBTFUL_GAIN = "too little gained"  # by the last candidates
    BELOW_NOISE = "below the noise"  # steps lost, and the next promises less than a trial can show
    USED_UP = "trials used up"


WORDS = {Phase.PROPOSE: "going on", Phase.AWAIT: "waiting"}  # the other phases are their own words
DIAGNOSE = NextCommand("diagnose")
# answered by a diagnosis
ASKS = ("search.diagnose", "search.lost_in_row", "search.far_off", "search.within_model")
DOUBTS = ("search.crashes", *ASKS)
RESULTS = (
    Ending.NOTHING_PROMISED,
    Ending.NO_STEP,
    Ending.DOUBTFUL_GAIN,
    Ending.BELOW_NOISE,
)  # endings with a result: the search has converged
PATIENCE = 4  # candidates in a row that may gain less than the tolerance each
LOST = 2  # steps in a row without improvement after which a diagnosis is suggested
WILD = 100.0  # a trial worse than predicted, and than the best, by this factor: diagnose
MAX_CAUTION = 3  # times the first policy is made again, each time more gently, after a crash


@dataclass(frozen=True, eq=False, repr=False)
class Standing(Result):
    """The state of a search, and why it is that."""

    phase: Phase
    iteration: int  # accepted improvements so far
    incumbent: Tried | None
    outstanding: Candidate | None
    missing: int  # trials that the outstanding candidate still needs
    step: Step | None  # the next step, if a candidate is to be made
    caution: int
    history: tuple[Tried, ...]
    trials: int
    findings: tuple[Finding, ...]  # why it stands so, then what helps
    ending: Ending = Ending.NONE

    @property
    def sentence(self) -> str:
        """The findings in words."""
        return "; ".join(one.sentence for one in self.findings)

    @property
    def then(self) -> NextCommand | None:
        """A command that helps now."""
        return next((one.then for one in self.findings if one.then), None)

    @property
    def asks(self) -> bool:
        """Whether it asks for a diagnosis of the trials so far."""
        return any(one.code in ASKS for one in self.findings)

    @property
    def doubt(self) -> Finding | None:
        """Why a diagnosis helps more than the next trial, while the search goes on."""
        doubts = (one for one in self.findings if one.code in DOUBTS)
        return next(doubts, None) if self.phase is Phase.PROPOSE else None

    def answered(self) -> Standing:
        """Return the standing after the diagnosis that it asked for."""
        return replace(self, findings=tuple(one for one in self.findings if one.code not in ASKS))

    def with_finding(self, one: Finding | None) -> Standing:
        """Return the standing with one more finding."""
        return replace(self, findings=(*self.findings, one)) if one else self

    @property
    def utilities(self) -> list[float]:
        """Utility of the first policy, then of each accepted improvement."""
        return [t.utility for t in self.history if t.accepted]

    @property
    def outcome(self) -> str:
        """The phase in words; "converged" only if the model predicts no further gain."""
        if self.ending in (Ending.NONE, Ending.NOTHING_PROMISED):
            return WORDS.get(self.phase, self.phase.value)
        return self.ending.value

    @property
    def lead(self) -> Difference | None:
        """How the best one compares with the model's own policy; None if that is the best."""
        best, own = self.incumbent, self.history[0] if self.history else None
        if best is None or own is None or own.candidate.base or not own.utilities:
            return None
        return Difference(own, best, self.history) if best.candidate is not own.candidate else None

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
        best, gain, lead = self.incumbent, last_gain(self.history), self.lead
        return document(
            phase=self.phase,
            iteration=self.iteration,
            best=best
            and {
                "candidate": best.candidate.id,
                "utility": best.utility,
                "lead_doubt": lead.lead.sentence if lead and not lead.sure else None,
            },
            utilities=self.utilities,
            trials=self.trials,
            outstanding=self.outstanding.id if self.outstanding else None,
            missing=self.missing,
            sentence=self.sentence,
            ending=self.ending or None,
            certainty=gain.to_finding().sentence if gain else "",
            findings=[one.to_json() for one in self.findings],
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
        phase = f"<p>{escape(self.outcome)}: {escape(self.sentence)}</p>"
        whole = f"<details><summary>The whole document</summary>{super()._repr_html_()}</details>"
        return f"<b>Search</b>{html_table(*self.table())}{phase}{whole}"

    def figures(self) -> Sequence[Figure]:
        """Return the figure of utilities by candidate and step sizes."""
        from grounded.search.pictures import search_figure  # that no `ingest` draws

        found = search_figure(self)
        return () if found is None else (found,)


@dataclass(frozen=True, eq=False, repr=False)
class Proposal(Result):
    """What to run next, or why there is nothing: `candidate` is None if the search has ended."""

    standing: Standing
    candidate: Candidate | None
    is_new: bool  # whether the candidate was made by this call
    findings: tuple[Finding, ...] = ()  # on the candidate, or why it was refused

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
            findings=[one.to_json() for one in (*now.findings, *self.findings)],
        )
        best = document(best_utility=now.incumbent and now.incumbent.utility, new=self.is_new)
        return known | best if made else known


def standing(
    task: Task,
    candidates: Sequence[Candidate],
    trials: Sequence[Trial],
    options: SearchOptions,
    model: str,
) -> Standing:
    """Derive the state of the search from stored trials (steps 6 and 7).

    Args:
        task: judges the trials.
        candidates: in order of proposal.
        trials: in order of storage; those of unknown candidates are ignored.
        options: the [search] table.
        model: fingerprint of the current planning model; a direction belongs to one model.
    """
    history, incumbent, iteration = judged(task, candidates, trials, options, model)
    total = sum(len(t.trials) for t in history)
    now = Standing(
        phase=Phase.PROPOSE,
        iteration=iteration,
        incumbent=incumbent,
        outstanding=None,
        missing=0,
        step=None,
        caution=0,
        history=history,
        trials=total,
        findings=(found("search.first"),),
    )
    if (awaited := _awaited(now, options, model)) is not None:
        return awaited
    if total + options.repeats > options.max_trials:
        needs = options.repeats if total < options.max_trials else None
        used = found("search.used_up", used=total, most=options.max_trials, needs=needs)
        return let_down(ended(now, Ending.USED_UP, used), model)
    if incumbent is None:
        return _none_stood(now, options, model)
    own = incumbent.candidate.id
    step = options.due(history, incumbent, model)
    if step is None:
        alpha = 2.0**-options.max_halvings
        least = found("search.no_step", own, best=own, alpha=alpha)
        return let_down(ended(now, Ending.NO_STEP, least), model)
    if options.damps and (hardly := _hardly(history, options.tolerance, model)):
        return let_down(ended(now, *hardly), model)
    last = history[-1]
    crashed = last.candidate.id if last.accepted is False and last.failed else None
    improve = found("search.step", own, best=own, step=str(step), crashed=crashed)
    now = replace(now, step=step, findings=(improve,))
    return now.with_finding(_suspicion(history, incumbent, model))


def ended(now: Standing, ending: Ending, *findings: Finding) -> Standing:
    """Return the standing of a search that has ended."""
    phase = Phase.CONVERGED if ending in RESULTS else Phase.STOPPED
    return replace(now, phase=phase, step=None, ending=ending, findings=findings)


def _none_stood(now: Standing, options: SearchOptions, model: str) -> Standing:
    """Return the standing before a first policy was run to its end."""
    crashes = sum(t.accepted is False for t in now.history)
    if crashes > MAX_CAUTION:
        return ended(now, Ending.CRASHED, found("search.crashed", then=DIAGNOSE, crashes=crashes))
    now = replace(now, step=options.first_step(), caution=crashes)
    if not crashes:
        return now
    last = now.history[-1].candidate
    why = found("search.first", last.id, crashed=last.id)
    if crashes >= LOST and last.model == model:
        why = found("search.crashes", then=DIAGNOSE, crashes=crashes)
    return replace(now, findings=(why,))


def _hardly(
    history: tuple[Tried, ...], tolerance: float, model: str
) -> tuple[Ending, Finding] | None:
    """Return the ending and its reason if the last candidates gained too little, else None.

    Too little is less than the tolerance each on average, or in total less than the standard error
    of that gain, if repeats show it. Else a search under noise would follow lucky runs. A changed
    model is given LOST candidates of its own. A candidate that failed, perhaps because somebody
    stopped its run, measured no gain and does not count, unless all of the last ones failed.
    """
    if len(history) <= PATIENCE:
        return None
    history = tuple(t for t in history if t.accepted is not False or t.lost)
    if not all(t.crashed for t in history[-PATIENCE:]):
        history = tuple(t for t in history if not t.crashed)
    before = [t for t in history[:-PATIENCE] if t.accepted]
    last = history[-PATIENCE:]
    if not before or any(t.candidate.model != model for t in last[-LOST:]):
        return None
    old, best = before[-1], [t for t in history if t.accepted][-1]
    gained, own = best.gain_over(old), best.candidate.id
    if gained == 0.0:
        return Ending.NO_STEP, found("search.no_step", own, best=own, last=PATIENCE)
    if any(t.candidate.way == BY_STEP for t in last) and before[-1].candidate.way != BY_STEP:
        return None  # the others say nothing about steps with these derivatives
    between = Difference(old, best, history)
    little = gained < PATIENCE * tolerance * abs(best.utility)
    if not little and not (between.known and gained < between.error):
        return None
    return Ending.DOUBTFUL_GAIN, found(
        "search.little",
        own,
        best=own,
        last=PATIENCE,
        gain=gained,
        least=tolerance if little else None,
        error=None if little else between.error,
    )


def let_down(now: Standing, model: str) -> Standing:
    """Return an ended search; it asks for a diagnosis if the model promises much that it lacks.

    A plan of the model alone promises what that reaches beyond the best run, a step that has lost
    what it was to gain. Much is more than DOUBTFUL_GAIN of the best cost, and not to be explained
    by noise.
    """
    best = now.incumbent
    if best is None:
        return now
    lost, most, gain = losers_of(now.history, best.candidate.id, model), None, 0.0
    for tried in now.history:
        made, between = tried.candidate, Difference(best, tried, now.history)
        if made.of_model_alone and made.model == model:
            short = promised = tried.promised - best.utility
        elif made in lost:
            loss, promised = -tried.gain_over(best), made.predicted_gain
            short = min(loss + promised, max(loss, promised))
        else:
            continue
        # a plan may replay a log's noise
        if promised > gain and short > max(
            LUCK * between.error if between.known else 0.0, tried.noise_cost
        ):
            most, gain = tried, promised
    if most is None or not gain > DOUBTFUL_GAIN * -best.utility:
        return now
    if not most.candidate.of_model_alone:
        return now.with_finding(_far_off(most, most.promised))
    own, reached = best.candidate.id, best.utility + gain
    facts: dict[str, Any] = {"best": own, "real": best.utility, "promised": reached, "by": gain}
    return now.with_finding(found("search.within_model", own, then=DIAGNOSE, **facts))


def _far_off(tried: Tried, promised: float) -> Finding:
    """Return that a candidate gave far less than was predicted, so that a diagnosis is due."""
    name, real = tried.candidate.id, tried.utility if math.isfinite(tried.utility) else None
    return found(
        "search.far_off", name, then=DIAGNOSE, candidate=name, real=real, promised=promised
    )


def _suspicion(history: tuple[Tried, ...], incumbent: Tried, model: str) -> Finding | None:
    """Return why a diagnosis would help more than the next trial; None if there is no reason."""
    last, lost = history[-1], 0
    if last.candidate.model != model:
        return None  # the model has changed since: the next trial shows the effect
    for tried in history:
        lost = tried.lost + (lost if tried is not incumbent and tried.accepted is False else 0)
    if lost >= LOST:
        return found("search.lost_in_row", then=DIAGNOSE, lost=lost)
    if wild(incumbent):
        return _far_off(incumbent, incumbent.candidate.predicted_utility)
    if last.lost and _far_below(last, min(last.promised, incumbent.utility)):
        return _far_off(last, last.promised)
    return None


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
        made, why = best, _in_doubt(doubt, now.incumbent)
    elif waiting is not None:
        made, missing = waiting.candidate, options.repeats - len(waiting.trials)
        why = found("search.waiting", made.id, candidate=made.id, missing=missing)
    else:
        return None
    return replace(now, phase=Phase.AWAIT, outstanding=made, missing=missing, findings=(why,))


def _in_doubt(doubt: Tried, best: Tried) -> Finding:
    """Return why a loss to the best one is in doubt, what another run may gain, and how to stop."""
    share = max(doubt.candidate.promised_over(best), 0.0) / max(abs(best.utility), 1e-300)
    return found(
        "search.in_doubt",
        best.candidate.id,
        candidate=best.candidate.id,
        loser=doubt.candidate.id,
        best=best.candidate.id,
        known=int(math.isfinite(best.deviation)),
        share=None if share >= DOUBTFUL_GAIN or best.is_unsteady else max(share, 1e-9),
    )


def _waiting(now: Standing, model: str) -> Tried | None:
    """Return the latest candidate without its trials that is still valid, or None.

    It is invalid if a trial that it was made from was discarded since: the crash for which a first
    policy was made gentler, the run that a step starts from, or any other that the search knew. The
    one that was waiting before that trial then waits again.
    """
    for tried in reversed(now.history):
        made = tried.candidate
        if tried.void or (tried.gone and tried.accepted is False and made.base):
            continue
        if tried.accepted is not None or made.model != model:
            return None
        undecided = {t.candidate.id for t in now.history if t.accepted is None}
        failed = sum(t.accepted is False for t in now.history)
        if made.base not in undecided and (made.base or made.caution <= failed):
            return tried
    return None
