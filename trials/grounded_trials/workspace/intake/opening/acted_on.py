"""Find the samples of a log that the robot's program acted on when it sent a command.

A controller acts on the last sample that reached it, which is older than the latest one in the log:
20 ms of transport and sampling change a command by 5 %, more than most candidates differ by. So the
commands of each candidate are computed from the samples of the age that fits best, separately for
each topic, either held (zero-order hold) or interpolated, as for a program that filters. The
candidate that ran reproduces the logged commands, mostly to the last digits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from grounded.accounts.sent import (
    EXACT,
    FINE,
    STEPS_TO_JUDGE,
    WINDOWS,
)
from grounded.frozen import Array
from grounded.policy import Policy
from grounded_trials.formats.messages import Ints
from grounded_trials.logs.samples import Samples, tidy

if TYPE_CHECKING:
    from grounded_trials.workspace.intake.opening.run_start import Recording

OLDEST = 2.0  # largest age of a sample, in steps
AGES = 128  # largest number of ages tried per topic
PARTS = 8  # number of ages tried in the time between samples
ROUNDS = 2  # rounds of coordinate search over the topics' ages
FEW, FEWEST = 4, 0.2  # smallest number of informative steps in a part, and their share to be exact


@dataclass(frozen=True, eq=False)
class ActedOn:
    """The differences of a log's commands from a policy's, on the samples it may have acted on."""

    off: Array  # (T,) rms over inputs, in units of their size; NaN if all are at their limits
    asked: Array  # (T, m) what the policy sends
    size: Array  # (m,) the largest value of each input
    old: Array  # (n,) mean age of the samples of each state when commands were sent [s]

    @cached_property
    def told(self) -> Array:
        """The informative steps, (T,) bool: those with an input inside its limits."""
        return np.isfinite(self.off)

    @property
    def enough(self) -> bool:
        """Whether enough steps are informative; few are if all are the policy's to the last digits.

        An input at its limits most of the time leaves few.
        """
        few = self.told.sum() >= FEW and float(self.off[self.told].max()) < EXACT
        return bool(few or self.told.sum() >= STEPS_TO_JUDGE)

    @property
    def exact(self) -> bool:
        """Whether at least half of the commands are the policy's to the last digits."""
        return self.enough and self.left < EXACT

    @property
    def throughout(self) -> bool:
        """Whether the commands are exact, also in every part of the run."""
        parts = (one[np.isfinite(one)] for one in np.array_split(self.off, WINDOWS))
        return self.exact and all(len(one) < FEW or np.mean(one < EXACT) > FEWEST for one in parts)

    @property
    def left(self) -> float:
        """The median difference of the commands, which is robust to lost packets."""
        return float(np.median(self.off[self.told])) if self.told.any() else np.inf


def acted_on(log: Recording, policy: Policy, start: float) -> ActedOn | None:
    """Compare the commands of a log with a policy's, at the ages of samples that fit best.

    Args:
        log: the log.
        policy: a policy for its states and inputs.
        start: when the run begins, seconds after the log's first sample.

    Returns:
        The differences; None if the log can't be cut there, or is too short.
    """
    trial = log.trial_from(start)
    if trial is None or (T := min(trial.finite_steps, policy.horizon)) < STEPS_TO_JUDGE:
        return None
    sent = np.clip(trial.inputs[:T], policy.low, policy.high)
    past = policy.past if trial.start_inputs is None else trial.start_inputs
    size = np.maximum(np.abs(policy.feedforward).max(axis=0), np.abs(sent).max(axis=0)) + 1e-12
    samples = _Samples.of(log, round(start * 1e9), T)

    def asked(states: Array) -> Array:
        return policy.commands(states, past, sent[None])

    def scores(states: Array) -> Array:
        squares = (((asked(states) - sent) / size) ** 2).mean(axis=2)
        mean: Array = np.log(squares + FINE**2).mean(axis=1)  # outliers count little
        return mean

    if policy.gain is None:
        found, old = np.zeros((1, T, len(policy.state_names))), np.full(len(policy.state_names), 0)
    else:
        tried = [samples.best(scores, held) for held in (True, False)]
        found, old = min(tried, key=lambda one: scores(one[0])[0])
    u = asked(found)[0]
    free = ((u > policy.low) & (u < policy.high)) | ((sent > policy.low) & (sent < policy.high))
    off = np.sqrt((((u - sent) / size) ** 2).mean(axis=1))
    return ActedOn(np.where(free.any(axis=1), off, np.nan), u, size, old)


