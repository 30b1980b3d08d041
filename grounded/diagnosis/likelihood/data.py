"""Trials as the diagnosis sees them: one flat record, cut into runs of equal length.

A filter steps through time in Python, so all trials step together, and a long trial is cut into
runs of at most 200 steps: since the whole state is measured, a run that starts anew loses next to
nothing. What has a memory (commands, delays) is computed on whole trials first.

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

from grounded.diagnosis.likelihood.simulated import simulated
from grounded.effects import Scales, scales_of
from grounded.effects.memory import true_values
from grounded.errors import GroundedError, NextCommand
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial

LONGEST_RUN, SHORTER_RUN = 200, 150  # steps; the shorter of a simulator
PIECES, SHORTEST_PIECE = 5, 50  # one log alone is held out by pieces; steps of a piece at least
MOST_NUMBERS = 1.2e6  # of one (L, B, N, N) array: above it, the most informative runs are used
SIMULATED = 800  # steps of a simulator, each of which is asked thousands of times
BEGINNINGS = 8  # runs among them at most that are kept because a trial begins with them


@dataclass(frozen=True, eq=False)
class Data:
    """All trials of a diagnosis; built by `prepare`."""

    model: Model
    dt: float
    states: Array  # (sum T + S, n) measured, angles unwrapped, NaN where missing
    commands: Array  # (S, T_max, m), the last command repeated to the end
    held: Array  # (S, m) the input held before t = 0
    latency: Array  # (m,) [s] that the task already models
    lengths: Any  # (S,) of int, T of each trial
    state_at: Any  # (B, L + 1) of int, into states
    step_at: Any  # (B, L) of int, into flat steps
    valid: Array  # (B, L) 1.0 where the step was run
    trial_of: Any  # (B,) of int
    scales: Scales
    skipped: int  # runs left out because there are too many
    ids: tuple[str, ...]
    hidden: tuple[int, ...] = ()  # states that no sensor has: only their start is known
    filters: Mapping[int, float] = field(default_factory=dict)  # sensors' time constants [s]
    between: frozenset[str] = frozenset()  # sensors that were moved in time, between samples

    @property
    def count(self) -> int:
        """S, the number of trials."""
        return len(self.lengths)

    @property
    def steps(self) -> int:
        """Steps that the runs hold."""
        return int(self.valid.sum())

    @cached_property
    def behind(self) -> Mapping[int, int]:
        """Hidden true values, not even known at the start, each with the state that logs them."""
        names = self.model.state_names
        return true_values(names, [names[i] for i in self.hidden])

    @cached_property
    def now(self) -> Mapping[int, int]:
        """Late logs, each with its true value of the moment: the first memory behind it."""
        first: dict[int, int] = {}
        for i, log in sorted(self.behind.items()):
            first.setdefault(log, i)
        return first

    @cached_property
    def told(self) -> Any:
        """Of which states trials say anything, if only where their fit begins, (n,) of bool."""
        return np.isfinite(self.states).any(axis=0)

    @cached_property
    def filled(self) -> Array:
        """Measured states, flat; NaN replaced by the last value."""
        return _filled(self.states)

    @cached_property
    def y(self) -> Array:
        """The same by run, time-major (L + 1, B, n)."""
        return np.ascontiguousarray(self.filled[self.state_at].swapaxes(0, 1))

    @cached_property
    def seen(self) -> Array:
        """1.0 where a state was measured and its step was run, (L + 1, B, n)."""
        there = np.isfinite(self.states[self.state_at])
        if self.hidden:
            begins = np.isin(self.state_at, np.cumsum([0, *(self.lengths + 1)]))
            there[..., list(self.hidden)] &= begins[..., None]
            there[..., list(self.behind)] = False
        run = np.concatenate([np.ones((len(self.valid), 1)), self.valid], axis=1)
        return np.ascontiguousarray((there * run[:, :, None]).swapaxes(0, 1))

    @cached_property
    def idle(self) -> Any:
        """Steps that fill up shorter runs and were not run, (L, B) of bool."""
        return self.valid.T == 0

    @cached_property
    def time(self) -> Array:
        """Time since the trial began at the start of each step, (L, B) [s]."""
        flat = np.concatenate([np.arange(T) * self.dt for T in self.lengths])
        return np.ascontiguousarray(flat[self.step_at].T)

    @cached_property
    def used(self) -> Any:
        """Trials of which a run is kept, as indices."""
        return np.unique(self.trial_of)

    @cached_property
    def in_use(self) -> Data:
        """The same with the commands of these trials alone."""
        return replace(self, commands=self.commands[self.used], held=self.held[self.used])

    def runs(self, per_step: Array) -> Array:
        """Per-step values on whole trials (S, T_max, m) -> by run (L, B, m)."""
        flat = np.concatenate([per_step[i, :T] for i, T in enumerate(self.lengths)])
        return np.ascontiguousarray(flat[self.step_at].swapaxes(0, 1))


def prepare(
    model: Model,
    trials: Sequence[Trial],
    latency: Array | None = None,
    past: Array | None = None,
    hidden: Sequence[str] = (),
) -> Data:
    """Trials of one time grid as one record.

    Args:
        model: the crude model.
        trials: at least one with two finite steps; what follows the first gap in the inputs or the
            last finite state is left out, gaps in single states stay (as missing).
        latency: transport delay of the inputs [s] that is already modelled (m,).
        past: the input held before t = 0 where a trial does not say (m,).
        hidden: states that no sensor has (the memory of adopted effects): known at the start, what
            the trials say of them later is where their fit begins. True values behind a late log
            are known nowhere: theirs begins at the log, for a model that carried them on from the
            start of a long trial has drifted, and where it lacks a speed it says nothing.

    Raises:
        GroundedError: for trials of other states or inputs, of different dt, or empty ones.
    """
    _check(model, trials)
    used = [(trial, trial.known_steps) for trial in trials]
    used = [(trial, T) for trial, T in used if T >= 2]
    if not used:
        raise GroundedError(
            "no trial holds two finite steps: nothing to diagnose; verify the stored files, or "
            "ingest a trial that ran",
            then=NextCommand("verify"),
        )
    dt, m = used[0][0].dt, model.m
    lengths = np.array([T for _, T in used])
    commands = np.empty((len(used), int(lengths.max()), m))
    held = np.zeros((len(used), m))
    before = np.zeros(m) if past is None else past
    for i, (trial, T) in enumerate(used):
        commands[i, :T] = trial.inputs[:T]
        commands[i, T:] = trial.inputs[T - 1]
        held[i] = before if trial.start_inputs is None else trial.start_inputs
    states = np.concatenate([trial.states[: T + 1] for trial, T in used])
    behind = true_values(model.state_names, hidden)
    states[:, list(behind)] = states[:, list(behind.values())]
    steps = np.concatenate([trial.inputs[:T] for trial, T in used])
    slow = simulated(model)
    state_at, step_at, valid, trial_of = _cut(lengths, SHORTER_RUN if slow else LONGEST_RUN)
    most = max(1, int(MOST_NUMBERS / (step_at.shape[1] * model.n**2 * 4)))
    begins = np.flatnonzero(np.diff(trial_of, prepend=-1))
    if slow:
        some = max(PIECES, min(len(begins), BEGINNINGS), SIMULATED // step_at.shape[1])
        most = min(most, some)
    keep = _informative([_filled(states)[state_at], steps[step_at]], begins, most)
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
        hidden=tuple(model.state_names.index(name) for name in hidden),
    )


def _check(model: Model, trials: Sequence[Trial]) -> None:
    if not trials:
        raise GroundedError("there are no trials to diagnose: run or ingest one first")
    for trial in trials:
        for what, found, known in (
            ("states", trial.state_names, model.state_names),
            ("inputs", trial.input_names, model.input_names),
        ):
            if tuple(found) != tuple(known):
                raise GroundedError(
                    f"trial '{trial.id or '?'}' has the {what} {', '.join(found)}; the model "
                    f"'{model.name}' has {', '.join(known)}"
                )
        if abs(trial.dt - trials[0].dt) > 1e-9 * trials[0].dt:
            raise GroundedError(
                f"trials have different time steps ({trials[0].dt:g} s and {trial.dt:g} s): "
                "diagnose them apart"
            )


def _cut(lengths: Any, longest: int) -> tuple[Any, Any, Array, Any]:
    """Index arrays of runs: each trial in equal parts of so many steps at most."""
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


def _informative(signals: Sequence[Array], begins: Any, most: int) -> Any:
    """Which runs to keep: of groups of neighbours the one in which signals (B, any, k) vary most.

    Every signal counts by its variance within the run, in units of its variance over all: what
    stands still tells of nothing. Groups, so that all trials and all of their time have a say. Some
    are runs that a trial begins with, `begins`: whole trials are predicted from there.
    """
    count = len(signals[0])
    if count <= most:
        return np.arange(count)
    some = np.linspace(0, len(begins) - 1, min(len(begins), BEGINNINGS, max(1, most // 2)))
    first = begins[some.astype(int)]
    parts = [x.var(axis=1) / np.maximum(x.var(axis=(0, 1)), 1e-300) for x in signals]
    moves = np.concatenate(parts, axis=1).mean(axis=1)
    others, left = np.setdiff1d(np.arange(count), first), most - len(first)
    groups = np.array_split(others, left) if left else []
    return np.sort([*first, *(group[np.argmax(moves[group])] for group in groups)])


def _filled(states: Array) -> Array:
    """NaN replaced by the last finite value of its column (by the next at the start)."""
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
