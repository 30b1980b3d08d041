"""Where in a recording the run of a candidate begins: whoever records begins before the run.

Without a [log.span] the run is taken to begin with the first command in the log. A robot that sends
zeros while it waits has sent commands for a second by then, and its log looks like somebody else's
run. So at every instant of the log, as finely as it was sampled, the logged commands are compared
with what the policy would send on the states logged from there on, feedback and all. The instants
at which commands change say the rest. A log that ends before the run would have is compared as far
as it goes, where it was quiet before.

A table of rows shows a command that is held with the first row after its change, up to a row late:
at 2 m/s and 100 Hz that is 2 cm. Feedback tells when within that row the run began, since what was
sent answers to where the robot was then.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.logs.command_steps import changes_of, phase_of
from grounded_trials.logs.resample import Gridded, Span, to_grid
from grounded_trials.logs.signals import Series
from grounded_trials.workspace.intake.acted_on import acted_on
from grounded_trials.workspace.intake.instants import instants_apart, least_of
from grounded_trials.workspace.intake.missed_steps import missed_steps
from grounded_trials.workspace.intake.who_drove import (
    FINE,
    LEAST,
    SAME,
    UNLIKE,
    follows,
)

TRIED = 5  # instants at which the commands fit best
BESIDE = 4  # steps before the best of them, within which the commands may be the policy's exactly
HELD = 3.5  # steps: what changes no sooner may begin a run
FINEST = 8  # parts of a step, between which the start is sought
ALIGNED = 0.75  # of the time between samples: a start nearer than that is as good
CLEARLY = 0.7  # of the commands' difference at the first command: the start is elsewhere
KNOWN = 0.25  # of a row: the standard deviation from which feedback tells when in it a run began
EXACT = 0.1  # of what a row's lateness does to commands: with less, the states were the policy's
LOOSE = 0.1  # of a step: a start that is known no better is told
SOUGHT = 24  # instants at which the samples that the program acted on are sought
MOVES = 0.05  # of an input's size: commands that move by less fit whatever was held before
EXACT_TO = 1e-3  # of an input's size: half of the first commands are so near to the policy's there

# the samples of a log, with those of the states that nothing measures: estimated from the others
Complete = Callable[[Mapping[str, Series]], Mapping[str, Series]]


@dataclass(frozen=True)
class Start:
    """Where a policy's run seems to begin."""

    seconds: float  # after the log's first sample
    apart: float  # mean difference of the commands there, in units of each input's size
    alike: bool  # the commands are the policy's from there on
    opens_alike: bool  # they are at the beginning at least; somebody may have taken over
    between_rows: bool = False  # found below the time between rows, by the feedback
    loose_s: float = 0.0  # it may be off by as much
    missed: int = 0  # steps of it before the log's first command, which nobody sent
    exact: bool = False  # most commands are the policy's to the last digits, none somebody else's


