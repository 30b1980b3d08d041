"""Find where in a recording the run of a candidate begins; recordings start before the run.

Without a [log.span] the run is assumed to begin with the first command in the log. That is wrong if
the robot sends zeros while it waits. So at every instant of the log, as finely as it was sampled,
the logged commands are compared with what the policy would send (including feedback) on the states
logged from there on. The result is refined to the instants at which commands change. If the log
ends before the run would have, it is compared as far as it goes, provided that the commands were
constant before.

A controller acts on the last sample that reached it, which is older than the latest one in the log:
20 ms of transport and sampling change a command by 5 %, more than most candidates differ by. So the
commands of each candidate are computed from the samples of the age that fits best, separately for
each topic, either held (zero-order hold) or interpolated, as for a program that filters. The
candidate that ran reproduces the logged commands, mostly to the last digits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from grounded.accounts.levels import FINE, HALF, STEPS_TO_JUDGE
from grounded.accounts.sent import Commanded, Fed, Following, commanded, follows, size_of
from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.task import Task
from grounded.trial import LAST, Trial, interpolate_gaps
from grounded_trials.formats.messages import Ints
from grounded_trials.logs.command_steps import changes_of, phase_of
from grounded_trials.logs.resample import Gridded, Span, to_grid
from grounded_trials.logs.samples import Samples, tidy
from grounded_trials.logs.signals import Series

OLDEST = 2.0  # largest age of a sample, in steps
AGES = 128  # largest number of ages tried per topic
AGES_BETWEEN = 8  # number of ages tried in the time between samples
ROUNDS = 2  # rounds of coordinate search over the topics' ages
MOVES = (0.0, -0.5, 0.5, -1.0, 1.0)  # [steps] about the likeliest ages that may occur as well
TRIED = 5  # number of best-fitting instants that are examined
HELD = 3.5  # steps without a change of commands before an instant that may begin a run
FINEST = 8  # largest number of instants per step at which a start is tried
QUIET_S = 1.0  # time without a change of commands before a run that is cut short in the log
LOGGED_PART = 4  # at least 1 / LOGGED_PART of a run must be in the log
BATCH = 256  # instants compared at once


@dataclass(frozen=True)
class Start:
    """Where a policy's run seems to begin."""

    seconds: float  # after the log's first sample
    apart: float  # mean difference of the commands there, in units of each input's size
    ran: Following  # the comparison of the commands from there on
    opens: bool = False  # the first commands are the policy's, whatever was sent later

    @property
    def alike(self) -> bool:
        """Whether the commands are the policy's from there on."""
        return self.ran.exact or (self.ran.alike and not self.ran.late)

    @property
    def opens_alike(self) -> bool:
        """Whether at least the first commands are; somebody may have taken over later."""
        return self.alike or self.opens or self.ran.opens


