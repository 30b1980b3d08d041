"""What a program acted on: the samples of a log that it had when it sent a command.

A controller acts on the last sample that reached it, older by the way there than what the log has
by then: 20 ms of transport and sampling are 5 % of a lively command, more than most candidates
differ by. So each candidate is asked for its commands on the samples of a log at the age that suits
it best, each topic's its own, held as a program holds what it received last, or interpolated where
it filters. The one that ran sends what was logged, most of the time to the last digits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.trial import Trial
from grounded_trials.formats.messages import Ints
from grounded_trials.logs.samples import Samples, tidy
from grounded_trials.workspace.intake.who_drove import (
    FINE,
    LEAST,
    SAME,
    WINDOWS,
    Following,
    follows,
    steps_alike,
)

if TYPE_CHECKING:
    from grounded_trials.workspace.intake.run_start import Recording, Start

OLDEST = 2.0  # steps: what a program acts on is no older
AGES = 128  # at most are tried of a topic
PARTS = 8  # ages tried in the time between samples
ROUNDS = 2  # in which each topic's age is sought, the others' held
EXACT = 1e-3  # of an input's size: so near is half of what was sent to the candidate that ran
LUCK = float(np.log(2) / 2)  # [nats] a step: half the squares, which lower gains may leave as well
FEW, FEWEST = 4, 0.2  # steps of a part that tell, and the share of them that is exact in each
CLEARLY = 6.0  # [nats] beyond luck, by which another one is nearer
LATEST = 3  # steps by which commands may be logged late
ONE = 3e-3  # of an input's size: candidates that differ by less are one to whoever drives


@dataclass(frozen=True, eq=False)
class ActedOn:
    """How near a log's commands are to a policy's, on the samples that it may have acted on."""

    off: Array  # (T,) rms over inputs, in units of each one's largest; NaN: all at their limits
    asked: Array  # (T, m) what the policy sends
    size: Array  # (m,) the largest of each input

    @cached_property
    def told(self) -> Array:
        """The steps that say who drove, (T,) bool."""
        return np.isfinite(self.off)

    @property
    def exact(self) -> bool:
        """Whether half of the commands are the policy's to the last digits."""
        return bool(self.told.sum() >= LEAST and self.left < EXACT)

    @property
    def throughout(self) -> bool:
        """Whether they are so, and at no time somebody else's."""
        parts = (one[np.isfinite(one)] for one in np.array_split(self.off, WINDOWS))
        return self.exact and all(len(one) < FEW or np.mean(one < EXACT) > FEWEST for one in parts)

    @property
    def left(self) -> float:
        """What half of the commands are off by, at most: lost packets do not count."""
        return float(np.median(self.off[self.told])) if self.told.any() else np.inf

    @property
    def percent(self) -> str:
        """The same in words."""
        return f"{max(100 * self.left, 0.01):.2g} %"


def acted_on(log: Recording, policy: Policy, start: float) -> ActedOn | None:
    """The commands of a log against a policy's, at the ages of its samples that suit it best.

    Args:
        log: which the policy may have driven.
        policy: of its states and inputs.
        start: when the run begins, seconds after the log's first sample.

    Returns:
        None where the log can't be cut there, or is too short to tell.
    """
    trial = log.trial_from(start)
    if trial is None or (T := min(trial.finite_steps, policy.horizon)) < LEAST:
        return None
    sent = np.clip(trial.inputs[:T], policy.low, policy.high)
    past = policy.past if trial.start_inputs is None else trial.start_inputs
    size = np.maximum(np.abs(policy.feedforward).max(axis=0), np.abs(sent).max(axis=0)) + 1e-12
    samples = _Samples.of(log, round(start * 1e9), T)

    def asked(states: Array) -> Array:
        return policy.commands(states, past, sent[None])

    def scores(states: Array) -> Array:
        squares = (((asked(states) - sent) / size) ** 2).mean(axis=2)
        mean: Array = np.log(squares + FINE**2).mean(axis=1)  # a step that strays counts little
        return mean

    if policy.gain is None:
        found = np.zeros((1, T, len(policy.state_names)))
    else:
        tried = [samples.best(scores, held) for held in (True, False)]
        found = min(tried, key=lambda one: scores(one)[0])
    u = asked(found)[0]
    free = ((u > policy.low) & (u < policy.high)) | ((sent > policy.low) & (sent < policy.high))
    off = np.sqrt((((u - sent) / size) ** 2).mean(axis=1))
    return ActedOn(np.where(free.any(axis=1), off, np.nan), u, size)


