"""Ask whether a run went as it should: sent or begun otherwise, reversed, ended early.

A motor wired the wrong way round, an encoder that slipped or a hand on the robot give a faultless
log of a run that says nothing about its candidate. The next plan would be based on it. A log of
other driving is asked about as well: with another that contradicts it, no diagnosis is possible.

A run whose commands are its candidate's to the last digits, and whose motion is near its
prediction, came about as it is logged: no story of its log or of its program is asked for then.

A log does not tell whether the robot crashed at its end, somebody stopped it, or only the recording
ended: it counts as failed, unless the user discards it.

By how much a start away from [task] start changes the utility, the model says: it runs the
candidate from there and from s_0. A run whose utility it changes much says nothing about its
candidate, and must be run again; unless it is better than the best from either start.

`ingest` asks once and notes it; `status` asks again (`identity.Noted.asked`), until the user has
decided: the trial is discarded or restored, or `propose` goes on.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded.accounts.levels import HALF, LATEST, STEPS_TO_JUDGE
from grounded.accounts.sent import (
    as_planned,
    follows,
    latest,
)
from grounded.findings import Finding, Quantity, Weight, found
from grounded.frozen import Array, median
from grounded.search.candidate import Candidate, Tried
from grounded.search.difference import Repeats, worth_of_start
from grounded.search.noise import sample_noise
from grounded.search.standing import Standing
from grounded.trial import Interpolated, Trial, interpolate_gaps
from grounded_trials.workspace.candidates.search_state import standing_in, standing_of
from grounded_trials.workspace.folder import Contents, Folder

SIGN_ASKED_FROM = 10.0  # times what runs miss otherwise: from here on an input's sign is asked
START_IS_OFF = 3.0  # times sensor noise, and earlier starts' rms, by which a start must be off
TOLD, SPOILT = 0.05, 0.5  # share of the run's cost by which the start changes it: told; too much
FEWEST = 2  # runs from which it is told how exactly the robot is placed
MEDIAN_TO_STD = 1.4826  # of the size of a normal variable
RECENT = 50  # runs that are looked at; the way of placing a robot may change


@dataclass(frozen=True, eq=False)
class Run:
    """A trial as stored, beside its candidate and the search."""

    workspace: Folder
    trial: Trial

    @cached_property
    def now(self) -> Standing | None:
        """The standing of the search with it; None for data, which never move a search."""
        return standing_in(self.workspace) if self.trial.candidate else None

    @property
    def history(self) -> Sequence[Tried]:
        """All candidates with their runs; none for data."""
        return self.now.history if self.now else ()

    @property
    def tried(self) -> Tried | None:
        """Its candidate with all of its runs; None if it ran none of the search."""
        for one in self.history:
            if one.candidate.id == self.trial.candidate:
                return one
        return None

    @cached_property
    def bridged(self) -> Interpolated:
        """The trial with short gaps bridged, and which these were."""
        return interpolate_gaps(self.trial)

    @property
    def whole(self) -> Trial:
        """The trial with short gaps bridged."""
        return self.bridged.trial

    @cached_property
    def run(self) -> Trial:
        """The same, as far as the task goes."""
        return self.whole.until(self.workspace.task.horizon)

    @cached_property
    def own(self) -> Candidate:
        """Its candidate."""
        return self.workspace.candidate(self.trial.candidate)[0]

    @cached_property
    def as_planned(self) -> bool:
        """Whether it came about as it is logged, see `accounts.sent.as_planned`."""
        known = self.trial.candidate in self.workspace.candidate_ids()
        return known and as_planned(self.own, self.whole.until(self.own.policy.horizon))

    def shown(self, *, own: bool, doubted: bool = False) -> Iterator[Finding | None]:
        """Yield what it shows of its log, its program, its start and its motion.

        `own` was written by grounded; `doubted` had its candidate named against its commands.
        """
        yield from self.log_faults(own=own)
        if self.trial.candidate and not (self.as_planned or doubted):
            yield self.ran_otherwise()
        yield self.begun_elsewhere() if self.trial.candidate else None
        yield self.gone_wrong()
        yield self.ended_early() if self.trial.candidate else None

    def log_faults(self, *, own: bool = False) -> tuple[Finding, ...]:
        """Return the faults of its columns; none are looked for if it came about as logged."""
        if self.as_planned:
            return ()
        from grounded_trials.workspace.intake.log_faults import log_faults

        return log_faults(self.workspace, self.whole, own=own)

    def ran_otherwise(self) -> Finding | None:
        """Return how a program ran its candidate otherwise than planned; None if it did not.

        Commands that are some steps late in a log, or on states some steps old, were sent late or
        logged late: commands and states alone do not tell which.
        """
        from grounded.accounts.returned import Kind, stories  # of runs that are not as planned

        task = self.workspace.task
        ran = follows(self.own.policy, self.run, max(LATEST, latest(task)))
        some = stories(task, self.own, self.run, ran)
        if some and some[0].kind is Kind.PROGRAM:
            return some[0].finding
        late = (ran.late or int(ran.age)) if ran else 0
        if ran is None or not (ran.alike and late and ran.moved < HALF**2):
            return None
        # the states acted on show a wrong start
        side = "late" if late > 0 else "early"
        start = late < 0 or ran.age <= HALF * late
        what = "start" if start else "either"
        return found("log.late", ran=self.own.id, steps=abs(late), side=side, what=what)

    def gone_wrong(self) -> Finding | None:
        """Return that an input seems reversed in its motion."""
        tried, run, missed, usual = self.tried, self.whole, 0.0, 1.0
        if self.as_planned:
            return None
        from grounded.search.run_motion import reversed_input

        every = [t for t in self.history if t.utilities and math.isfinite(t.utility)]
        others = [t for t in every if t is not tried]
        if tried:
            run, missed = self.run, tried.promised - self.workspace.task.utility(self.whole)
            usual = max(abs(tried.promised), 1e-9)
        if others:  # what the best one cost, and what runs miss otherwise
            cost = min(abs(t.utility) for t in others)
            off = np.array([abs(t.promised - t.utility) for t in others])
            usual = max(usual, cost, float(median(off)))
        turned = reversed_input(
            self.workspace.planner, run, astray=missed > SIGN_ASKED_FROM * usual
        )
        return self._is_it_wired(turned) if turned else None

    def _is_it_wired(self, turned: Finding) -> Finding:
        """Return that an input acted the other way round, given the other trials.

        If it did so in all of them, the model has the wrong sign: no run is at fault.
        """
        from grounded.search.run_motion import signs_of
        from grounded_trials.workspace.last_diagnosis import diagnosable

        each = [
            (one.id, signs_of(self.workspace.planner, one)[turned.about[0]])
            for one in diagnosable(self.workspace)
            if one.id != self.trial.id
        ]
        right, wrong = (tuple(name for name, sign in each if sign == s) for s in (1, -1))
        said = turned.also(others=right, alike=() if right else wrong)
        if right or (self.trial.candidate and not wrong):
            return said.also(trial=self.trial.id)
        return said.weighing(Weight.WARN)

    def begun_elsewhere(self) -> Finding | None:
        """Return in which states it did not start at s_0, beyond sensor noise; None if in none.

        A change of the utility below the scatter of single runs is not told. Offsets as other
        starts have them (`placing`) spoil nothing: a repeat would begin no nearer, and the search
        allows for what they cost.
        """
        workspace, task, trial, own = self.workspace, self.workspace.task, self.run, self.own
        if trial.finite_steps < 0:
            return None
        off, states = task.model.difference(trial.began, task.start), self._inside()
        noise = sample_noise(trial.until(len(states) - 1), own.predicted_states)
        noise = np.maximum(noise, 1e-9)
        order = np.argsort(-np.abs(off) / noise)
        far = order[np.abs(off)[order] > START_IS_OFF * noise[order]].tolist()
        if not far:
            return None
        # what the start costs, beside the scatter of single runs of about this cost
        cost = abs(task.utility(trial))
        if not np.isfinite(cost) or len(states) <= trial.finite_steps:
            cost = -own.predicted_utility
        contents = workspace.read()
        others = standing_of(workspace, contents, {trial.id})
        scatter = float(np.nan_to_num(np.sqrt(Repeats(others.history).near(-cost).variance)))
        change = worth_of_start(workspace.planner, own.policy, off)
        change = float(np.nan_to_num(change, nan=-np.inf))
        if abs(change) <= max(scatter, TOLD * cost):
            return None
        # a run that is better than the best from either start counts
        lead = task.utility(trial) - others.incumbent.utility if others.incumbent else np.nan
        (rms, runs), first = placing(workspace, contents, but=trial.id), far[0]
        usual = np.abs(off) <= START_IS_OFF * rms
        name, unit = list(task.model.states.items())[first]
        places = (trial.began, task.start, off)
        began, start, away = (Quantity(float(x[first]), unit) for x in places)
        facts: dict[str, Any] = {"ran": trial.candidate, "trial": trial.id, "change": change}
        facts |= {"state": name, "began": began, "start": start, "off": away}
        names = tuple(task.model.state_names[i] for i in far)
        spoilt = abs(change) > SPOILT * cost and not usual[far].all()
        if spoilt and not min(lead, lead - change) > 0:
            return found("run.start_spoils", *names, **facts)
        if usual[first]:
            facts |= {"runs": runs, "rms": Quantity(float(rms[first]), unit)}
        return found("run.start", *names, **facts)

    def _inside(self) -> Array:
        """Return the states before they left [safety], at least a few; all if they never did."""
        states = self.run.states[: self.run.finite_steps + 1]
        out = self._unsafe(states)
        return states[: max(int(np.argmax(out)), STEPS_TO_JUDGE)] if out.any() else states

    def _unsafe(self, states: Array) -> NDArray[np.bool_]:
        """Return which of some states (N, n) are outside [safety], (N,)."""
        inside = self.workspace.task.inside_safety(states)
        return np.asarray((states != inside).any(axis=1))

    def ended_early(self) -> Finding | None:
        """Return that it ended early; None if it did not."""
        horizon, run = self.workspace.task.horizon, self.whole
        if run.steps >= horizon or run.whole(horizon) is not run:
            return None
        told = found("run.failed", ran=self.own.id, trial=run.id)
        return told.also(steps=run.steps, horizon=horizon)


def placing(workspace: Folder, contents: Contents, but: str = "") -> tuple[Array, int]:
    """Return how far the latest runs of a task began off its start (rms, n), and how many they are.

    A run that was discarded counts too, since the robot was placed before it. The rms is estimated
    by the median, so that a misread log is no usual start; it is 0 of fewer than `FEWEST` runs.
    One of them may be left out (`but`), since it is judged by the others.
    """
    task, stored = workspace.task, (*workspace.trials(), *workspace.aside_trials())
    own = {made.id for made in contents.candidates}
    runs = (
        one.trial
        for one in sorted(stored, key=lambda one: one.stored.number)
        if one.trial.candidate in own and one.stored.id != but
    )
    off = [task.model.difference(run.began, task.start) for run in runs if workspace.fits(run)]
    known = np.array([one for one in off if np.isfinite(one).all()][-RECENT:])
    if len(known) < FEWEST:
        return np.zeros(task.model.n), len(known)
    return np.asarray(MEDIAN_TO_STD * median(np.abs(known))), len(known)