@dataclass(frozen=True, eq=False)
class Recording:
    """A foreign log in which a run may begin anywhere, on a grid of `parts` instants per step."""

    series: Mapping[str, Series]  # of every state and input
    logged: Mapping[str, Series]  # those that were logged, not estimated
    names: tuple[tuple[str, ...], tuple[str, ...]]
    angles: tuple[str, ...]
    dt: float
    steps: int
    past: Array  # (m,) inputs held before a run
    parts: int
    whole: Gridded
    changes: Array  # when a command changed in the log, seconds after the log's first sample
    late: Array  # by how much each change may appear late [s]; 0 if commands have own stamps
    interval: float  # between samples [s]
    _cut: dict[float, Trial | None] = field(init=False, default_factory=dict)  # by start

    @property
    def first(self) -> float:
        """The time of the first command, the default start of a run [s]."""
        return (self.whole.start_ns - self.whole.origin_ns) * 1e-9

    @property
    def measured(self) -> tuple[str, ...]:
        """The states that a column holds; the others are estimated."""
        return tuple(name for name in self.names[0] if name in self.logged)

    @property
    def waits(self) -> bool:
        """Whether the log begins before any run: with the input held then, for some steps."""
        changed = self.changes[self.changes > self.first].min(initial=np.inf)
        held = bool((self.whole.inputs[0] == self.past).all())
        return held and changed - self.first > HELD * self.dt

    def trial_from(self, start: float) -> Trial | None:
        """Return the log as a trial from `start` [s] on, or None if a state is not known there."""
        if start not in self._cut:
            self._cut[start], span = None, Span(start=start)
            with suppress(GroundedError):
                cut = to_grid(
                    self.series,
                    self.dt,
                    *self.names,
                    span,
                    angles=self.angles,
                    steps=self.steps,
                    past=self.past,
                )
                past = cut.start_inputs
                run = Trial(cut.states, cut.inputs, self.dt, *self.names, start_inputs=past)
                self._cut[start] = interpolate_gaps(run).trial if cut.late_s == 0 else None
        return self._cut[start]

    @property
    def openings(self) -> list[float]:
        """Instants at which commands change after being constant for some steps [s]."""
        held = np.diff(self.changes, prepend=-np.inf)
        return [float(at) for at in self.changes[held > HELD * self.dt]]

    def start_of(self, policy: Policy) -> Start | None:
        """Find where a policy's run begins; return None if the log is too short."""
        if (policy.state_names, policy.input_names) != self.names or policy.dt != self.dt:
            return None
        starts = [*self._starts(policy, instants_apart(self.whole, self.parts, policy))]
        # The mean difference is affected by other commands sent in place of the first steps, and by
        # commands at their limits, which contain no timing. The median on the samples that the
        # program acted on is not.
        if exact := [one for one in starts if one.ran.exact]:
            return min(exact, key=lambda one: one.ran.usual)
        alike = [one for one in starts if one.alike]
        likeliest = min(alike or starts, key=lambda one: one.apart, default=None)
        if likeliest is None or not alike:
            return likeliest
        near = [one for one in starts if HALF * one.apart <= likeliest.apart]
        best = min(near, key=lambda one: one.ran.usual)
        return (
            replace(best, opens=True) if best.ran.usual < HALF * likeliest.ran.usual else likeliest
        )

    def _starts(self, policy: Policy, apart: Array) -> Iterator[Start]:
        """Yield the likeliest starts, by the difference of the commands from each instant on."""
        left, tried = apart.copy(), list[float]()
        while len(tried) < TRIED and np.isfinite(left).any():
            k = int(np.argmin(left))
            left[max(0, k - self.parts + 1) : k + self.parts] = np.inf
            seconds = self.on_step(policy, self.first + k * self.dt / self.parts)
            trial = None if seconds in tried else self.trial_from(seconds)
            run = None if trial is None else trial.until(policy.horizon)
            fit = None if run is None else follows(policy, run, 0, self.fed(policy, seconds, run))
            if fit is not None:
                tried.append(seconds)
                yield Start(seconds, float(apart[k]), fit)

    def apart_at(self, policy: Policy, start: float) -> float:
        """Return the mean difference of the commands from an instant on, as `Start.apart`."""
        k = round((start - self.first) * self.parts / self.dt)
        if not 0 <= k < len(self.whole.inputs):
            return np.inf
        return float(instants_apart(self.whole, self.parts, policy, range(k, k + 1))[k])

    def on_step(self, policy: Policy, start: float) -> float:
        """Move a start by less than a step to where commands change."""
        dt, length = self.dt, self.dt * policy.horizon
        inside = (self.changes > start - dt / 2) & (self.changes < start + length)
        late = self.late[inside]
        if (found := phase_of(self.changes[inside] - start, dt, late)) is None:
            return start
        phase, _ = found
        if abs(phase) < dt / 4:
            return start + phase
        tried = [start + phase + move * dt for move in (0, -1, 1)]
        return min(tried, key=lambda at: self.apart_at(policy, at))

    def fed(self, policy: Policy, start: float, run: Trial) -> Fed | None:
        """Return the states that a policy may have been fed in a run, near the likeliest ages.

        Samples are held or interpolated; topics with stamps of their own have ages of their own.
        """
        T = min(run.finite_steps, policy.horizon)
        if policy.gain is None or T < STEPS_TO_JUDGE:
            return None
        topics, finest, aged = _aged(self, round(start * 1e9), T)
        run = run.until(T)

        def scores(states: Array) -> Array:
            apart = commanded(policy, run, states).apart
            mean: Array = np.log(apart**2 + FINE**2).mean(axis=1)  # outliers count little
            return mean

        found = list[tuple[float, Array, Array]]()
        for states in aged:
            each = scores(states)
            ages = np.full(len(run.state_names), int(np.argmin(each)))
            for topic in topics * ROUNDS if len(topics) > 1 else ():
                tried = np.repeat(_of(states, ages)[None], len(states), axis=0)
                tried[:, :, topic] = states[:, :, topic]
                each = scores(tried)
                ages[topic] = int(np.argmin(each))
            found.append((float(each.min()), states, ages))
        _, states, ages = min(found, key=lambda one: one[0])
        moves = np.round(np.array(MOVES) * self.dt / finest).astype(int)
        near = np.clip(ages + moves[:, None], 0, len(states) - 1)
        old = (ages.mean() - 2) * finest / self.dt
        return Fed(np.stack([_of(states, k) for k in near]), [float(old + d) for d in MOVES])


