"""Design of the next trial: the drive that tells parameters, the probe that separates a tie.

Both add multisines (Schroeder 1970: little peak for much power) and staircases, slow or quick, to
what the inputs do otherwise, run them in the model, and take what tells most. Both stay inside the
limits of the inputs and, by the model, inside [safety].

A *drive* is added to the inputs that hold the robot at its start, on all inputs at once, each at
frequencies of its own. With the Fisher information F of its run on the parameters in units of their
priors (what a fit of its log will find), the best maximises

    1/2 log det(I + F)                                                      (D-optimal)

Its size falls until the run stays inside [safety] also with each parameter a standard deviation of
its prior away. Where no drive without feedback stays there, the states are fed back to its run by
the gains of a linear quadratic regulator about the start.

A *probe* is added to the best policy, on the inputs that two tied hypotheses A and B act on. Its
run is simulated in the model with A, then B is fitted to it with the same noise, its values and all
calibrated parameters free. What it can't explain is the expected evidence (and likewise with A and
B exchanged, of which the smaller counts):

    E[log p(y | A) - log p(y | B)] = 1/2 |whitened innovations of B on A's run|^2

This number is calibrated on the trials so far. The same computation with their commands predicts
some nats of difference between A and B, and the actual difference is known. The ratio scales the
expected evidence of every probe.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grounded.compile.problem import Problem
from grounded.diagnosis.hypotheses.variations import in_place
from grounded.diagnosis.levels import NATS
from grounded.diagnosis.likelihood.data import Data, prepare
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.noise import NoiseModel, Structure
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine
from grounded.diagnosis.parts import Diagnosis
from grounded.diagnosis.validation.identifiable import WEAK
from grounded.effects import Effect, Library, Scales, scales_of
from grounded.effects.actuator import delay_again
from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.policy import Policy
from grounded.rollout import simulate
from grounded.search.planner import planner_with, predicted
from grounded.task import Task
from grounded.trial import Trial
from grounded.utility import Reward

SIZES = (1.0, 0.7, 0.5, 0.35, 0.2, 0.1, 0.05, 0.02)  # of half the input's range
ADDED = (0.15, 0.35)  # of the input's range, to a policy
BANDS = ((0.5, 4.0), (1.0, 12.0), (2.0, 40.0))  # cycles in the drive: lowest and highest
TONES = 8  # of a multisine, for each input
TURNS = 2  # ways in which inputs share the frequencies that are tried
NOISE = 0.01  # of a state's range in a drive: noise of a sensor of which no log tells
UNMODELLED = 0.1  # of that: what no model predicts, a step
SILENT = 1e-12  # noise of a state that no sensor shows
FEWEST = 6  # control steps in a cycle
SETTLED = 500  # steps of the regulator's Riccati equation
SEPARABLE_NATS = 0.1  # nats below which no trial can separate two effects
REPLAYED = 4  # most recent trials whose commands are used to calibrate the expected evidence
ADAPTED = 12  # iterations in which a rival is fitted to a run


@dataclass(frozen=True, eq=False)
class KnownNoise:
    """The noise that runs are judged by; `hidden` states (adopted memories) have none."""

    model: NoiseModel
    hidden: tuple[str, ...]

    @classmethod
    def of(cls, sizes: Array, hidden: tuple[str, ...]) -> KnownNoise:
        """Return white noise of these standard deviations of process and measurement, (2, n)."""
        log_q, log_r = 2 * np.log(sizes)
        still = np.full(len(log_q), -60.0)
        return cls(NoiseModel(Structure(), log_q, log_r, log_q.copy(), still), hidden)

    def fitted(
        self, task: Task, runs: Sequence[Trial], h: Hypothesis, iterations: int
    ) -> Fitted | None:
        """Return a hypothesis fitted to runs under this noise; None if it can't be filtered."""
        data: Data = prepare(task.model, runs, task.latency, task.past, self.hidden)
        start = [(h, self.model, data.y.copy())]
        fits = refine(Predictor(data), start, iterations=iterations, fixed_noise=True)
        return fits[0] if fits else None


