"""Compare the commands of a trial with what a policy sends on its states.

The commands that the policy sends on the LOGGED states, including feedback and clipping, are
compared with the logged ones (`follows`). A log may be a little late, noisy or resampled; commands
of a person or of another candidate differ by more.

A policy's commands alone don't tell which column is wrong: feedback on an angle of the other sign
sends nearly what it sends on a speed of the other sign. But a run resembles its prediction, even
by a crude model, since feedback keeps it there: a column in another unit, of the other sign or in
another's place is far from it (`far`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from grounded.accounts.levels import EXACT, FINE, HALF, STEPS_TO_JUDGE
from grounded.frozen import Array, median, white_noise
from grounded.policy import Policy, z_difference
from grounded.task import Task
from grounded.trial import Trial

FEW, FEWEST = 4, 0.2  # informative steps in a part, and the share of them that must be exact
WINDOWS = 8  # parts of a trial that must each be alike (within 2x): somebody may take over
ROUGH = 4.0  # steps over which noise may be correlated; longer deviations count more
BACK = (0.0, 0.5, 1.0, 1.5, 2.0, -0.5, -1.0)  # ages of the states acted on that are tried, in steps
# difference from the prediction, of a state's usual size: at most in any state of a run as planned
# (a sign or a unit puts a column farther off)
CLOSE = 0.6
AGES = 1.0  # steps by which that age varies in a run (lost packets, clock drift and jitter)


class Fed(NamedTuple):
    """What a policy may have been fed at its steps: states of several ages."""

    states: Array  # (A, T, n)
    ages: Sequence[float]  # beyond those of the trial's [steps]


@dataclass(frozen=True)
class Following:
    """The comparison of a trial's commands with what a policy sends on its states."""

    alike: bool
    error: float  # rms over steps and inputs, in units of each input's largest value
    input: str  # the input that differs most
    rms: float  # its rms difference, in its unit
    until_s: float  # the commands are alike up to this time [s]
    opens: bool  # they are alike for at least `STEPS_TO_JUDGE` steps, not only at their limits
    late: int  # steps by which the log is late
    age: float  # of the states that it acted on, where its commands are logged [steps]
    moved: float  # squared difference, relative to that without shift and age
    off: Array  # (T, m) sent minus policy's commands; NaN if not compared
    fine: Array  # (m,) resolution of the commands
    digits: Array  # (T,) difference on the same last commands; NaN where all are at their limits

    @property
    def apart(self) -> Array:
        """The differences of the commands (T,), rms over the inputs in units of their size."""
        return np.asarray(np.sqrt(((self.off / self.fine) ** 2).mean(axis=1)) * FINE)

    @property
    def left(self) -> float:
        """The same over all steps that are compared."""
        return float(np.sqrt(np.nanmean(self.apart**2)))

    @property
    def usual(self) -> float:
        """The median difference inside the limits, which is robust to lost packets; inf if unknown.

        Few steps are enough if all are the policy's to the last digits.
        """
        told = self.digits[np.isfinite(self.digits)]
        few = len(told) >= FEW and told.max() < EXACT
        return float(np.median(told)) if few or len(told) >= STEPS_TO_JUDGE else np.inf

    @property
    def exact(self) -> bool:
        """Whether they are the policy's, at least half of them and some in every part."""
        parts = (one[np.isfinite(one)] for one in np.array_split(self.digits, WINDOWS))
        return self.usual < EXACT and all(
            len(one) < FEW or np.mean(one < EXACT) > FEWEST for one in parts
        )


