"""Test for structure that no effect explains: its channel, its size, and where it acts.

A flexible regression tries to predict the residual of the best hypothesis: for each channel, a
correction of its rate that is linear in many generic features,

    bins and powers of every input, earlier inputs by up to 7 steps, products of inputs with each
    other, with dynamic states and with parts of the trial, bins of time, direction of motion.

Its columns are whitened by the filter of the best hypothesis, and the weights solved by ridge
regression on all trials but one. What counts is the gain in likelihood on the trial left out.
Noise, however coloured or heavy-tailed, gains nothing there. A correction that gains is a leftover.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded import places
from grounded.diagnosis.error_report import Correction, Curve
from grounded.diagnosis.levels import PICKED
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.linearise import gains_of, step_jacobian
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.validation.choose import Errors, jackknife
from grounded.diagnosis.validation.ruler import Ruler
from grounded.effects.rate import KNOTS, bells
from grounded.filter import kalman
from grounded.frozen import Array
from grounded.result import per_second

PENALTIES = (3.0, 30.0)  # ridge: relative prior variances of the weights
LAGS = (1, 2, 4, 7)  # steps
RHO_LAGS = 10  # autocorrelation lags of the test for white innovations


@dataclass(frozen=True, eq=False)
class Leftover:
    """A leftover in one channel: gain on held-out trials [nats], rms size of the rate [unit/s]."""

    channel: str
    gain: float
    size: float
    unit: str
    correction: Array  # (L, B) rate added by the regression, its weights from other trials
    improvement: Array  # (L, B) held-out gain of each step [nats]


def leftovers(predictor: Predictor, fit: Fitted) -> list[Leftover]:
    """Return the channels in which the regression predicts held-out trials better, best first."""
    data = predictor.data
    if len(np.unique(data.folds)) < 2:
        return []
    features, gains = flexible(predictor, fit), filter_of(predictor, fit)
    found = []
    for i, name in enumerate(data.model.state_names):
        if i in data.hidden:
            continue
        gain, step_gain, weights = held_out_columns(predictor, fit, gains, features, i)
        if gain > PICKED:
            correction = held_out_rate(data, features, weights)
            size = float(np.sqrt((correction**2 * data.valid.T).sum() / data.valid.sum()))
            unit = data.model.states[name]
            found.append(Leftover(name, gain, size, per_second(unit), correction, step_gain))
    return sorted(found, key=lambda left: -left.gain)


def corrections(
    ruler: Ruler, fit: Fitted, left: Sequence[Leftover]
) -> dict[str, tuple[Leftover, Errors]]:
    """Return, by channel, the leftovers of a fit whose correction improves predictions."""
    found = {}
    for one in left:
        gain, errors = ruler.corrected(fit, one.channel, one.correction)
        if gain.clear:
            found[one.channel] = one, errors
    return found


def flexible(predictor: Predictor, fit: Fitted) -> Array:
    """Return the features of every step, (L, B, K), each of unit size."""
    data, h = predictor.data, fit.hypothesis
    model = data.model
    x, u = fit.track[:-1], predictor.inputs(h)
    names = [n for n in places.dynamic(model) if n in model.state_names]
    states = [_scaled(x[..., model.state_names.index(n)]) for n in names][:6]
    inputs = [_scaled(u[..., j]) for j in range(model.m)]
    lagged = [_scaled(_lagged(u[..., j], k)) for j in range(model.m) for k in LAGS]
    clock = data.time / max(float(data.time.max()), data.dt)
    columns: list[Array] = [np.ones_like(clock)]
    for value in inputs:
        columns += [value, value**2, value**3, np.maximum(value, 0), np.abs(value)]
        columns += _bins(value, 10)
        columns += [value * (clock > part) for part in (0.33, 0.5, 0.67)]
    columns += lagged
    columns += list(states) + [s**2 for s in states] + [s**3 for s in states]
    columns += [a * b for k, a in enumerate(inputs) for b in inputs[k + 1 :]]
    columns += [a**2 * np.sign(b) for a in inputs for b in inputs if a is not b]
    columns += [a * b for a in inputs for b in states]
    columns += [np.tanh(3 * _scaled(_rate(s))) for s in states]
    columns += _bins(clock, 16)
    stacked = np.stack(columns, axis=-1)
    size = np.sqrt((stacked**2).mean(axis=(0, 1)))
    return np.asarray(stacked / np.where(size > 1e-9, size, 1.0))


def _scaled(value: Array) -> Array:
    """Return values with zero mean and unit standard deviation, clipped to +-3."""
    spread = float(value.std())
    return np.asarray(np.clip((value - value.mean()) / max(spread, 1e-12), -3, 3))


def _lagged(value: Array, steps: int) -> Array:
    return np.concatenate([np.repeat(value[:1], steps, axis=0), value[:-steps]])[: len(value)]


def _rate(value: Array) -> Array:
    """Return the backward difference, which uses no later sample."""
    return np.concatenate([np.zeros_like(value[:1]), np.diff(value, axis=0)])


def _bins(value: Array, count: int) -> list[Array]:
    """Return an indicator for each of `count` bins of equal width that is not nearly empty."""
    edges = np.linspace(float(value.min()), float(value.max()) + 1e-9, count + 1)
    pairs = itertools.pairwise(edges)
    inside = [((value >= a) & (value < b)).astype(float) for a, b in pairs]
    return [column for column in inside if column.mean() > 0.01]


def held_out_rate(data: Data, features: Array, weights: Array) -> Array:
    """Return the rate (L, B) of features (L, B, K), in each fold with the weights of the others."""
    of_run = np.unique(data.folds, return_inverse=True)[1]
    return np.asarray(np.einsum("lbk,bk->lb", features, weights[of_run]))


def held_out_columns(
    predictor: Predictor, fit: Fitted, gains: kalman.Gains, features: Array, i: int
) -> tuple[float, Array, Array]:
    """Fit a correction of one state's rate on all folds but one, and score it on that fold.

    Args:
        predictor: evaluates hypotheses on the data.
        fit: the hypothesis whose residual is predicted.
        gains: its Kalman gains (`filter_of`).
        features: (L, B, K).
        i: index of the state.

    Returns:
        The gain on held-out folds [nats]; the same by step (L, B); weights (S + 1, K) without each
        of the S folds, and from all.
    """
    data = predictor.data
    L, B, K = features.shape
    n = data.model.n
    d = np.zeros((L, B, n, K))
    d[:, :, i, :] = features * data.dt
    white, _ = kalman.innovations(gains, d, np.zeros((L + 1, 1, 1, 1)))
    left_out = data.folds
    trials = np.unique(left_out)
    grams, scores = [], []
    for trial in trials:
        own = left_out == trial
        W = white[:, own].reshape(-1, K)
        grams.append(W.T @ W)
        scores.append(W.T @ fit.white[:, own].reshape(-1))
    G, s = np.sum(grams, axis=0), np.sum(scores, axis=0)
    scale = np.sqrt(np.maximum(np.diag(G), 1e-300))
    best: tuple[float, Array, Array] = (-np.inf, np.zeros((L, B)), np.zeros((len(trials) + 1, K)))
    for spread in PENALTIES:
        prior = np.diag(scale**2) / spread  # each weight may explain about `spread` nats
        total, by_step, each = 0.0, np.zeros((L, B)), []
        for trial, Gt, st in zip(trials, grams, scores, strict=True):
            weights = -np.linalg.solve(G - Gt + prior + 1e-12 * np.eye(K), s - st)
            each.append(weights)
            own = left_out == trial
            change = white[:, own] @ weights
            residual = fit.white[:, own]
            gained = 0.5 * (residual**2 - (residual + change) ** 2).sum(axis=-1)
            by_step[:, own] = gained
            total += float(gained.sum())
        if total > best[0]:
            whole = -np.linalg.solve(G + prior + 1e-12 * np.eye(K), s)
            best = (total, by_step, np.array([*each, whole]))
    return best


def filter_of(predictor: Predictor, fit: Fitted, *, covariances: bool = False) -> kalman.Gains:
    """Return the Kalman gains of a fit."""
    h, F = fit.hypothesis, step_jacobian(predictor, fit.hypothesis, fit.track)
    return gains_of(predictor, h, fit.noise, fit.track, F, covariances=covariances)


def whiteness(fit: Fitted, seen: Array) -> Array:
    """Return the Ljung-Box p-value of each state's whitened innovations, (n,), 10 lags."""
    from scipy.special import chdtrc

    L, _, n = fit.white.shape
    lags, e = min(RHO_LAGS, L // 4), fit.white * seen[1:]
    if not lags:
        return np.ones(n)
    count, power = (np.sum(a, axis=(0, 1)) for a in (seen[1:], e**2))
    q = np.zeros(n)
    for k in range(1, lags + 1):
        rho = (e[k:] * e[:-k]).sum(axis=(0, 1)) / np.maximum(power, 1e-300)
        q += rho**2 / np.maximum(count - k, 1.0)
    return np.asarray(chdtrc(lags, q * count * (count + 2)))


MOST_VARIABLES = 2  # most variables


def correction(ruler: Ruler, fit: Fitted, left: Sequence[Leftover]) -> Correction | None:
    """Fit and test a correction of the channel with the largest leftover.

    It is tested as a leftover is: on predictions of each fold, its weights from the others. Its
    gain is the share of the channel's squared error that is gone, a mean over horizons.

    Args:
        ruler: tests it on predictions.
        fit: the best hypothesis, beside which the correction is fitted.
        left: its leftovers, largest first.

    Returns:
        The correction; None without a leftover, with a single trial, or if no curve gains enough.
    """
    predictor, data = ruler.predictor, ruler.data
    if not left or data.count < 2:
        return None
    channel, basis, gains = left[0].channel, _bases(predictor, fit), filter_of(predictor, fit)

    def features(names: Sequence[str]) -> Array:
        return np.concatenate([basis[name][2] for name in names], axis=-1)

    # variables, one after the other, while held-out trials gain
    i, chosen = data.model.state_names.index(channel), list[str]()
    best, weights = PICKED, np.zeros((0, 0))
    while len(chosen) < MOST_VARIABLES and (rivals := [n for n in basis if n not in chosen]):
        tried = {
            n: held_out_columns(predictor, fit, gains, features([*chosen, n]), i) for n in rivals
        }
        name = max(tried, key=lambda n: tried[n][0])
        gain, _, each = tried[name]
        if gain < best + PICKED * bool(chosen):
            break
        best, weights, chosen = gain, each, [*chosen, name]
    if not chosen:
        return None

    # what predictions gain, and the shape of each curve
    found = ruler.corrected(fit, channel, held_out_rate(data, features(chosen), weights))[0]
    gain = 1 - float(np.exp(-2 * found.channels[ruler.names.index(channel)]))
    curves = []
    for name, own in zip(chosen, np.split(weights, len(chosen), axis=1), strict=True):
        lo, hi, _ = basis[name]
        shape = np.linspace(lo, hi, KNOTS), own[-1], jackknife(own[:-1])
        at, value, std = (tuple(row.tolist()) for row in shape)
        quantities = {"lo": lo, "hi": hi} | {f"w{k}": w for k, w in enumerate(value)}
        curves.append(Curve(f"correction:{channel}<-{name}", name, at, value, std, quantities))
    return Correction(
        channel=channel,
        over=tuple(chosen),
        held_out_gain=gain,
        adoptable=found.clear and gain > 0,
        unit=per_second(data.model.states[channel]),
        curves=tuple(curves),
    )


def _bases(predictor: Predictor, fit: Fitted) -> dict[str, tuple[float, float, Array]]:
    """Return basis functions over every measured state and every received input.

    {variable: (ends of its range, and the functions (L, B, KNOTS))}
    """
    data, model = predictor.data, predictor.data.model
    x, u = fit.track[:-1], predictor.inputs(fit.hypothesis)
    signals = {n: x[..., i] for i, n in enumerate(model.state_names) if i not in data.hidden}
    signals |= {n: u[..., j] for j, n in enumerate(model.input_names)}
    found = {}
    for name, r in signals.items():
        lo, hi = (float(q) for q in np.quantile(r[data.valid.T > 0], [0.02, 0.98]))
        if hi - lo > 1e-6 * max(abs(lo), abs(hi), 1e-9):
            found[name] = lo, hi, np.stack(bells(r, lo, hi), axis=-1)
    return found
