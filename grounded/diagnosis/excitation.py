"""Design of the next trial: the probe that best separates two tied explanations.

Two hypotheses A and B tie on the trials so far. Each of a set of probes (the base policy with a
staircase, doublets, a pulse, a frequency sweep or a slow ramp added to one input) is simulated in
the model with A. Then B is fitted to that run with the same noise, its values and all calibrated
parameters free. What it can't explain is the expected evidence of the probe:

    E[log p(y | A) - log p(y | B)] = 1/2 |whitened innovations of B on A's run|^2

This number is calibrated on the trials so far. The same computation with their commands predicts
some nats of difference between A and B, and the actual difference is known. The ratio scales the
expected evidence of every probe.

Without a tie, the probe is chosen for the information on the claimed and calibrated values
(D-optimal). With the Fisher information F of the trials so far and J of the probe's run, the
expected gain is

    1/2 log det(F + J) / det F

The predicted `+-` is that of F + J, for a model that is right. If predictions miss by more than the
noise, those of a new motion will, too, and J is reduced accordingly. States that no trial measured
are not measured in the probe's run, either. A limit is a kink: nothing better than a tenth of the
present `+-` is promised. A value that is known to WELL is no reason for a probe while there is a
gap without a cause, or an unconfirmed effect.

The probe stays inside the limits of the inputs, and the runs of both hypotheses inside the task's
safety limits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grounded.diagnosis.causes import value_called
from grounded.diagnosis.hypotheses.variations import in_place
from grounded.diagnosis.levels import NATS, SHOWS, WELL
from grounded.diagnosis.likelihood.data import Data, prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis, param_scale
from grounded.diagnosis.likelihood.noise import NoiseModel, Structure
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine
from grounded.diagnosis.parts import Diagnosis, Estimate, Made
from grounded.effects import Effect, Library, Scales, memory_start, scales_of, wrap, wrapping_order
from grounded.effects.actuator import delay_again
from grounded.effects.memory import shifted
from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.onboard import Runner
from grounded.policy import Policy
from grounded.task import Task
from grounded.trial import Trial

SEPARABLE_NATS = 0.1  # nats below which no trial can separate two effects
REPLAYED = 4  # most recent trials whose commands are used to calibrate the expected evidence
ADAPTED = 12  # iterations in which a rival is fitted to a run
SETTLED = 4  # iterations in which the track of an unmeasured state is found
PROMISED_SHARE = 0.1  # smallest fraction of a value's `+-` that is promised
NO_INFORMATION = 1e-6  # fraction of a value's information, and of its size, that counts as zero


@dataclass(frozen=True, eq=False)
class Probe:
    """A policy to run, the evidence expected of it [nats], and the next step that runs it.

    `little`: whether that is too little to be worth a trial.
    """

    policy: Policy
    expected: float
    step: Finding
    little: bool = False


@dataclass(frozen=True, eq=False)
class KnownNoise:
    """The noise of a diagnosis; `hidden` states (adopted memories) have neither kind of noise."""

    model: NoiseModel
    hidden: tuple[str, ...]

    @classmethod
    def of(cls, model: Model, diagnosis: Diagnosis) -> KnownNoise:
        """Return the noise that a diagnosis found."""

        def logs(levels: Mapping[str, float]) -> Array:
            return np.array([2 * np.log(levels.get(n, 0.0) + 1e-12) for n in model.state_names])

        known = diagnosis.noise
        q, r = logs(known.process), logs(known.measurement)
        noise = NoiseModel(Structure(), q, r, q.copy(), np.full(model.n, -60.0))
        return cls(noise, tuple(n for n in model.state_names if n not in known.process))

    def data(self, task: Task, runs: Sequence[Trial]) -> Data:
        """Return runs of a task as data of the likelihood."""
        return prepare(task.model, runs, task.latency, task.past, self.hidden)


def probe(
    task: Task,
    policy: Policy,
    diagnosis: Diagnosis,
    trials: Sequence[Trial],
    library: Library | None = None,
) -> Probe | None:
    """Find the best probe for the first indistinguishable group, or else for all values.

    Args:
        task: limits, start, safety, latency.
        policy: the policy that the probe is added to, usually the best so far.
        diagnosis: names the group and the values of the hypotheses.
        trials: the trials it was made from.
        library: source of the effects.

    Returns:
        The probe; None if there are neither ties nor values, or no probe is safe.
    """
    open_ = [g for g in diagnosis.indistinguishable if g not in diagnosis.equivalent]
    ties = [g for g in open_ if all(diagnosis.quantities.get(n) for n in g[:2])]
    if not ties:
        return _teaching(task, policy, diagnosis, trials, library or Library())
    group = ties[0]
    library = library or Library()
    task, first = _claim(task, diagnosis, trials, library, group[:2])
    rival = _effect(library, group[1], task, diagnosis, _scales(task, trials))
    second = in_place(first, {group[0]: ((rival, diagnosis.values(group[1])),)})
    noise = KnownNoise.of(task.model, diagnosis)
    latest = trials[-REPLAYED:]
    second = _adapted(task, latest, second, noise)
    # either may be true: of each, the trials so far as it would have made them
    ways = []
    for both in ((first, second), (second, first)):
        again = (_run(task, both[0], policy, trial) for trial in latest)
        known = [run for run in again if run is not None]
        ways.append((both, known, _apart(task, noise, both, known)))
    told = ways[0][2] * len(trials) / max(len(ways[0][1]), 1)
    rows = [diagnosis.ranked(name) for name in group[:2]]
    nats = [row.evidence for row in rows if row is not None and np.isfinite(row.evidence)] or [0.0]
    trust = min(1.0, max(NATS, float(np.ptp(nats))) / max(told, 1e-12))
    best: tuple[float, Policy, str] | None = None
    for words, candidate in probes(policy, task.model, _inputs_of(task.model, group[:2])):
        runs = [_run(task, h, candidate) for h in (first, second)]
        kept = [run for run in runs if run is not None and safe(task, run)]
        if len(kept) < len(runs):
            continue
        expected = min(
            max(_apart(task, noise, both, [*known, run]) - so_far, 0.0)
            for (both, known, so_far), run in zip(ways, kept, strict=True)
        )
        if best is None or expected > best[0]:
            best = (expected, candidate, words)
    if best is None:
        return None
    most, chosen, words = best
    expected = trust * most
    pair: dict[str, Any] = {"effect": group[0], "others": group[1]}
    if expected >= NATS:
        step = found("gap.next.probe", *group[:2], by=expected, probe=words, **pair)
        return Probe(chosen, expected, step)
    claimed = next((name for name in group[:2] if name in diagnosis.effects), None)
    claimed = claimed if most < SEPARABLE_NATS and not diagnosis.contested else None
    step = found("gap.next.no_probe", *group[:2], claimed=claimed, **pair)
    return Probe(chosen, expected, step, little=True)


def _teaching(
    task: Task, policy: Policy, diagnosis: Diagnosis, trials: Sequence[Trial], library: Library
) -> Probe | None:
    """Find the probe that gives most information on claimed and calibrated values."""
    (task, h), known = _claim(task, diagnosis, trials, library), list[tuple[str, Estimate, float]]()
    # the values, each with its name and the unit of its column
    for effect in h.effects:
        row = diagnosis.ranked(effect.name)
        if row is None:
            return None
        known += [(f"{q.name} of {effect.name}", row.params[q.name], 1.0) for q in effect.free]
    for (name, param), size in zip(task.model.params.items(), param_scale(task.model), strict=True):
        if size > 0 and h.spread:
            e = diagnosis.parameters.get(name, Estimate(0.0, 0.0))
            known.append((name, replace(e, unit=param.unit), float(size)))
    std = np.array([e.std / size if np.isfinite(e.std) else 0.0 for _, e, size in known])
    if not std.any():
        return None
    # information so far, or that of the priors; each column in the unit of what is known of it
    noise, best = KnownNoise.of(task.model, diagnosis), None
    F = information(task, trials, h, noise)
    if F.shape != (len(std), len(std)) or not np.isfinite(F).all():
        return None
    own = np.maximum(np.diag(F), 1 / np.maximum(std, NO_INFORMATION) ** 2)
    unit = np.outer(own, own) ** -0.5
    F = F * unit + np.diag(1 - np.diag(F) / own + NO_INFORMATION)
    unseen = np.isnan(np.concatenate([trial.states for trial in trials])).all(axis=0)
    for words, candidate in probes(policy, task.model, range(task.model.m)):
        run = _run(task, h, candidate)
        if run is None or not safe(task, run):
            continue
        J = information(task, [run], h, noise, unseen)
        if J.shape == F.shape and np.isfinite(J).all():
            J = J * unit / _misfit(diagnosis) ** 2
            gain = 0.5 * float(np.linalg.slogdet(F + J)[1] - np.linalg.slogdet(F)[1])
            if best is None or gain > best[0]:
                best = (gain, candidate, words, J)
    if best is None:
        return None
    # the value that it tells better than any other, of those that are not known well already
    gain, chosen, words, J = best
    left = np.sqrt(np.diag(np.linalg.inv(F + J)) / np.diag(np.linalg.inv(F)))
    values = np.array([e.value / size for _, e, size in known])
    well = bool(diagnosis.leftover or diagnosis.unconfirmed) & (std < WELL * np.abs(values))
    k = int(np.argmin(np.where((std > 0) & (~well | well[std > 0].all()), left, np.inf)))
    name, e, _ = known[k]
    then = e.std * max(float(left[k]), PROMISED_SHARE)
    called = value_called(name, (diagnosis.made or Made()).effects)
    motion = diagnosis.motions == 1 < len(trials) and words != BASE
    little = not motion and bool(left[k] > 1 - SHOWS or well[k])
    step = found("gap.next.no_probe", name, value=called)
    if motion:
        step = found("gap.next.probe", name, probe=words, motion=True)
    elif not little:
        ends: dict[str, Any] = {"after": Quantity(then, e.unit), "now": Quantity(e.std, e.unit)}
        step = found("gap.next.probe", name, probe=words, value=called, **ends)
    return Probe(chosen, gain, step, little)


def _misfit(diagnosis: Diagnosis) -> float:
    """Return the largest ratio of prediction errors to the noise, at least 1."""
    left = [one.error / one.floor for one in diagnosis.leftover if one.floor > 0]
    return float(max(1.0, diagnosis.where.tempering**-0.5, *left))


def information(
    task: Task, runs: Sequence[Trial], h: Hypothesis, noise: KnownNoise, unseen: Array | None = None
) -> Array:
    """Return the Fisher information of runs on a hypothesis' values, (C, C).

    `unseen`: mask (n,) of states that will not be measured in predicted runs.
    """
    data = noise.data(task, runs)
    track, iterations = data.y.copy(), 1
    if unseen is not None and unseen.any():
        hidden = [replace(run, states=np.where(unseen, np.nan, run.states)) for run in runs]
        data = noise.data(task, hidden)
    elif not data.told.all():
        iterations = SETTLED  # an unmeasured state has no track yet
    start = [(h, noise.model, track)]
    fits = refine(Predictor(data), start, iterations=iterations, fixed_noise=True)
    return fits[0].gram.sum(axis=0) if fits else np.zeros((0, 0))


def _inputs_of(model: Model, names: Sequence[str]) -> list[int]:
    """Return the indices of the inputs that tied effects act on; all if they act on states."""
    targets = {t for name in names for t in name.partition(":")[2].split("+")}
    own = [j for j, n in enumerate(model.input_names) if n in targets]
    return own or list(range(model.m))


def _claim(
    task: Task,
    diagnosis: Diagnosis,
    trials: Sequence[Trial],
    library: Library,
    pair: Sequence[str] = (),
) -> tuple[Task, Hypothesis]:
    """Return the calibrated task and the claim, calibrated parameters free.

    pair: the first of these two effects is claimed, and the second is not.
    """
    known = {n: e.value for n, e in diagnosis.parameters.items() if n in task.model.params}
    finite = {n: value for n, value in known.items() if np.isfinite(value)}
    task = task.with_model(task.model.with_values(finite))
    scales, h = _scales(task, trials), Hypothesis()
    if known:
        h = replace(h, shift=np.zeros(task.model.system.k), spread=1.0)
    for name in dict.fromkeys((*diagnosis.joining, *pair[:1])):
        if not name.startswith("parameter:") and name not in pair[1:]:
            effect = _effect(library, name, task, diagnosis, scales)
            h = h.plus(effect, diagnosis.values(name))
    return task, h


def _effect(
    library: Library, name: str, task: Task, diagnosis: Diagnosis, scales: Scales
) -> Effect:
    """Return the effect as the diagnosis had it: for an adopted delay, its change.

    A quantity that the diagnosis did not estimate is held: whether parameters already describe the
    viscous part of a friction may depend on their values, which are calibrated here.
    """
    effect, adopted = library.effect(name, task.model, scales), diagnosis.made or Made()
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


def _adapted(task: Task, runs: Sequence[Trial], h: Hypothesis, noise: KnownNoise) -> Hypothesis:
    """Return a hypothesis with the values fitted to some runs."""
    data = noise.data(task, runs)
    start = [(h, noise.model, data.y.copy())]
    fits = refine(Predictor(data), start, iterations=ADAPTED, fixed_noise=True)
    return fits[0].hypothesis if fits else h


def _scales(task: Task, trials: Sequence[Trial]) -> Scales:
    states = np.concatenate([trial.states for trial in trials])
    inputs = np.concatenate([trial.inputs for trial in trials])
    duration = max(trial.steps for trial in trials) * task.dt
    return scales_of(task.model, states, inputs, task.dt, duration)


def _run(task: Task, h: Hypothesis, policy: Policy, like: Trial | None = None) -> Trial | None:
    """Simulate the policy in the model with a hypothesis, without noise; None if it diverges.

    If `like` is given, its start and its commands are used instead of the policy.
    """
    model = _wrapped(task, h)
    assert task.latency is not None
    names = (task.model.state_names, task.model.input_names)
    nothing = np.empty((0, task.model.m))
    begin, held, steps = task.start, task.past, policy.horizon
    if like is not None and np.isfinite(like.states[0]).all():
        begin, steps = like.states[0], like.known_steps
        held = held if like.start_inputs is None else like.start_inputs
    start = Trial(begin[None], nothing, task.dt, *names, start_inputs=held)
    z = np.concatenate([begin, memory_start(model, task.model, start)])
    states, inputs, runner = [begin], np.zeros((steps, model.m)), Runner(policy)
    late, past = task.latency / task.dt, held[:, None]
    for effect, values in h.pairs:
        if effect.known:
            late[[model.input_names.index(n) for n in effect.site.targets]] += values["d"] / task.dt
    for t in range(steps):
        inputs[t] = like.inputs[t] if like else runner.action(t * policy.dt, states[-1])
        sent = inputs[None, : t + 1]
        received = [shifted(sent[..., j], past[j], late[j])[0, -1] for j in range(model.m)]
        z = model.system.step(z[None], np.array([received]), model.values, task.dt)[0]
        if not np.isfinite(z).all():
            return None
        states.append(z[: task.model.n])
    return Trial(np.array(states), inputs, task.dt, *names, start_inputs=held)


def _wrapped(task: Task, h: Hypothesis) -> Model:
    """Return the model with a hypothesis' shifts and effects."""
    model = task.model
    if h.shift is not None:
        moved = model.values + h.shift
        model = model.with_values(dict(zip(model.param_names, moved.tolist(), strict=True)))
    for i in wrapping_order([effect.family for effect in h.effects]):
        effect = h.effects[i]
        if effect.known:  # a change of the task's latency
            continue
        current = Library((effect.family,)).effect(effect.name, model, effect.site.scales)
        model = wrap(current, h.values[i], task.dt)
    return model