@dataclass(frozen=True, eq=False)
class Recording:
    """A foreign log, to be cut anywhere; on a grid of `parts` instants a control step."""

    series: Mapping[str, Series]  # of every state and input
    logged: Mapping[str, Series]  # those of them that nothing estimated
    complete: Complete
    names: tuple[tuple[str, ...], tuple[str, ...]]
    angles: tuple[str, ...]
    dt: float
    steps: int
    past: Array  # (m,) what inputs hold before a run
    parts: int
    whole: Gridded
    changes: Array  # when a command was seen to change, seconds after the log's first sample
    late: Array  # by how much each may have been seen late [s]; 0 where it has its own stamp
    interval: float  # between samples [s]

    @property
    def first(self) -> float:
        """The first command, where a run begins if nothing else is known [s]."""
        return (self.whole.start_ns - self.whole.origin_ns) * 1e-9

    def trial_from(self, start: float) -> Trial | None:
        """The log as a trial that begins then, None where a state is not known in time."""
        span = Span(start=start)
        try:
            cut = to_grid(
                self.series,
                self.dt,
                *self.names,
                span,
                angles=self.angles,
                steps=self.steps,
                past=self.past,
            )
        except GroundedError:
            return None
        run = Trial(cut.states, cut.inputs, self.dt, *self.names, start_inputs=cut.start_inputs)
        return interpolate_gaps(run).trial if cut.late_s == 0 else None

    @property
    def openings(self) -> list[float]:
        """Instants from which commands change after they were held for some steps [s]."""
        held = np.diff(self.changes, prepend=-np.inf)
        return [float(at) for at in self.changes[held > HELD * self.dt]]

    def start_of(self, policy: Policy) -> Start | None:
        """Where a policy's run begins: the best of all instants; None for a log too short to tell.

        Args:
            policy: what is sought, for the states and inputs of this log.
        """
        if (policy.state_names, policy.input_names) != self.names or policy.dt != self.dt:
            return None
        apart, until, strays = instants_apart(self.whole, self.parts, policy)
        whole = self._starts(policy, apart)
        if (found := self._surest(policy, whole)) is None:
            begun = [one for one in self._starts(policy, until) if one.opens_alike]
            found = min(begun or whole, key=lambda one: (not one.alike, one.apart), default=None)
        if found is None or not found.alike:
            found = self._by_its_samples(policy, strays) or found
        found = found and self._exactly(policy, found)
        first, _ = self._on_step(policy, self.first)
        missed = missed_steps(self, policy, first, found.seconds if found else first)
        if not missed:
            return found
        apart_s = found.apart if found else np.inf
        return Start(first - missed * self.dt, apart_s, True, True, missed=missed)

    def _surest(self, policy: Policy, starts: Sequence[Start]) -> Start | None:
        """Of a run's likeliest places, where most of its commands are the policy's; None: nowhere.

        A mean counts what a program sent in the first steps' place, and what is at its limits as
        much as what says when it was sent; half of the commands, on the samples that they were
        made from, count neither.
        """
        alike = [one for one in starts if one.alike]
        likeliest = min(alike or starts, key=lambda one: one.apart, default=None)
        if likeliest is None:
            return None
        near = [one for one in starts if SAME * one.apart <= likeliest.apart] if alike else []
        if len(near) == 1:
            return likeliest
        fits = [(acted_on(self, policy, one.seconds), one) for one in near or [likeliest]]
        told = [(fit, one) for fit, one in fits if fit is not None and fit.told.sum() >= LEAST]
        fit, best = min(told, key=lambda pair: pair[0].left, default=(None, likeliest))
        if fit is not None and fit.throughout:
            return replace(best, alike=True, opens_alike=True, exact=True)
        usual = next((other.left for other, one in told if one is likeliest), np.inf)
        if fit is not None and alike and fit.left < SAME * usual:
            return replace(best, opens_alike=True)
        return likeliest if alike else None

    def _by_its_samples(self, policy: Policy, strays: Array) -> Start | None:
        """Where the first commands are the policy's to the last digits, on samples of some age.

        Gains that throw an input from limit to limit make another command of a state that is a
        millisecond younger, and a run that fell is not whole.
        """
        first = least_of(policy.horizon)

        def off(at: float) -> float:
            """Of half of the first commands, which must tell something; infinite if they don't."""
            fit = acted_on(self, policy, at)
            told = np.zeros(0, int) if fit is None else np.flatnonzero(fit.told[:first])
            if fit is None or len(told) < LEAST:
                return np.inf
            moves = bool((np.ptp(fit.asked[told], axis=0) > MOVES * fit.size).any())
            return float(np.median(fit.off[told])) if moves else np.inf

        tried, left = dict[float, float](), strays.copy()
        while len(tried) < SOUGHT and np.isfinite(left).any() and policy.gain is not None:
            k = int(np.argmin(left))
            left[max(0, k - self.parts + 1) : k + self.parts] = np.inf
            at, _ = self._on_step(policy, self.first + k * self.dt / self.parts)
            tried[at] = off(at)
        best = min(tried, key=tried.__getitem__, default=0.0)
        if not tried or tried[best] > EXACT_TO:
            return None
        return Start(best, self.apart_at(policy, best), alike=False, opens_alike=True)

    def _exactly(self, policy: Policy, found: Start) -> Start:
        """A start some steps sooner, where the commands are the policy's exactly, if they are.

        Where lively gains throw noise from limit to limit, a mean may be less some rows off.
        """
        here = acted_on(self, policy, found.seconds) if found.opens_alike else None
        if policy.gain is None or here is None or here.exact:
            return found
        for steps in range(1, BESIDE + 1):  # later they are, too, in a log that has them late
            at = found.seconds - steps * self.dt
            fit = acted_on(self, policy, at)
            if fit is not None and fit.throughout:
                apart = self.apart_at(policy, at)
                return replace(found, seconds=at, apart=apart, alike=True, exact=True)
        return found

    def _starts(self, policy: Policy, apart: Array) -> list[Start]:
        """The likeliest places, by how little differs from each instant on."""
        found, left = list[Start](), apart.copy()
        while len(found) < TRIED and np.isfinite(left).any():
            k = int(np.argmin(left))
            left[max(0, k - self.parts) : k + self.parts + 1] = np.inf
            on_step, room = self._on_step(policy, self.first + k * self.dt / self.parts)
            seconds, loose = self._between_rows(policy, on_step, room)
            trial = self.trial_from(seconds)
            fit = None if trial is None else follows(policy, trial.until(policy.horizon), 0)
            if trial is not None and fit is not None:
                alike = fit.alike and not fit.late and _close(policy, trial)
                opens = alike or fit.until_s >= LEAST * self.dt
                between = seconds < on_step
                found.append(Start(seconds, float(apart[k]), alike, opens, between, loose))
        return found

    def apart_at(self, policy: Policy, start: float) -> float:
        """The mean difference of the commands from an instant on, as `Start.apart`."""
        k = round((start - self.first) * self.parts / self.dt)
        if not 0 <= k < len(self.whole.inputs):
            return np.inf
        return float(instants_apart(self.whole, self.parts, policy, range(k, k + 1))[0][k])

    def _on_step(self, policy: Policy, start: float) -> tuple[float, float]:
        """A start moved to where commands change, by less than a step, and the room before it."""
        dt, length = self.dt, self.dt * policy.horizon
        inside = (self.changes > start - dt / 2) & (self.changes < start + length)
        late = self.late[inside]
        if (found := phase_of(self.changes[inside] - start, dt, late)) is None:
            return start, float(np.median(late)) if len(late) else 0.0
        phase, room = found
        if abs(phase) < dt / 4:
            return start + phase, room
        tried = [start + phase + move * dt for move in (-1, 0, 1)]
        return min(tried, key=lambda one: self._misfit(policy, one)), room

    def _misfit(self, policy: Policy, start: float) -> float:
        """The mean difference of the commands of the trial from there, in units of their size."""
        trial = self.trial_from(start)
        T = 0 if trial is None else min(trial.finite_steps, policy.horizon)
        if trial is None or T < LEAST:
            return np.inf
        sent = np.clip(trial.inputs[:T], policy.low, policy.high)
        asked = policy.commands(trial.states[None, :T], policy.past)[0]
        return float((np.abs(asked - sent) / (np.abs(sent).max(axis=0) + 1e-12)).mean())

    def _between_rows(self, policy: Policy, start: float, row: float) -> tuple[float, float]:
        """A start moved back by less than a row, to where the feedback says that it was [s].

        And how far it may be off: a row, where what was sent is not what the policy makes of the
        logged states at any time within it. `row`: what the changes of the commands leave of it.
        """
        if policy.gain is None or not row:
            return start, 0.0
        late, early = self.trial_from(start), self.trial_from(start - row)
        if late is None or early is None:
            return start, 0.0
        T = min(late.finite_steps, early.finite_steps, policy.horizon)
        if T < LEAST:
            return start, 0.0
        states = np.stack([late.states[:T], early.states[:T]])
        asked, before = policy.commands(states, policy.past)
        sent = np.clip(late.inputs[:T], policy.low, policy.high)
        unit = np.abs(policy.feedforward).max(axis=0) + 1e-12
        free = (asked > policy.low) & (asked < policy.high)
        slope, off = (((v - asked) / unit)[free] for v in (before, sent))
        power = float(slope @ slope)
        if not power:
            return start, 0.0
        share = float(slope @ off) / power
        left = float(((off - share * slope) ** 2).mean())
        loose = row if left * len(off) > EXACT**2 * power else 0.0
        if left > KNOWN**2 * power or not -KNOWN < share < 1 + KNOWN:
            return start, loose
        return start - float(np.clip(share, 0.0, 1.0)) * row, loose