def information(task: Task, run: Trial, h: Hypothesis, noise: KnownNoise) -> Array:
    """Return the Fisher information of a run on a hypothesis' values, (C, C)."""
    fit = noise.fitted(task, [run], h, 1)
    return np.zeros((0, 0)) if fit is None else fit.gram.sum(axis=0)


def patterns(H: int, m: int) -> Iterator[tuple[str, tuple[float, float], Array]]:
    """Yield shapes of H steps and unit size, (H, m) each, with their name and their cycles."""
    phase = np.arange(H) / H
    for low, high in BANDS:
        high = min(high, H / FEWEST)
        grid = np.geomspace(low, max(high, low), TONES * m)
        for turn in range(min(TURNS, m) if m > 1 else 1):
            shape = np.empty((H, m))
            for j in range(m):
                tones = grid[(j + turn) % m :: m]
                own = -np.pi * np.arange(TONES) * (np.arange(TONES) + 1 + j) / TONES
                wave = np.sin(2 * np.pi * tones * phase[:, None] + own).sum(axis=1)
                shape[:, j] = wave / np.abs(wave).max()
            yield "multisine", (low, high), shape
            yield "staircase", (low, high), np.round(2 * shape) / 2


# -- the drive --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive to record, and what its log will tell.

    Args:
        policy: the commands, with feedback where the robot does not stay by itself.
        run: the model's run of it.
        pattern: "multisine" or "staircase".
        cycles: of its slowest and its quickest part.
        size: the share of the inputs' range that it uses.
        left: of each uncertain parameter, the standard deviation after a fit as a share of the
            prior's. It is a bound: of a model that is right but for these values.
        nats: 1/2 log det(I + F).
    """

    policy: Policy
    run: Trial
    pattern: str
    cycles: tuple[float, float]
    size: float
    left: Mapping[str, float]
    nats: float

    @property
    def weak(self) -> tuple[str, ...]:
        """The parameters that its log will leave weak or not identifiable."""
        return tuple(name for name, share in self.left.items() if share > WEAK)


def design(task: Task, steps: int, noise: Array, hidden: tuple[str, ...] = ()) -> Drive | None:
    """Find the drive of a length that tells most of the uncertain parameters.

    Args:
        task: model, start, limits, safety, latency; its target does not matter.
        steps: control steps H of the drive.
        noise: standard deviation of a sample of each state's sensor, (n,); 0 where unknown.
        hidden: states that no sensor shows, such as the memory of adopted effects.

    Returns:
        The drive; None if none stays inside [safety].
    """
    # The largest drive of each pattern that stays inside [safety], with feedback if it must be.
    task = _of_length(task, steps)
    drives = _drives(task, None) or _drives(task, _regulator(task))
    if not drives:
        return None

    # The noise as logged, else a share of what a state moves; then the drive that tells most.
    moved = np.median([np.ptp(run.states, axis=0) for *_, run in drives], axis=0)
    sensor = np.where(noise > 0, noise, NOISE * np.where(moved > 0, moved, 1.0))
    sizes = np.array([UNMODELLED * sensor, sensor])
    sizes[:, [task.model.state_names.index(name) for name in hidden]] = SILENT
    known = KnownNoise.of(sizes, hidden)
    h, best = Hypothesis(shift=np.zeros(task.model.system.k), spread=1.0), None
    for pattern, cycles, size, policy, run in drives:
        F = information(task, run, h, known)
        whole = F + np.eye(len(F))  # in units of the parameters' priors
        if whole.shape != 2 * (len(task.model.uncertain),) or not np.isfinite(whole).all():
            continue
        nats = 0.5 * float(np.linalg.slogdet(whole)[1])
        if best is None or nats > best.nats:
            shares = np.sqrt(np.diag(np.linalg.inv(whole))).tolist()
            left = dict(zip(task.model.uncertain, shares, strict=True))
            best = Drive(policy, run, pattern, cycles, size, left, nats)
    return best


def _of_length(task: Task, steps: int) -> Task:
    """Return the task with another horizon and nothing to follow."""
    target, inputs = np.full((steps + 1, task.model.n), np.nan), np.tile(task.past, (steps, 1))
    return replace(
        task,
        target=target,
        input_target=inputs,
        reward=Reward(*map(np.zeros, (task.model.n, task.model.n, task.model.m, task.model.m))),
    )


def _drives(
    task: Task, gain: Array | None
) -> list[tuple[str, tuple[float, float], float, Policy, Trial]]:
    """Return the largest drive of each pattern: its name, cycles, size, policy and run."""
    # The model as it is, and with each parameter a standard deviation away, unless the robot would
    # then not even stay while its inputs are held: no drive is to blame for that.
    model, problem = task.model, task.problem(exact=True)
    spreads = np.array([one.spread for one in model.params.values()])
    reach = np.array([one.reach for one in model.params.values()])
    moves = np.diag(spreads)[spreads > 0]
    away = [np.clip(model.values + move, *reach.T) for move in (*moves, *-moves)]
    held = _about_its_run(task, np.tile(task.past, (task.horizon, 1)), gain)
    others = [replace(problem, p=values) for values in away]
    others = [one for one in others if held is not None and _safe(task, one, held) is not None]

    # The largest size of each.
    up, down, found = task.high - task.past, task.past - task.low, []
    for pattern, cycles, shape in patterns(task.horizon, task.model.m):
        for size in SIZES:
            sent = task.past + size * np.where(shape > 0, shape * up, shape * down)
            policy = _about_its_run(task, sent, gain)
            if policy is None or (run := _safe(task, problem, policy)) is None:
                continue
            if all(_safe(task, one, policy) is not None for one in others):
                found.append((pattern, cycles, size, policy, run))
                break
    return found


def _about_its_run(task: Task, sent: Array, gain: Array | None) -> Policy | None:
    """Return the policy that sends a drive, with feedback to the run that the model makes of it."""
    if gain is None:
        return task.policy(sent, None, None)
    problem, H = task.problem(exact=True), len(sent)
    gains = np.zeros((H, *gain.shape[:1], problem.nz))
    gains[:, :, : gain.shape[1]] = gain
    begin = simulate(problem, task.policy(sent, None, None)).z[0]
    run = simulate(problem, task.policy(sent, gains, np.tile(begin, (H, 1))))
    if not np.isfinite(run.z).all():
        return None
    return task.policy(run.inputs, gains, run.z[:-1])


def _safe(task: Task, problem: Problem, policy: Policy) -> Trial | None:
    """Return the run of a policy in a model; None if it leaves [safety] or diverges."""
    run = _run(task, problem, policy)
    inside = run is not None and (run.states == task.inside_safety(run.states)).all()
    return run if inside else None


def _regulator(task: Task) -> Array:
    """Return the gains (m, n) of a linear quadratic regulator about the start.

    Errors count by [safety], or else by 1 in their unit, and inputs by their limits.
    """
    assert task.safety_low is not None and task.safety_high is not None
    problem = task.problem(exact=True)
    f_x, f_u = problem.system.linearise(task.start[None], task.past[None], problem.p, problem.dt)
    A, B = f_x[0], f_u[0]
    room = 0.5 * (task.safety_high - task.safety_low)
    Q = np.diag(1 / np.where(np.isfinite(room), room, 1.0) ** 2)
    R = np.diag(1 / (0.5 * (task.high - task.low)) ** 2)
    V, K = Q, np.zeros(B.T.shape)
    for _ in range(SETTLED):
        K = -np.linalg.solve(R + B.T @ V @ B, B.T @ V @ A)
        V = Q + A.T @ V @ (A + B @ K)
    return np.asarray(K)


# -- the probe --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Probe:
    """A policy to run, the evidence expected of it [nats], and the next step that runs it.

    `little`: whether that is too little to be worth a trial.
    """

    policy: Policy
    expected: float
    step: Finding
    little: bool = False


def probe(
    task: Task,
    policy: Policy,
    diagnosis: Diagnosis,
    trials: Sequence[Trial],
    library: Library | None = None,
) -> Probe | None:
    """Find the best probe for the first indistinguishable group of a diagnosis of trials.

    It is added to a policy, usually the best so far.

    Returns:
        The probe; None if nothing ties that a trial could separate, or no probe is safe.
    """
    open_ = [g for g in diagnosis.indistinguishable if g not in diagnosis.equivalent]
    ties = [g[:2] for g in open_ if all(diagnosis.quantities.get(n) for n in g[:2])]
    if not ties:
        return None
    names, library, latest = ties[0], library or Library(), trials[-REPLAYED:]
    task, first, rival = _tied(task, diagnosis, trials, library, names)
    states, known = task.model.state_names, diagnosis.noise
    levels = (
        [of.get(n, 0.0) + SILENT for n in states] for of in (known.process, known.measurement)
    )
    hidden = tuple(n for n in states if n not in known.process)
    noise = KnownNoise.of(np.array([*levels]), hidden)
    fit = noise.fitted(task, latest, in_place(first, {names[0]: (rival,)}), ADAPTED)
    if fit is None:
        return None
    second = fit.hypothesis

    # either may be true: of each, the trials so far as it would have made them
    ways = []
    for both in ((first, second), (second, first)):
        again = (_replayed(task, both[0], trial, library) for trial in latest)
        made = [run for run in again if run is not None]
        ways.append((both, made, _apart(task, noise, both, made)))
    told = ways[0][2] * len(trials) / max(len(ways[0][1]), 1)
    rows = [diagnosis.ranked(name) for name in names]
    nats = [row.evidence for row in rows if row is not None and np.isfinite(row.evidence)] or [0.0]
    trust = min(1.0, max(NATS, float(np.ptp(nats))) / max(told, 1e-12))

    # the probe that tells most, whichever is true
    best: tuple[float, Policy, str] | None = None
    models = [_model(task, h, library) for h in (first, second)]
    for words, candidate in _added(policy, task.model, names):
        runs = [_safe(task, model, candidate) for model in models]
        kept = [run for run in runs if run is not None]
        if len(kept) < len(runs):
            continue
        expected = min(
            max(_apart(task, noise, both, [*made, run]) - so_far, 0.0)
            for (both, made, so_far), run in zip(ways, kept, strict=True)
        )
        if best is None or expected > best[0]:
            best = (expected, candidate, words)
    if best is None:
        return None
    most, chosen, words = best
    expected = trust * most
    pair: dict[str, Any] = {"effect": names[0], "others": names[1]}
    if expected >= NATS:
        step = found("gap.next.probe", *names, by=expected, probe=words, **pair)
        return Probe(chosen, expected, step)
    claimed = next((name for name in names if name in diagnosis.effects), None)
    claimed = claimed if most < SEPARABLE_NATS and not diagnosis.doubt else None
    step = found("gap.next.no_probe", *names, claimed=claimed, **pair)
    return Probe(chosen, expected, step, little=True)


def _tied(
    task: Task,
    diagnosis: Diagnosis,
    trials: Sequence[Trial],
    library: Library,
    names: Sequence[str],
) -> tuple[Task, Hypothesis, tuple[Effect, Mapping[str, float]]]:
    """Return the calibrated task, the claim with the first of two effects, and the second."""
    known = {n: e.value for n, e in diagnosis.parameters.items() if n in task.model.params}
    finite = {n: value for n, value in known.items() if np.isfinite(value)}
    task = task.with_model(task.model.with_values(finite))
    states, inputs = (np.concatenate([getattr(t, k) for t in trials]) for k in ("states", "inputs"))
    duration = max(trial.steps for trial in trials) * task.dt
    scales = scales_of(task.model, states, inputs, task.dt, duration)
    h = Hypothesis()
    if known:
        h = replace(h, shift=np.zeros(task.model.system.k), spread=1.0)
    for name in dict.fromkeys((*diagnosis.joining, names[0])):
        if not name.startswith("parameter:") and name != names[1]:
            h = h.plus(_effect(library, name, task, diagnosis, scales), diagnosis.values(name))
    rival = _effect(library, names[1], task, diagnosis, scales)
    return task, h, (rival, diagnosis.values(names[1]))


def _effect(
    library: Library, name: str, task: Task, diagnosis: Diagnosis, scales: Scales
) -> Effect:
    """Return the effect as the diagnosis had it: for an adopted delay, its change.

    A quantity that the diagnosis did not estimate is held: whether parameters already describe the
    viscous part of a friction may depend on their values, which are calibrated here.
    """
    effect, adopted = library.effect(name, task.model, scales), diagnosis.made
    if row := diagnosis.ranked(name):
        kept = (
            q if q.fixed or q.name in row.params else replace(q, fixed=True)
            for q in effect.quantities
        )
        effect = replace(effect, quantities=tuple(kept))
    if name not in adopted.effects or effect.family.name != "delay":
        return effect
    assert task.latency is not None
    late = task.latency[[task.model.input_names.index(n) for n in effect.site.targets]]
    return delay_again(effect, float(adopted.effects[name]["d"]), float(late.min()))


def _model(task: Task, h: Hypothesis, library: Library) -> Problem:
    """Return the problem of a task in the model with a hypothesis."""
    if h.shift is not None:
        values = (task.model.values + h.shift).tolist()
        moved = dict(zip(task.model.param_names, values, strict=True))
        task = task.with_model(task.model.with_values(moved))
    effects = [(effect.name, values) for effect, values in h.pairs]
    plan = planner_with(task, effects, library, lambda _, values: values).plan
    return plan.problem(exact=True)


def _run(task: Task, model: Problem, policy: Policy) -> Trial | None:
    """Return the run of a policy in a model, without noise; None if it diverges."""
    run = predicted(model, policy)
    if not np.isfinite(run.z).all():
        return None
    names, states = (task.model.state_names, task.model.input_names), run.states[:, : task.model.n]
    return Trial(states, run.inputs, task.dt, *names, start_inputs=task.past)


def _replayed(task: Task, h: Hypothesis, trial: Trial, library: Library) -> Trial | None:
    """Return the run of a trial's commands from its start with a hypothesis."""
    begin = trial.states[0] if np.isfinite(trial.states[0]).all() else task.start
    past = task.past if trial.start_inputs is None else trial.start_inputs
    task = replace(_of_length(task, trial.known_steps), start=begin, past=past)
    sent = task.policy(trial.inputs[: trial.known_steps], None, None)
    return _run(task, _model(task, h, library), sent)