@dataclass(frozen=True, eq=False)
class _Samples:
    """The samples of a log's states around the times at which commands were sent."""

    states: tuple[Samples, ...]
    wrapped: tuple[bool, ...]  # whether a state is an angle
    guessed: tuple[bool, ...]  # whether a state was estimated by the smoother, not logged
    topics: tuple[tuple[int, ...], ...]  # states with the same time stamps
    at: Ints  # (T,) when commands were sent [ns]
    ages: Array  # the ages to try for each topic [s]

    @classmethod
    def of(cls, log: Recording, start: int, steps: int) -> _Samples:
        names, inputs = log.names
        states = tuple(tidy(n, log.series[n], unwrap=n in log.angles) for n in names)
        together = dict[bytes, list[int]]()
        for i, one in enumerate(states):
            together.setdefault(one.t.tobytes(), []).append(i)
        sent = [tidy(n, log.series[n], unwrap=False) for n in inputs]
        begin = log.whole.origin_ns + start
        finest = max(min(one.interval for one in states) / PARTS, OLDEST * log.dt / AGES)
        return cls(
            states,
            tuple(n in log.angles for n in names),
            tuple(n not in log.logged for n in names),
            tuple(tuple(some) for some in together.values()),
            _sent_at(sent, begin, log.dt, steps),
            np.arange(-2 * finest, OLDEST * log.dt, finest),
        )

    def best(self, scores: Callable[[Array], Array], held: bool) -> tuple[Array, Array]:
        """Return the states at the ages that fit best, (1, T, n), and their mean ages [s], (n,)."""
        first = np.stack([self._aged(i, self.ages, held) for i in range(len(self.states))], axis=2)
        k = int(np.argmin(scores(first)))
        found, chosen = first[[k]], np.full(len(self.states), k)
        for _ in range(ROUNDS if len(self.topics) > 1 else 0):
            for topic in self.topics:
                tried = np.repeat(found, len(self.ages), axis=0)
                tried[:, :, topic] = first[:, :, topic]
                k = int(np.argmin(scores(tried)))
                found, chosen[list(topic)] = tried[[k]], k
        ages = [self._age(i, float(self.ages[k]), held) for i, k in enumerate(chosen)]
        return found, np.array(ages)

    def _age(self, i: int, age: float, held: bool) -> float:
        """Return the mean age of what is held, or interpolated, of a state an `age` ago."""
        one, at = self.states[i], self.at - round(age * 1e9)
        if not held or self.guessed[i]:
            return age
        last = np.clip(np.searchsorted(one.t, at, "right") - 1, 0, len(one.t) - 1)
        return float(np.mean(self.at - one.t[last])) * 1e-9

    def _aged(self, i: int, ages: Array, held: bool) -> Array:
        """Return a state at all ages when each command was sent, (A, T)."""
        one = self.states[i]
        at = self.at - np.round(ages[:, None] * 1e9).astype(np.int64)
        last = np.clip(np.searchsorted(one.t, at, "right") - 1, 0, len(one.t) - 1)
        if held and not self.guessed[i]:
            return one.y[last]
        t = one.t - one.t[0]
        between: Array = np.interp((at - one.t[0]).ravel(), t, one.y).reshape(at.shape)
        return between


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