def safe(task: Task, run: Trial | None) -> bool:
    """Return whether a run stays inside [safety]; one that diverged, None, does not."""
    if run is None or task.safety_low is None or task.safety_high is None:
        return run is not None
    inside = (run.states >= task.safety_low) & (run.states <= task.safety_high)
    return bool(inside.all())


def _apart(
    task: Task, noise: KnownNoise, both: Sequence[Hypothesis], runs: Sequence[Trial]
) -> float:
    """Return the evidence of runs for the first of two hypotheses, which made them [nats].

    All values are fitted to all runs together. Fitted to a probe's run alone, the values of a rival
    would forget what the trials so far say of them, and most rivals would pass for equivalent.
    """
    if not runs:
        return 0.0
    data, rss = noise.data(task, runs), []
    for h in both:
        start = [(h, noise.model, data.y.copy())]
        fits = refine(Predictor(data), start, iterations=ADAPTED, fixed_noise=True)
        rss.append(float(fits[0].rss.sum()) if fits else np.inf)
    return max(0.5 * (rss[1] - rss[0]), 0.0)


OWN = "the best candidate's policy"
BASE = f"{OWN} again"
SIZES = (0.15, 0.35)  # of the input's range


def probes(policy: Policy, model: Model, inputs: Sequence[int]) -> Iterator[tuple[str, Policy]]:
    """Yield the base policy, then the policy with each pattern added to each input, described."""
    yield BASE, policy
    t = np.arange(policy.horizon, dtype=float) * policy.dt
    for j in inputs:
        low, high = policy.low[j], policy.high[j]
        room = float(high - low) if np.isfinite(high - low) else 2.0
        limits = f" (limits {low:g} to {high:g})" * bool(np.isfinite(high - low))
        for size in SIZES:
            for words, shape in patterns(t):
                feedforward = policy.feedforward.copy()
                feedforward[:, j] = np.clip(feedforward[:, j] + size * room * shape, low, high)
                name = policy.input_names[j]
                unit = model.inputs[name]
                of = f"{size * room:.2g} {unit}" if unit != "1" else f"{size * room:.2g}{limits}"
                made = replace(policy, feedforward=feedforward)
                yield f"{OWN} with {words} of {of} added to {name}", made


def patterns(t: Any) -> list[tuple[str, Array]]:
    """Return the shapes, of unit size, over the times t (H,), with their names."""
    T = float(t[-1]) + 1e-9
    phase = t / T
    stairs = np.round(4 * np.sin(2 * np.pi * phase)) / 4
    doublets = np.sign(np.sin(2 * np.pi * t / max(T / 5, 0.4)))
    sweep = np.sin(2 * np.pi * (0.2 * t + 0.5 * (2.0 - 0.2) / T * t**2))
    return [
        ("a slow ramp down", -phase),
        ("a slow ramp up", phase),
        ("a staircase", stairs),
        ("doublets", doublets),
        ("a frequency sweep", sweep),
        ("a negative pulse", -((phase > 0.4) & (phase < 0.7)).astype(float)),
    ]