def follows(
    policy: Policy, trial: Trial, latest: int = 1, fed: Fed | None = None
) -> Following | None:
    """Compare the commands of a trial with a policy's, at the alignment that fits best.

    Args:
        policy: the policy that should have been run.
        trial: a trial, judged up to the policy's horizon.
        latest: steps by which inputs may be logged late.
        fed: the states that it may have acted on; None: the trial's, of ages in `BACK`.

    Returns:
        The comparison; None if the trial is too short, or has other states or inputs.
    """
    T = min(trial.finite_steps, policy.horizon)
    names = (policy.state_names, policy.input_names)
    if T < STEPS_TO_JUDGE or (trial.state_names, trial.input_names) != names:
        return None
    # what the policy sends on states of several ages, and on those with their noise once more
    states, every = fed or ago(policy, trial.states[:T])
    run, width, ages = commanded(policy, trial, states), policy.high - policy.low, np.array(every)
    sent, noise = run.sent, np.random.default_rng(0).normal(size=(T, trial.states.shape[1]))
    noisy = trial.states[:T] + noise * white_noise(trial.states[:T])
    both = np.concatenate([states, trial.states[None, :T], noisy[None]])
    *asked, plain, with_noise = policy.commands(both, past_of(policy, trial))
    free, size = np.stack(asked), run.size
    # the age and the shift that fit best, robust to a takeover in some steps
    fits = {}
    for late in range(-1, min(latest, T - STEPS_TO_JUDGE) + 1):
        a, b = free[:, max(0, -late) : T - max(0, late)], sent[max(0, late) : T - max(0, -late)]
        squares = (((a - b) / size) ** 2).mean(axis=2)
        usual, mean = median(squares.T), squares.mean(axis=1)
        for k, score in enumerate(usual + 1e-3 * mean):
            fits[k, late] = (float(score), float(mean[k]), a[k], b)
    k, late = min(fits, key=lambda key: (fits[key][0], abs(ages[key[0]])))
    _, error, asked_then, sent = fits[k, late]
    apart = np.full(policy.feedforward[:T].shape, np.nan)
    apart[max(0, late) :][: len(sent)] = sent - asked_then
    unmoved = fits[int(np.argmin(np.abs(ages))), 0][1]
    # the difference from all ages near that one, beside that of unrelated commands
    near = np.abs(ages - ages[k]) <= AGES
    start = max(0, -late)
    within = free[near, start : start + len(sent)]
    off = (sent - np.clip(sent, within.min(axis=0), within.max(axis=0))) ** 2
    alone = (asked_then - sent).mean(axis=0) ** 2
    unrelated = asked_then.var(axis=0) + sent.var(axis=0) + alone
    noise = (with_noise - plain) ** 2  # at samples, where it is largest
    room = np.maximum(HALF**2 * unrelated, (0.02 * size) ** 2 + 4 * noise[: len(off)])
    drawn_out = np.array(
        [max(1.0, steps_alike(column) / ROUGH) for column in (sent - asked_then).T]
    )
    share = off.mean(axis=0) / room.mean(axis=0) * drawn_out
    # somebody may take over: every part must be alike
    parts = np.array_split(np.arange(len(off)), max(1, min(WINDOWS, len(off) // STEPS_TO_JUDGE)))
    bad = [k for k in parts if (off[k].mean(axis=0) > 2 * room[k].mean(axis=0)).any()]
    first = bad[0] if bad else parts[0][:1]
    left = int(first[np.argmax((off[first] > 2 * room[first]).any(axis=1))])
    # commands far beyond their limits are only alike by clipping
    beyond = np.abs(trial.inputs[:T] - run.sent)
    sane = bool((beyond.mean(axis=0) <= width).all())
    inside = np.flatnonzero(((sent > policy.low) & (sent < policy.high)).any(axis=1))
    j = int(np.argmax(share))
    return Following(
        alike=bool(sane and share.max() <= 1 and not bad),
        error=float(np.sqrt((off / size**2).mean())),
        input=policy.input_names[j],
        rms=float(np.sqrt(off[:, j].mean())),
        until_s=left * policy.dt * sane,
        opens=sane and int((inside < left).sum()) >= STEPS_TO_JUDGE,
        late=late,
        age=late + float(ages[k]),
        moved=error / unmoved if unmoved > 1e-4 else 1.0,
        off=apart,
        fine=FINE * size,
        digits=run.digits(policy)[k],
    )


def past_of(policy: Policy, trial: Trial) -> Array:
    """Return the inputs held before a trial: its own if they are known, else the policy's."""
    return policy.past if trial.start_inputs is None else trial.start_inputs


@dataclass(frozen=True, eq=False)
class Commanded:
    """The comparison of commands that every other one asks: as sent, and as a policy asks for."""

    sent: Array  # (T, m), or (K, T, m)
    asked: Array  # (K, T, m), fed in K ways
    size: Array  # of each command, (m,)

    @property
    def apart(self) -> Array:
        """The differences of the commands, (K, T), rms over the inputs in units of their size."""
        return np.asarray(np.sqrt((((self.asked - self.sent) / self.size) ** 2).mean(axis=-1)))

    def digits(self, policy: Policy) -> Array:
        """The same, NaN where all commands are at their limits."""
        free = (self.asked > policy.low) & (self.asked < policy.high)
        free |= (self.sent > policy.low) & (self.sent < policy.high)
        return np.where(free.any(axis=2), self.apart, np.nan)


def commanded(policy: Policy, trial: Trial, states: Array | None = None) -> Commanded:
    """Return a run's commands beside its policy's, on the states (K, T, n) or on the trial's.

    Of past inputs the policy is fed those that were sent: each command is compared on its own.
    """
    T = min(trial.finite_steps, policy.horizon)
    states = trial.states[None, :T] if states is None else states
    sent = np.clip(trial.inputs[:T], policy.low, policy.high)
    asked = policy.commands(states, past_of(policy, trial), sent[None])
    return Commanded(sent, asked, size_of(policy, sent))


def size_of(policy: Policy, sent: Array) -> Array:
    """Return the size of each command, (m,), by which differences are judged."""
    width = policy.high - policy.low
    most = np.maximum(np.abs(policy.feedforward).max(axis=0), np.abs(sent).max(axis=0, initial=0.0))
    return np.asarray(most + np.where(np.isfinite(width), 0.1 * width, 1e-12))


def as_sent(policy: Policy, trial: Trial) -> bool:
    """Return whether a run's commands are its policy's on the logged states, to the last digits.

    Then no other story of them is asked for. A run with gaps, or of other signals, is not.
    """
    names = (policy.state_names, policy.input_names)
    if (trial.state_names, trial.input_names) != names or trial.finite_steps < STEPS_TO_JUDGE:
        return False
    run = commanded(policy, trial)
    return bool((np.abs(run.asked - run.sent) < FINE * run.size).all())


def evidence(own: Array, other: Array) -> float:
    """Return the evidence [nats] that another policy sent the commands, not the own one.

    It is the logarithm of the ratio of likelihoods for noise with heavy tails (lost packets), of
    the size that the other leaves, by the number of steps that count as one. If the robot acted on
    other samples than the log has, lower gains leave smaller differences, whichever ran: a
    reduction of the squares by half does not count. Steps in which both send exactly what was
    sent, as at the same limit, don't tell them apart. Both are differences of the commands (T,)
    relative to their size, NaN where they are not compared.
    """
    T = min(len(own), len(other))
    known = np.isfinite(own[:T] + other[:T]) & (np.maximum(own[:T], other[:T]) > 0)
    if known.sum() < STEPS_TO_JUDGE:
        return 0.0
    a, b = own[:T][known] / np.sqrt(2), other[:T][known]
    usual = float(np.hypot(median(b), FINE))
    gained = 2 * np.log(np.hypot(a, usual) / np.hypot(b, usual))
    return float(gained.sum()) / steps_alike(b)


def steps_alike(noise: Array) -> float:
    """Return the number of successive samples worth one: the autocorrelation summed to its zero."""
    noise = noise - noise.mean()
    power = np.correlate(noise, noise, "full")[len(noise) - 1 :]
    if not power[0] > 0:
        return 1.0
    end = int(np.argmax(power <= 0)) or len(power)
    return float(2 * power[:end].sum() / power[0] - 1)


def latest(task: Task) -> int:
    """Return by how many steps a log of the actuators' inputs lags the commands, at most."""
    assert task.latency is not None
    return 1 + int(np.ceil(task.latency.max() / task.dt))


def ago(policy: Policy, states: Array) -> Fed:
    """Return what a policy may have been fed of the states of a trial (T, n), by ages in `BACK`."""
    at, last, found = np.arange(len(states)), len(states) - 1, list[Array]()
    for steps in BACK:  # linearly interpolated between samples
        whole, part = divmod(steps, 1)
        now, before = (states[np.clip(at - int(whole) - k, 0, last)] for k in (0, 1))
        found.append(now - part * z_difference(now, before, policy.angles))
    return Fed(np.stack(found), BACK)


# --- beside its prediction ------------------------------------------------------------------------


class Ran(Protocol):
    """A candidate: its name, its policy, and the states (H + 1, n) predicted for it."""

    @property
    def id(self) -> str:
        """Its name."""

    @property
    def policy(self) -> Policy:
        """What it sends."""

    @property
    def predicted_states(self) -> Array:
        """The states (H + 1, n) of its run in the model."""


def far(own: Ran, trial: Trial, first: int = 0) -> Array:
    """Return each state's rms difference from its prediction, relative to its size, (n,).

    The size is the geometric mean of the standard deviations, so that a column that is too small is
    as far as one that is too large. NaN for a state that is predicted not to move, or of which
    nothing is finite.
    """
    predicted = own.predicted_states[first:]
    T = min(trial.finite_steps, len(predicted) - 1)
    if T < 0:
        return np.full(trial.states.shape[1], np.nan)
    seen, said = trial.states[: T + 1], predicted[: T + 1]
    off = np.sqrt(((seen - said) ** 2).mean(axis=0))
    moves, shown = said.std(axis=0), seen.std(axis=0)
    with np.errstate(all="ignore"):
        found: Array = off / np.sqrt(np.where(moves > 0, moves, np.nan) * (shown + 1e-6 * moves))
    return found


def apart(own: Ran, trial: Trial, first: int = 0) -> float:
    """Return how far a trial, from step `first` on, is from its prediction [nats] in all states."""
    return float(np.nansum(np.log(np.fmax(far(own, trial, first), FINE))))


def as_planned(own: Ran, trial: Trial) -> bool:
    """Return whether a run's commands are its candidate's to the last digits, and its motion near.

    Then it came about as it is logged, and no other account is asked for: a column in another unit,
    of the other sign, dead or in another's place is far from its prediction.
    """
    known = far(own, trial)
    return as_sent(own.policy, trial) and bool((known[np.isfinite(known)] < CLOSE).all())