@dataclass(frozen=True, eq=False)
class _Samples:
    """The samples of a log's states around the times at which commands were sent."""

    states: tuple[Samples, ...]
    wrapped: tuple[bool, ...]  # states that are angles
    guessed: tuple[bool, ...]  # those that a smoother found: no program was sent them
    topics: tuple[tuple[int, ...], ...]  # states that came together
    at: Ints  # (T,) [ns]
    ages: Array  # tried of each topic [s]

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

    def best(self, scores: Callable[[Array], Array], held: bool) -> Array:
        """The states at the ages that suit best, (1, T, n)."""
        first = np.stack([self._aged(i, self.ages, held) for i in range(len(self.states))], axis=2)
        found = first[[int(np.argmin(scores(first)))]]
        for _ in range(ROUNDS if len(self.topics) > 1 else 0):
            for topic in self.topics:
                tried = np.repeat(found, len(self.ages), axis=0)
                tried[:, :, topic] = first[:, :, topic]
                found = tried[[int(np.argmin(scores(tried)))]]
        return found

    def _aged(self, i: int, ages: Array, held: bool) -> Array:
        """A state at all ages when each command was sent, (A, T)."""
        one = self.states[i]
        at = self.at - np.round(ages[:, None] * 1e9).astype(np.int64)
        last = np.clip(np.searchsorted(one.t, at, "right") - 1, 0, len(one.t) - 1)
        if held and not self.guessed[i]:
            return one.y[last]
        t = one.t - one.t[0]
        between: Array = np.interp((at - one.t[0]).ravel(), t, one.y).reshape(at.shape)
        return between


def _sent_at(sent: Sequence[Samples], begin: int, dt: float, steps: int) -> Ints:
    """When each step's command was logged first [ns]; its time on the grid where it was held on."""
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


def nats(own: ActedOn, other: ActedOn) -> float:
    """The evidence that another candidate sent the commands, not the own one.

    The logarithm of the ratio of what each leaves, summed over the steps: heavy-tailed, as what
    lost packets do. A ratio that luck, or lower gains, give as well counts for nothing.
    """
    T = min(len(own.off), len(other.off))
    both = np.isfinite(own.off[:T] + other.off[:T])
    a, b = (np.log(np.hypot(one.off[:T][both], FINE)) for one in (own, other))
    gained = a - b - LUCK
    return float(gained.sum()) / steps_alike(gained) if both.sum() >= LEAST else 0.0


@dataclass(frozen=True, eq=False)
class Sender:
    """Who sent the commands of a log, as far as the samples that it acted on tell."""

    own: ActedOn | None  # None: the log is too short to tell
    other: str = ""  # the candidate whose commands they are; "": the own one's, or nobody's
    why: str = ""  # what says so

    @property
    def sure(self) -> bool:
        """Whether the own candidate sent them, most to the last digits, at no time another."""
        return self.own is not None and self.own.throughout


def sender_of(
    log: Recording,
    own: Candidate,
    candidates: Sequence[Candidate],
    start_of: Callable[[Candidate], Start | None],
) -> Sender:
    """Whether another candidate sent the commands of a log than it is said to have run.

    Args:
        log: in which the run begins.
        own: the candidate that it is said to have run.
        candidates: those that may have been run instead.
        start_of: where a candidate's run seems to begin in the log.
    """
    found = start_of(own)
    begins = log.first if found is None else found.seconds
    mine = acted_on(log, own.policy, begins)
    if mine is None or mine.exact:
        return Sender(mine)
    best, name, theirs = CLEARLY, "", mine
    ran = _following(log, own.policy, begins)
    late = ran is not None and ran.alike and ran.late != 0  # logged late, they are at other steps
    for one in reversed(candidates):
        at = begins
        if (found is None or not found.alike) and (begun := start_of(one)) and begun.opens_alike:
            at = begun.seconds
        fit = None if one.id == own.id else acted_on(log, one.policy, at)
        if fit is None or _one(mine, fit):
            continue
        if (for_it := nats(mine, fit)) <= best:
            continue
        if fit.exact or (not late and (there := _following(log, one.policy, at)) and there.alike):
            best, name, theirs = for_it, one.id, fit
        if name and theirs.left < FINE:
            break
    if not name:
        return Sender(mine)
    are = "are" if theirs.exact else "seem to be"
    why = (
        f"on the samples that it had, half of its commands are within {theirs.percent} of what "
        f"{name} sends, and within {mine.percent} of what {own.id} sends: they {are} those of "
        f"{name}. Was the robot given {own.id}?"
    )
    return Sender(mine, name, why)


def rival_in(
    log: Recording,
    own: Candidate,
    candidates: Sequence[Candidate],
    start_of: Callable[[Candidate], Start | None],
) -> Trial | None:
    """The log from where another candidate fits it much better than the own one anywhere."""
    found = start_of(own)
    best, bound = None, SAME * found.apart if found and found.alike else np.inf
    for one in candidates:
        start = start_of(one) if one.id != own.id else None
        if start is not None and start.alike and start.apart < bound:
            best, bound = log.trial_from(start.seconds), start.apart
    return best


def _one(mine: ActedOn, fit: ActedOn) -> bool:
    """Whether two candidates send the same, but for what nobody at the robot would see."""
    T = min(len(mine.asked), len(fit.asked))
    apart = (mine.asked[:T] - fit.asked[:T]) / mine.size
    return float(np.sqrt((apart**2).mean())) < ONE


def _following(log: Recording, policy: Policy, start: float) -> Following | None:
    """How the commands compare with a policy's: of nobody's, one candidate is the nearest too."""
    trial = log.trial_from(start)
    return follows(policy, trial.until(policy.horizon), LATEST) if trial else None