def _of(states: Array, ages: Ints) -> Array:
    """Return the states (T, n), each at its age, of those of all ages (A, T, n)."""
    return np.stack([states[k, :, i] for i, k in enumerate(ages)], axis=1)


def recording(
    logged: Mapping[str, Series],
    task: Task,
    series: Mapping[str, Series],
) -> Recording | None:
    """Return a log in which a run may begin anywhere, or None if it can't be sampled."""
    model, dt = task.model, task.dt
    names = (model.state_names, model.input_names)
    every = [float(np.median(np.diff(np.sort(s.t)))) for s in series.values() if len(s.t) > 1]
    interval = max(every, default=dt * 1e9) * 1e-9
    parts = 2 * int(np.clip(np.ceil(dt / max(interval, 1e-9) / 2 - 0.01), 1, FINEST / 2))
    bridged = {n: _bridged(one) if n in names[0] else one for n, one in series.items()}
    for tried in (series, bridged):
        with suppress(GroundedError):
            whole, series = to_grid(tried, dt / parts, *names, angles=model.angles), tried
            break
    else:
        return None
    sent = [series[name] for name in model.input_names]
    seen = [changes_of(s.t, s.values) for s in sent]
    at, late = (np.concatenate(x) for x in zip(*seen, strict=True))
    changes, late = (at - whole.origin_ns) * 1e-9, late * 1e-9
    return Recording(
        series,
        logged,
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
    """Allow gaps of any length in samples; the trial cut from the log has the gaps again."""
    longest = float(np.ptp(series.t)) * 1e-9 if len(series.t) else 0.0
    return replace(series, spec=replace(series.spec, max_age_s=longest))


def instants_apart(
    log: Gridded, parts: int, policy: Policy, instants: Sequence[int] | None = None
) -> Array:
    """Return the mean difference of the commands from every instant on, (N,).

    It is infinite where no run can begin: the log has to hold the complete run, or commands that
    are constant before it, for runs that were cut or stopped.
    """
    sent, H = np.clip(log.inputs, policy.low, policy.high), policy.horizon
    changed = np.any(np.diff(sent, axis=0, prepend=sent[:1]) != 0, axis=1)
    count, quiet = np.cumsum(changed), round(QUIET_S / policy.dt * parts)
    apart = np.full(len(sent), np.inf)
    least = least_of(H)
    asked = range(len(sent)) if instants is None else instants
    lasting = [(len(sent) - k - parts // 2 - 1) // parts + 1 for k in asked]
    enough = min(least, H - LAST)
    wanted = [k for k, some in zip(asked, lasting, strict=True) if some >= enough]
    for ks, off, known in _off(log, parts, policy, wanted):
        left = known.sum(axis=1)
        before = np.maximum(ks - 1, 0)
        begun = count[before] == count[np.maximum(ks - 1 - quiet, 0)]
        whole = (left >= H - LAST) | (begun & (left >= least))
        apart[ks[whole]] = ((off * known).sum(axis=1) / left)[whole]
    return apart


def least_of(horizon: int) -> int:
    """Return the number of steps at the beginning that identify a run."""
    return max(STEPS_TO_JUDGE, horizon // LOGGED_PART)


def _off(
    log: Gridded, parts: int, policy: Policy, wanted: Sequence[int]
) -> Iterator[tuple[Any, Any, Any]]:
    """Yield instants (K,), differences of the commands from there (K, H), and which are known."""
    states, H = log.states, policy.horizon
    sent = np.clip(log.inputs, policy.low, policy.high)
    size = size_of(policy, sent)
    steps = parts * np.arange(H)
    for at in range(0, len(wanted), BATCH):
        ks = np.array(wanted[at : at + BATCH])
        x = states[np.minimum(ks[:, None] + steps, len(states) - 1)]
        here = ks[:, None] + steps + parts // 2
        u = sent[np.minimum(here, len(sent) - 1)]
        yield ks, Commanded(u, policy.commands(x, policy.past), size).apart, here < len(sent)


# --- the samples that the program acted on -------------------------------------------------------


def _aged(log: Recording, start: int, steps: int) -> tuple[list[list[int]], float, list[Array]]:
    """Return the states of a log at all ages that they may have had when commands were sent.

    Returns:
        The groups of states with the same time stamps, which are equally old; the time from age to
        age [s]; and the states, (ages, T, n): held from sample to sample (but for those that were
        estimated), and between.
    """
    names, inputs = log.names
    states = [tidy(n, log.series[n], unwrap=n in log.angles) for n in names]
    together = dict[bytes, list[int]]()
    for i, one in enumerate(states):
        together.setdefault(one.t.tobytes(), []).append(i)
    sent = [tidy(n, log.series[n], unwrap=False) for n in inputs]
    finest = max(min(one.interval for one in states) / AGES_BETWEEN, OLDEST * log.dt / AGES)
    ages = np.arange(-2 * finest, OLDEST * log.dt, finest)
    at = _sent_at(sent, log.whole.origin_ns + start, log.dt, steps)
    at = at - np.round(ages[:, None] * 1e9).astype(np.int64)
    held, between = list[Array](), list[Array]()
    for name, one in zip(names, states, strict=True):
        t, y = one.t - one.t[0], one.y
        last = np.clip(np.searchsorted(one.t, at, "right") - 1, 0, len(t) - 1)
        between.append(np.interp((at - one.t[0]).ravel(), t, y).reshape(at.shape))
        held.append(y[last] if name in log.logged else between[-1])
    return [*together.values()], finest, [np.stack(some, axis=2) for some in (held, between)]


def _sent_at(sent: Sequence[Samples], begin: int, dt: float, steps: int) -> Ints:
    """Return when each step's command was logged first [ns]; its grid time if it did not change."""
    step = round(dt * 1e9)
    grid = begin + np.round(dt * 1e9 * np.arange(steps)).astype(np.int64)
    found = np.full(steps, np.iinfo(np.int64).min)
    for one in sent:
        changed = np.r_[True, np.diff(one.y) != 0]
        since = np.maximum.accumulate(np.where(changed, np.arange(len(one.y)), 0))
        last = np.clip(np.searchsorted(one.t, grid + step // 2, "right") - 1, 0, None)
        at = one.t[since[last]]
        found = np.where(np.abs(at - grid) < step // 2, np.maximum(found, at), found)
    return np.where(found > grid - step, found, grid)
