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

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.task import Task
from grounded.trial import LAST, Trial, interpolate_gaps
from grounded_trials.logs.command_steps import changes_of, phase_of
from grounded_trials.logs.resample import Gridded, Span, to_grid
from grounded_trials.logs.signals import Series
from grounded_trials.workspace.intake.acted_on import acted_on
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
QUIET_S = 1.0  # without a change of commands, before a run that the log does not have whole
SHORT = 4  # at least 1 / SHORT of a run tells that it was one
ALIGNED = 0.75  # of the time between samples: a start nearer than that is as good
CLEARLY = 0.7  # of the commands' difference at the first command: the start is elsewhere
KNOWN = 0.25  # of a row: the standard deviation from which feedback tells when in it a run began
EXACT = 0.1  # of what a row's lateness does to commands: with less, the states were the policy's
LOOSE = 0.1  # of a step: a start that is known no better is told
EXACTLY = 0.02  # of an input's size: the mean difference of a run that is sought by how it begins
BATCH = 256  # instants compared at once

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
        apart, until = self._apart(policy)
        whole = self._starts(policy, apart)
        if (found := self._surest(policy, whole)) is None:
            begun = [one for one in self._starts(policy, until) if one.opens_alike]
            found = min(begun or whole, key=lambda one: (not one.alike, one.apart), default=None)
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
        inside = 0 <= k < len(self.whole.inputs)
        return float(self._apart(policy, range(k, k + 1))[0][k]) if inside else np.inf

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

    def _apart(self, policy: Policy, instants: range | None = None) -> tuple[Array, Array]:
        """Two measures of every instant, infinite where it can't begin a run.

        Returns:
            The mean difference of the commands, where the log has the run whole, or begins it after
            a rest. And the part of the run after which commands are the policy's no more: of one
            that was cut, or stopped, in a log in which something moved before it.
        """
        sent, parts, H = self.whole.inputs, self.parts, policy.horizon
        sent = np.clip(sent, policy.low, policy.high)
        changed = np.any(np.diff(sent, axis=0, prepend=sent[:1]) != 0, axis=1)
        count, quiet = np.cumsum(changed), round(QUIET_S / self.dt * parts)
        apart, until = np.full((2, len(sent)), np.inf)
        least, steps = max(LEAST, H // SHORT), np.arange(1, H + 1)
        asked = range(len(sent)) if instants is None else instants
        wanted = [k for k in asked if self._left(k) >= min(least, H - LAST)]
        for ks, off, known in self._off(policy, wanted):
            left = known.sum(axis=1)
            before = np.maximum(ks - 1, 0)
            begun = count[before] == count[np.maximum(ks - 1 - quiet, 0)]
            whole = (left >= H - LAST) | (begun & (left >= least))
            apart[ks[whole]] = ((off * known).sum(axis=1) / left)[whole]
            mean = np.where(known, np.cumsum(off, axis=1) / steps, np.inf)
            alike = np.where(mean < EXACTLY, steps, 0).max(axis=1)
            at = mean[np.arange(len(ks)), np.maximum(alike - 1, 0)]
            lost = 1 - alike / H + 0.1 * at / EXACTLY  # a step more is no better, for more apart
            until[ks] = np.where(alike >= least, lost, np.inf)
        return apart, until

    def _left(self, k: int) -> int:
        """Steps that the log has from an instant on."""
        return (len(self.whole.inputs) - k - self.parts // 2 - 1) // self.parts + 1

    def _off(self, policy: Policy, wanted: Sequence[int]) -> Iterator[tuple[Any, Any, Any]]:
        """Differences of the commands (K, H), of instants (K,), and whether they are known."""
        states, sent, parts, H = self.whole.states, self.whole.inputs, self.parts, policy.horizon
        sent = np.clip(sent, policy.low, policy.high)
        width = policy.high - policy.low
        size = np.maximum(np.abs(sent).max(axis=0), np.abs(policy.feedforward).max(axis=0))
        size = size + np.where(np.isfinite(width), 0.1 * width, 1e-12)
        steps = parts * np.arange(H)
        for at in range(0, len(wanted), BATCH):
            ks = np.array(wanted[at : at + BATCH])
            x = states[np.minimum(ks[:, None] + steps, len(states) - 1)]
            here = ks[:, None] + steps + parts // 2
            u = sent[np.minimum(here, len(sent) - 1)]
            off = (np.abs(policy.commands(x, policy.past) - u) / size).mean(axis=2)
            yield ks, off, here < len(sent)


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