def _apart(
    task: Task, noise: KnownNoise, both: Sequence[Hypothesis], runs: Sequence[Trial]
) -> float:
    """Return the evidence of runs for the first of two hypotheses, which made them [nats].

    All values are fitted to all runs together. Fitted to a probe's run alone, the values of a rival
    would forget what the trials so far say of them, and most rivals would pass for equivalent.
    """
    if not runs:
        return 0.0
    fits = [noise.fitted(task, runs, h, ADAPTED) for h in both]
    rss = [np.inf if fit is None else float(fit.rss.sum()) for fit in fits]
    return max(0.5 * (rss[1] - rss[0]), 0.0)


OWN = "the best candidate's policy"


def _added(policy: Policy, model: Model, names: Sequence[str]) -> Iterator[tuple[str, Policy]]:
    """Yield the policy, then it with each pattern added to the inputs of tied effects, in words.

    If the effects act on states, all inputs are driven.
    """
    yield f"{OWN} again", policy
    targets = {t for name in names for t in name.partition(":")[2].split("+")}
    own = [j for j, n in enumerate(model.input_names) if n in targets] or [*range(model.m)]
    room = policy.high - policy.low
    room = np.where(np.isfinite(room), room, 2.0)
    on = ", ".join(policy.input_names[j] for j in own)
    for size in ADDED:
        for pattern, (slow, quick), shape in patterns(policy.horizon, len(own)):
            sent = policy.feedforward.copy()
            sent[:, own] += size * room[own] * shape
            long = policy.horizon * policy.dt
            hertz = f"{slow / long:.2g} to {quick / long:.2g} Hz"
            words = f"{OWN} with a {pattern} of {size:.0%} of the range, {hertz}, added to {on}"
            yield words, replace(policy, feedforward=np.clip(sent, policy.low, policy.high))