def _close(policy: Policy, trial: Trial) -> bool:
    """Whether commands differ by little of what unrelated ones do.

    A start that is sought over a whole log fits by luck where one that is given does not: states
    of any age within two steps, which `follows` allows, are not enough.
    """
    T = min(trial.finite_steps, policy.horizon)
    sent = np.clip(trial.inputs[:T], policy.low, policy.high)
    asked = policy.commands(trial.states[None, :T], policy.past)[0]
    usual = sum(np.abs(u - u.mean(axis=0)).mean(axis=0) for u in (sent, asked))
    finest = FINE * np.abs(policy.feedforward).max(axis=0)
    return bool((np.abs(sent - asked).mean(axis=0) <= UNLIKE * usual + finest).all())


def recording(
    logged: Mapping[str, Series],
    task: Task,
    complete: Complete,
    series: Mapping[str, Series] | None = None,
) -> Recording | None:
    """A log whose run may begin anywhere; None where it can't be cut.

    Args:
        logged: the samples that it has.
        task: whose steps it is cut into.
        complete: how those of every state and input come of them.
        series: those, where they are known.
    """
    series = complete(logged) if series is None else series
    model, dt = task.model, task.dt
    names = (model.state_names, model.input_names)
    every = [float(np.median(np.diff(np.sort(s.t)))) for s in series.values() if len(s.t) > 1]
    interval = max(every, default=dt * 1e9) * 1e-9
    parts = 2 * int(np.clip(np.ceil(dt / max(interval, 1e-9) / 2 - 0.01), 1, FINEST / 2))
    try:
        whole = to_grid(series, dt / parts, *names, angles=model.angles)
    except GroundedError:
        series = {n: _bridged(one) if n in names[0] else one for n, one in series.items()}
        try:
            whole = to_grid(series, dt / parts, *names, angles=model.angles)
        except GroundedError:
            return None
    sent = [series[name] for name in model.input_names]
    seen = [changes_of(s.t, s.values) for s in sent]
    at, late = (np.concatenate(x) for x in zip(*seen, strict=True))
    changes, late = (at - whole.origin_ns) * 1e-9, late * 1e-9
    return Recording(
        series,
        logged,
        complete,
        names,
        model.angles,
        dt,
        task.horizon,
        task.past,
        parts,
        whole,
        changes,
        late,
        interval,
    )


def _bridged(series: Series) -> Series:
    """Samples whose gaps are no reason not to look: the run that is found is cut with them."""
    longest = float(np.ptp(series.t)) * 1e-9 if len(series.t) else 0.0
    return replace(series, spec=replace(series.spec, max_age_s=longest))


def elsewhere(log: Recording, found: Start, policy: Policy, why: str) -> bool:
    """Whether a run begins where it was found, not with the log's first command."""
    if found.missed or (found.between_rows and found.alike):
        return True
    if not found.opens_alike or abs(found.seconds - log.first) <= ALIGNED * log.interval:
        return False
    return bool(why) or found.exact or found.apart < CLEARLY * log.apart_at(policy, log.first)


def loosely(seconds: float, ran: str) -> str:
    """What a person should know of a start that the feedback does not tell within a row."""
    return (
        f"where the run begins is known to {1e3 * seconds:.3g} ms only, the time between the log's "
        f"rows: its commands are not exactly what {ran} sends on the logged states, which would "
        "tell. Log the states that the controller used (no velocities that were differentiated or "
        "filtered afterwards), or the time at which it sent each command"
    )
