"""Task: the manoeuvre, the model and the reward that judges a run.

All checks are made here once, so that inner code does not repeat them. `Task.problem` converts a
task to the plain arrays that the kernels use.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from grounded.checks import (
    finite,
    numbers,
    of_shape,
    of_type,
    positive,
    refused,
    same_names,
    whole_number,
    wrong,
)
from grounded.frozen import Array
from grounded.model import Model
from grounded.policy import Policy
from grounded.result import with_unit
from grounded.trial import Trial
from grounded.utility import Reward, step_rewards

if TYPE_CHECKING:
    from grounded.compile.problem import Problem

MAX_HORIZON = 200_000  # control steps; each needs a few kB for its gains
HELD = 1e-6  # tolerance, as a fraction of an input's range, for a rounded held input at its limit


@dataclass(frozen=True, eq=False)
class Task:
    """A manoeuvre: follow `target` for H steps of `dt`, from the state `start`.

    Args:
        model: the crude model (n states, m inputs).
        dt: control interval [s].
        target: (H + 1, n) desired states in their units, angles unwrapped; NaN for a state that is
            not tracked.
        reward: quadratic weights.
        start: (n,) initial state s_0.
        past: (m,) input held before t = 0.
        low: (m,) hard lower limits of the inputs; -inf for no limit.
        high: (m,) hard upper limits of the inputs; inf for no limit.
        feedback: whether policies have feedback gains; False for open-loop input sequences.
        latency: (m,) transport delay of each input [s]; None: as a simulator's file states it,
            or zero.
        input_target: (H, m) inputs that the input penalty is relative to; None for zero.
        safety_low: (n,) lower bounds on predicted states; -inf for no bound.
        safety_high: (n,) upper bounds on predicted states; inf for no bound.
        smoothing: width over which the PLANNING model blends non-smooth terms (`np.where`, `abs`).
        fed_back: (m,) number of past inputs that policies feed back at least, for those made with a
            longer latency; empty for as many as the latency needs.

    Raises:
        GroundedError: if shapes do not match, lower limits are not below the upper ones, the held
            input lies outside its limits, or a weighted state has no finite target.
    """

    model: Model
    dt: float
    target: Array
    reward: Reward
    start: Array
    past: Array
    low: Array
    high: Array
    feedback: bool = True
    latency: Array | None = None
    input_target: Array | None = None
    safety_low: Array | None = None
    safety_high: Array | None = None
    smoothing: float = 0.05
    fed_back: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for name, kind in (("model", Model), ("reward", Reward)):
            of_type(f"task: {name}", getattr(self, name), kind)
        if not isinstance(self.feedback, bool | np.bool_):
            raise wrong("task: feedback", self.feedback, must="bool")
        n, m = self.model.n, self.model.m
        target = numbers(self.target, "task: target")
        if target.ndim != 2 or target.shape[1] != n:
            do = "turned" if target.ndim == 2 and len(target) == n else "rows"
            raise wrong("task: target", target.shape, shape=f"(H + 1, {n})", do=do)
        H = len(target) - 1
        whole_number("task: horizon", H, 1, MAX_HORIZON)
        stated = getattr(self.model.step, "latency", {})
        defaults = {
            "latency": np.array([*map(stated.get, self.model.input_names, [0.0] * m)]),
            "input_target": np.zeros((H, m)),
            "safety_low": np.full(n, -np.inf),
            "safety_high": np.full(n, np.inf),
        }
        shapes = {"target": (H + 1, n), "start": (n,), "past": (m,), "low": (m,), "high": (m,)}
        shapes |= {"latency": (m,), "input_target": (H, m), "safety_low": (n,), "safety_high": (n,)}
        for name, shape in shapes.items():
            given = getattr(self, name)
            if given is None and name not in defaults:
                do = "free" if name in ("low", "high") else "rows"
                raise wrong(f"task: {name}", got="None", shape=str(shape), do=do)
            value = numbers(defaults[name] if given is None else given, f"task: {name}")
            of_shape(f"task: {name}", value, shape)
            object.__setattr__(self, name, value)
        for name, size in {"state": n, "terminal": n, "input": m, "input_change": m}.items():
            of_shape(f"[reward] {name}", getattr(self.reward, name), (size,))
        self._check_values()

    def __repr__(self) -> str:
        followed = np.flatnonzero(np.isfinite(self.target).any(axis=0))
        names = ", ".join(self.model.state_names[i] for i in followed) or "nothing"
        steps = f"{self.horizon} steps of {self.dt:.4g} s"
        return f"Task({self.model.name}: {steps}, following {names}; {self.hash})"

    def _check_values(self) -> None:
        positive("task: dt", self.dt)
        if not (np.isfinite(self.smoothing) and self.smoothing >= 0):
            raise wrong("[model] smoothing", self.smoothing, must="weights")
        assert self.latency is not None
        assert self.safety_low is not None and self.safety_high is not None
        for i, name in enumerate(self.model.state_names):
            if not self.safety_low[i] < self.safety_high[i]:
                ends = [float(self.safety_low[i]), float(self.safety_high[i])]
                raise wrong(f"[safety] {name}", ends, must="ascending")
        for i, name in enumerate(self.model.input_names):
            if not self.low[i] < self.high[i]:
                ends = [float(self.low[i]), float(self.high[i])]
                raise wrong(f"[limits] {name}", ends, must="ascending")
            if not 0 <= self.latency[i] <= 50 * self.dt:
                most = f"{50 * self.dt:g} s (50 control steps)"
                raise wrong(
                    f"[task] latency of {name}", got=f"{self.latency[i]:g} s", low=0, high=most
                )
        weighted = self.reward.state + self.reward.terminal > 0
        for i, name in enumerate(self.model.state_names):
            bad = ~np.isfinite(self.target[:, i])
            if weighted[i] and bad.any():
                raise refused("given.unweighed", name, step=str(np.argmax(bad)))
        finite("task: start", self.start)
        finite("task: past, the input held before the start,", self.past)
        for i, (name, unit) in enumerate(self.model.inputs.items()):
            low, held, high = float(self.low[i]), float(self.past[i]), float(self.high[i])
            room = HELD * (high - low if np.isfinite(high - low) else abs(held))
            if not low - room <= held <= high + room:
                given = with_unit(f"{held:g}", unit)
                what = f"{name}, held before the start,"
                raise wrong(what, got=given, low=low, high=high, do="hold")

    @property
    def horizon(self) -> int:
        """H, the number of control steps."""
        return len(self.target) - 1

    @cached_property
    def hash(self) -> str:
        """Hash of everything that the utility of a real trial depends on, 16 hex digits.

        The model's parameters are not part of it: they may change while the task stays the same.
        """
        digest = hashlib.sha256()
        digest.update(repr((self.model.state_names, self.model.input_names)).encode())
        digest.update(repr((float(self.dt), self.feedback)).encode())
        reward = self.reward
        weights = (reward.state, reward.terminal, reward.input, reward.input_change)
        for array in (self.target, self.start, self.past, self.low, self.high, *weights):
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(np.ascontiguousarray(self.input_target).tobytes())
        return digest.hexdigest()[:16]

    def with_model(self, model: Model) -> Task:
        """Return the task with another model of the same states and inputs."""
        return dataclasses.replace(self, model=model)

    def problem(self, bias: Array | None = None, *, exact: bool = False) -> Problem:
        """Return the arrays for the kernels.

        Args:
            bias: (H, n) added to the model's next state at each step; None for zero.
            exact: switch off the smoothing of non-smooth terms.
        """
        from grounded.compile.problem import Problem

        model, H = self.model, self.horizon
        weight = np.tile(self.reward.state, (H + 1, 1))
        weight[-1] += self.reward.terminal
        assert self.latency is not None and self.input_target is not None
        return Problem(
            system=model.system,
            p=model.values,
            dt=self.dt,
            start=self.start,
            past=self.past,
            delay=self.latency / self.dt,
            bias=np.zeros((H, model.n)) if bias is None else bias,
            target=np.where(np.isfinite(self.target), self.target, 0.0),
            state_weight=weight,
            input_target=self.input_target,
            input_weight=self.reward.input,
            change_weight=self.reward.input_change,
            low=self.low,
            high=self.high,
            angles=model.angle_mask,
            smoothing=0.0 if exact else self.smoothing,
            fed_back=self.fed_back,
        )

    def policy(self, ubar: Array, gain: Array | None, reference: Array | None) -> Policy:
        """Return a policy for this task.

        Args:
            ubar: (H, m) feed-forward.
            gain: (H, m, nz) feedback gains; None for none.
            reference: (H, nz) states that the gains refer to; None for none.
        """
        return Policy(
            feedforward=ubar,
            low=self.low,
            high=self.high,
            dt=self.dt,
            state_names=self.model.state_names,
            input_names=self.model.input_names,
            depths=self.problem().depths,
            angles=tuple(bool(a) for a in self.model.angle_mask),
            past=self.past,
            gain=gain if self.feedback else None,
            reference=reference if self.feedback else None,
        )

    def rewards(self, trial: Trial, reward: Reward | None = None) -> Array:
        """Return the reward of every step of a trial, (T + 1,); NaN where it is not finite.

        Samples after the horizon are ignored.

        Args:
            trial: a run of this task, with the model's states and inputs.
            reward: other weights; None for the task's.

        Raises:
            GroundedError: if the trial has other states or inputs than the model.
        """
        same_names("the trial", "states", trial.state_names, self.model.state_names)
        same_names("the trial", "inputs", trial.input_names, self.model.input_names)
        trial = trial.whole(self.horizon)
        T = trial.steps
        assert self.input_target is not None
        error = self.model.difference(trial.states, self.target[: T + 1])
        past = self.past if trial.start_inputs is None else trial.start_inputs
        reward = reward or self.reward
        return step_rewards(reward, error, trial.inputs, self.input_target[:T], past)

    def inside_safety(self, states: Array) -> Array:
        """Return states (..., n), each moved into its bounds of [safety] if it is outside."""
        return np.clip(states, self.safety_low, self.safety_high)

    def utility(self, trial: Trial) -> float:
        """Return the utility of a real trial (section 2 of the paper): the sum of its rewards.

        It is -inf for a trial that ended early or is not finite. A recording that lacks the last
        step or two is extrapolated and does not count as ended early, see `Trial.whole`.

        Raises:
            GroundedError: if `trial` is not a `Trial`.
        """
        of_type("the trial", trial, Trial)
        return self._utility(trial.whole(self.horizon))

    def terms(self, trial: Trial) -> dict[str, float]:
        """Return the contribution (<= 0) of each [reward] entry to a trial's utility, by name."""
        none = {one.name: 0 * getattr(self.reward, one.name) for one in fields(Reward)}
        return {
            name: float(self.rewards(trial, Reward(**none | {name: own})).sum())
            for name in none
            if (own := getattr(self.reward, name)).any()
        }

    def _utility(self, trial: Trial) -> float:
        if trial.steps < self.horizon or trial.finite_steps < self.horizon:
            return -np.inf
        total = float(self.rewards(trial).sum())
        return total if np.isfinite(total) else -np.inf  # overflow: the run diverged
