"""The trials as one flat record, cut into runs of equal length that are filtered side by side.

The filter loops over time in Python, so all runs advance together along the batch axis. A long
trial is cut into runs of at most 200 steps. Because the whole state is measured, restarting the
filter at each cut loses almost no information. Anything with memory (commands, delays) is computed
on whole trials before they are cut.

Notation: S trials, B runs of L steps, n states, m inputs. Flat arrays hold all trials one after
the other: states (sum T + S, n), steps (sum T, ...).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from grounded.checks import refused, same_dt, same_names
from grounded.diagnosis.levels import ROUNDING
from grounded.diagnosis.likelihood.groups import Group, Signals, folds
from grounded.diagnosis.likelihood.memories import memories, recalled
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.effects import Scales, scales_of
from grounded.errors import NextCommand
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import dynamic, true_values
from grounded.trial import Trial

LONGEST_RUN, SHORTER_RUN = 200, 150  # most steps of a run; the second applies to a simulator
PIECES, SHORTEST_PIECE = 5, 50  # a single log is held out in pieces of at least this many steps
MOST_NUMBERS = 1.2e6  # size of one (L, B, N, N) array above which only informative runs are kept
SIMULATED = 800  # total steps kept for a simulator, since each is evaluated thousands of times
SEARCHED, RUNS_SEARCHED = 300, 3  # of these, steps and least runs on which causes are sought
SESSION, ROOMY = 16, 2.5  # runs of a session at the robot, all kept up to ROOMY times that size
UNKNOWN = 10  # samples of a run until a state is known that no sensor shows
SHOWN = 3  # samples at the start of a log that show which input was held before it
BEGINNINGS = 8  # most runs kept only because a trial begins with them


@dataclass(frozen=True, eq=False)
class Data:
    """All trials of a diagnosis; built by `prepare`."""

    model: Model
    dt: float
    states: Array  # (sum T + S, n) measured, angles unwrapped, NaN where missing
    commands: Array  # (S, T_max, m), the last command repeated to the end
    held: Array  # (S, m) the input held before t = 0
    latency: Array  # (m,) [s] input delays that the task already models
    lengths: Any  # (S,) of int, T of each trial
    state_at: Any  # (B, L + 1) of int, into states
    step_at: Any  # (B, L) of int, into flat steps
    valid: Array  # (B, L) 1.0 where the step was run
    trial_of: Any  # (B,) of int
    scales: Scales
    skipped: int  # runs left out because there are too many
    ids: tuple[str, ...]
    hidden: tuple[int, ...] = ()  # states without a sensor: only their start is known
    exact: tuple[int, ...] = ()  # those of them that the commands alone determine (`memories`)
    filters: Mapping[int, float] = field(default_factory=dict)  # sensor time constants [s] by state
    between: frozenset[str] = frozenset()  # sensors shifted in time by a fraction of a sample
    interpolated_s: float = 0.0  # as std of times: states were interpolated
    groups: tuple[Group, ...] = ()  # trials that differ in motion or condition

    @property
    def count(self) -> int:
        """S, the number of trials."""
        return len(self.lengths)

    @cached_property
    def group_of(self) -> Any:
        """The group of each trial, (S,) of int."""
        found = np.zeros(self.count, int)
        for k, group in enumerate(self.groups):
            found[list(group.trials)] = k
        return found

    @cached_property
    def folds(self) -> Any:
        """The fold of each run that is held out together, (B,): its group, or part of it."""
        group, steps = self.group_of[self.trial_of], self.valid.sum(axis=1)
        levels = np.array([bool(one.differs_in) for one in self.groups] or [False])
        return folds(group, self.trial_of, steps, levels[group])

    @property
    def steps(self) -> int:
        """Number of steps in all runs."""
        return int(self.valid.sum())

    @cached_property
    def behind(self) -> Mapping[int, int]:
        """Hidden true values, unknown even at the start: {its index: the state that logs it}."""
        names = self.model.state_names
        return true_values(names, [names[i] for i in self.hidden])

    @cached_property
    def begin(self) -> Any:
        """First step of each run that predictions start from, (B,).

        What no sensor shows (a speed, or the true value behind a late log) is not known at the
        first samples of a run. Predictions from there would miss by that and not by the model.
        """
        lengths = self.valid.sum(axis=1).astype(int)
        shown = [i for i in range(self.model.n) if i not in self.hidden]
        blind = bool(self.behind) or not all(self.seen[..., i].any() for i in shown)
        return np.clip(lengths // 4, 1, UNKNOWN) if blind else np.ones_like(lengths)

    @cached_property
    def now(self) -> Mapping[int, int]:
        """Delayed logs, {log: its current true value}, which is the first memory behind the log."""
        first: dict[int, int] = {}
        for i, log in sorted(self.behind.items()):
            first.setdefault(log, i)
        return first

    @cached_property
    def told(self) -> Any:
        """States with at least one finite sample, if only the initial one, (n,) of bool."""
        return np.isfinite(self.states).any(axis=0)

    @cached_property
    def filled(self) -> Array:
        """Measured states, flat; NaN replaced by the last value."""
        return _filled(self.states)

    @cached_property
    def y(self) -> Array:
        """The measured states by run, time-major (L + 1, B, n), gaps filled."""
        return np.ascontiguousarray(self.filled[self.state_at].swapaxes(0, 1))

    @cached_property
    def seen(self) -> Array:
        """1.0 where a state was measured and its step was run, (L + 1, B, n)."""
        there = np.isfinite(self.states[self.state_at])
        if self.hidden:
            begins = np.isin(self.state_at, np.cumsum([0, *(self.lengths + 1)]))
            there[..., list(self.hidden)] &= begins[..., None]
            there[..., [*self.behind, *self.exact]] = False
        run = np.concatenate([np.ones((len(self.valid), 1)), self.valid], axis=1)
        return np.ascontiguousarray((there * run[:, :, None]).swapaxes(0, 1))

    @cached_property
    def idle(self) -> Any:
        """Padding steps of shorter runs, (L, B) of bool."""
        return self.valid.T == 0

    @cached_property
    def time(self) -> Array:
        """Time from the start of the trial to the start of each step, (L, B) [s]."""
        flat = np.concatenate([np.arange(T) * self.dt for T in self.lengths])
        return np.ascontiguousarray(flat[self.step_at].T)

    @cached_property
    def used(self) -> Any:
        """Indices of the trials of which at least one run is kept."""
        return np.unique(self.trial_of)

    @cached_property
    def _of_runs(self) -> tuple[Any, Any]:
        """Trial (B,) and step within the trial (L, B) of each step of the runs, of int."""
        begins = np.cumsum([0, *self.lengths[:-1]])
        return self.trial_of, np.ascontiguousarray((self.step_at - begins[self.trial_of, None]).T)

    def runs(self, per_step: Array) -> Array:
        """Cut per-step values of whole trials (S, T_max, m) into runs (L, B, m)."""
        return np.asarray(per_step[self._of_runs])

    @cached_property
    def _in_use(self) -> Any:
        """Indices of the steps of the runs (L, B) in flat values of the `used` trials."""
        trial, step = self._of_runs
        return np.searchsorted(self.used, trial) * self.commands.shape[1] + step

    @cached_property
    def late_within(self) -> bool:
        """Whether the modelled latency lets an input change within a step."""
        steps = self.latency / self.dt
        return bool((np.abs(steps - np.round(steps)) > ROUNDING).any())

    def runs_in_use(self, per_step: Array) -> Array:
        """Cut per-step values of the `used` trials (S, T_max) into runs (L, B)."""
        return np.asarray(per_step.reshape(-1).take(self._in_use))


def prepare(
    model: Model,
    trials: Sequence[Trial],
    latency: Array | None = None,
    past: Array | None = None,
    hidden: Sequence[str] = (),
) -> Data:
    """Combine trials with the same time step into one record.

    Args:
        model: the crude model.
        trials: at least one with two finite steps. Samples after the first gap in the inputs or
            after the last finite state are dropped; gaps in single states stay (as missing).
        latency: transport delay of the inputs [s] that is already modelled (m,).
        past: the input held before t = 0 in trials that do not record it (m,); None: none, or the
            first command, whichever the first samples fit.
        hidden: names of states without a sensor (the memory of adopted effects; exact memories of
            the model's own are found). Their start is
            taken as known; their later values in the trials are only the initial track of the fit.
            True values behind a delayed log are not known at all. Their track starts from the log,
            because a model that carried them on from the start of a long trial drifts, and
            predicts nothing where it lacks a speed.

    Raises:
        GroundedError: if the trials have other states or inputs than the model, different time
            steps, or no two finite steps.
    """
    _check(model, trials)
    used = [(trial, trial.known_steps) for trial in trials]
    used = [(trial, T) for trial, T in used if T >= 2]
    if not used:
        then = NextCommand("verify")
        raise refused("given.short", what="diagnosis", needs=2, then=then)
    dt, m = used[0][0].dt, model.m
    lengths = np.array([T for _, T in used])
    commands = np.empty((len(used), int(lengths.max()), m))
    held = np.zeros((len(used), m))
    for i, (trial, T) in enumerate(used):
        commands[i, :T] = trial.inputs[:T]
        commands[i, T:] = trial.inputs[T - 1]
        before = past if trial.start_inputs is None else trial.start_inputs
        held[i] = _before(model, trial, T) if before is None else before
    states = np.concatenate([trial.states[: T + 1] for trial, T in used])
    never = np.flatnonzero(~np.isfinite(states).any(axis=0))
    if exact := memories(model, never, dt):
        path = recalled(model, exact, commands, model.values, dt)
        states[:, list(exact)] = np.concatenate(
            [own[: T + 1] for own, T in zip(path, lengths, strict=True)]
        )
    behind = true_values(model.state_names, hidden)
    states[:, list(behind)] = states[:, list(behind.values())]
    steps = np.concatenate([trial.inputs[:T] for trial, T in used])
    slow = simulated(model)
    state_at, step_at, valid, trial_of = _cut(lengths, SHORTER_RUN if slow else LONGEST_RUN)
    some = MOST_NUMBERS / (step_at.shape[1] * model.n**2 * 4)
    most = max(1, len(step_at) if len(step_at) <= min(SESSION, ROOMY * some) else int(some))
    begins = np.flatnonzero(np.diff(trial_of, prepend=-1))
    if slow:
        few = max(PIECES, min(len(begins), BEGINNINGS), SIMULATED // step_at.shape[1])
        most = min(most, few)
    twice = _repeats([trial.candidate for trial, _ in used])
    keep = _informative([_filled(states)[state_at], steps[step_at]], begins, most, twice)
    return Data(
        model=model,
        dt=dt,
        states=states,
        commands=commands,
        held=held,
        latency=np.zeros(m) if latency is None else np.asarray(latency, float),
        lengths=lengths,
        state_at=state_at[keep],
        step_at=step_at[keep],
        valid=valid[keep],
        trial_of=trial_of[keep],
        scales=scales_of(model, states, steps, dt, float(lengths.max() * dt)),
        skipped=len(step_at) - len(keep),
        ids=tuple(trial.id for trial, _ in used),
        hidden=(*(model.state_names.index(name) for name in hidden), *exact),
        exact=exact,
        groups=tuple(_signals(model, used, hidden).groups()),
    )


def entire(data: Data) -> Data:
    """Return the data with all runs, also those that `prepare` left out because there are many."""
    if not data.skipped or simulated(data.model):
        return data
    state_at, step_at, valid, trial_of = _cut(data.lengths, LONGEST_RUN)
    all_ = {"state_at": state_at, "step_at": step_at, "valid": valid, "trial_of": trial_of}
    return replace(data, **all_, skipped=0)


def fewer(data: Data) -> Data:
    """Return the data of the most informative runs, on which a simulator's causes are sought.

    All others are returned as they are: their steps are cheap.
    """
    if not simulated(data.model):
        return data
    most = max(RUNS_SEARCHED, SEARCHED // data.step_at.shape[1])
    signals = [data.filled[data.state_at], data.runs(data.commands).swapaxes(0, 1)]
    begins = np.flatnonzero(np.diff(data.trial_of, prepend=-1))
    keep = _informative(signals, begins, most, ())
    if len(keep) == len(data.valid):
        return data
    runs = (data.state_at, data.step_at, data.valid, data.trial_of)
    state_at, step_at, valid, trial_of = (of[keep] for of in runs)
    return replace(data, state_at=state_at, step_at=step_at, valid=valid, trial_of=trial_of)


def _signals(model: Model, used: Sequence[tuple[Trial, int]], hidden: Sequence[str]) -> Signals:
    """Return the inputs and the measured states that rates may depend on, for grouping."""
    names = [n for n in model.state_names if n in dynamic(model) and n not in hidden]
    states = [_filled(trial.states[:T]) for trial, T in used]
    known = np.any([np.isfinite(trial.states).any(axis=0) for trial, _ in used], axis=0)
    which = [i for i in map(model.state_names.index, names) if known[i]]
    each = [
        np.concatenate([x[:, which], trial.inputs[:T]], axis=1)
        for x, (trial, T) in zip(states, used, strict=True)
    ]
    shown = [model.state_names[i] for i in which]
    return Signals([*shown, *model.input_names], each, [trial.group for trial, _ in used])


def _before(model: Model, trial: Trial, steps: int) -> Array:
    """Return the input that was probably held before a log began that does not tell it, (m,).

    Either none, and the first command was a step, or the first command itself, as in a log that
    begins in the middle of a motion: whichever the first samples fit better.
    """
    first = slice(0, min(SHOWN, steps))
    x = _filled(trial.states[: first.stop + 1])
    held = np.stack([np.zeros(model.m), trial.inputs[0]])
    after = [
        model.system.step(x[:-1], np.tile(u, (first.stop, 1)), model.values, trial.dt) for u in held
    ]
    off = [
        model.difference(one, x[1:]) / (np.std(trial.states[:steps], axis=0) + 1e-12)
        for one in after
    ]
    size = [float(np.nansum(one**2)) for one in off]
    return np.asarray(held[int(size[1] <= size[0])])


def _check(model: Model, trials: Sequence[Trial]) -> None:
    if not trials:
        raise refused("search.no_trial")
    for trial in trials:
        for what, names, known in (
            ("states", trial.state_names, model.state_names),
            ("inputs", trial.input_names, model.input_names),
        ):
            same_names(f"trial '{trial.id or '?'}'", what, names, known)
        same_dt(f"trial '{trial.id or '?'}'", trial.dt, trials[0].dt)


def _cut(lengths: Any, longest: int) -> tuple[Any, Any, Array, Any]:
    """Return the index arrays of runs: each trial in equal parts of at most `longest` steps."""
    pieces = []
    step0 = state0 = 0
    for i, T in enumerate(lengths):
        parts = int(np.ceil(T / longest))
        if len(lengths) == 1 and T >= PIECES * SHORTEST_PIECE:
            parts = max(parts, PIECES)
        edges = np.linspace(0, T, parts + 1).astype(int)
        pieces += [(i, step0 + a, state0 + a, b - a) for a, b in itertools.pairwise(edges)]
        step0, state0 = step0 + T, state0 + T + 1
    L = max(length for *_, length in pieces)
    offsets = np.arange(L + 1)
    state_at = np.array([s + np.minimum(offsets, length) for _, _, s, length in pieces])
    step_at = np.array([s + np.minimum(offsets[:-1], length - 1) for _, s, _, length in pieces])
    valid = np.array([(offsets[:-1] < length).astype(float) for *_, length in pieces])
    return state_at, step_at, valid, np.array([i for i, *_ in pieces])


def _repeats(candidates: Sequence[str]) -> list[int]:
    """Return the latest two trials of one candidate, as indices; [] if none ran twice."""
    for k in range(len(candidates) - 1, 0, -1):
        if candidates[k] and candidates[k] in candidates[:k]:
            return [k - 1 - candidates[:k][::-1].index(candidates[k]), k]
    return []


def _informative(signals: Sequence[Array], begins: Any, most: int, twice: Sequence[int]) -> Any:
    """Select at most `most` runs, those in which the signals (B, any, k) vary most.

    A signal counts by its variance within the run, relative to its variance over all runs. One run
    is taken from each group of neighbouring runs, so that all trials and all of their duration are
    represented. Some of the runs kept are `begins`, those that a trial begins with, because whole
    trials are predicted from there. The beginnings of the trials `twice`, repeats of one run, are
    among them: they show the noise.
    """
    count = len(signals[0])
    if count <= most:
        return np.arange(count)
    many = min(len(begins), BEGINNINGS, max(1, most // 2))
    own = list(twice[: len(twice) * (many >= len(twice))])
    some = np.linspace(0, len(begins) - 1, max(many - len(own), 1)).astype(int)
    first = begins[list(dict.fromkeys([*own, *some.tolist()]))[:many]]
    parts = [x.var(axis=1) / np.maximum(x.var(axis=(0, 1)), 1e-300) for x in signals]
    moves = np.concatenate(parts, axis=1).mean(axis=1)
    others, left = np.setdiff1d(np.arange(count), first), most - len(first)
    groups = np.array_split(others, left) if left else []
    return np.sort([*first, *(group[np.argmax(moves[group])] for group in groups)])


def _filled(states: Array) -> Array:
    """Replace each NaN by the last finite value of its column (at the start by the next one)."""
    if np.isfinite(states).all():
        return states
    out = states.copy()
    for column in out.T:
        good = np.flatnonzero(np.isfinite(column))
        if len(good) == 0:
            column[:] = 0.0
            continue
        where = np.searchsorted(good, np.arange(len(column)), side="right") - 1
        column[:] = column[good[np.maximum(where, 0)]]
    return out
