"""A late or filtered sensor: the filter's likelihood is the exact one, the log comes back."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.validation.limits import knowable
from grounded.effects import Library
from grounded.filter import kernels
from grounded.filter.augmented import Delayed, coloured
from grounded.filter.kalman import LinearSystem, gains, innovations, smoother
from grounded.models.cart_pole import model as cart_pole
from grounded.trial import Trial

L, B, n = 12, 2, 3
# late channels of each run, p of each (or a, b, c), colour, noise through G, missing samples
CASES = [
    ([[1], [1]], [[0.0], [0.0]], None, False, False),
    ([[1], [1]], [[0.4], [0.4]], None, True, False),
    ([[0], [2]], [[0.4], [0.9]], 0.8, False, True),
    ([[0, 2], [0, 1]], [[0.0, 0.7], [0.4, 0.4]], 0.9, True, True),
    ([[2, 1], [2, 1]], [[0.5, 0.2], [0.1, 0.3]], None, True, True),
    ([[1], [1]], [[(0.2, 0.1, 0.7)], [(0.4, 0.3, 0.3)]], None, True, False),
    ([[0, 2], [0, 1]], [[(0.7, 0.3, 0.0), (0.2, 0.1, 0.7)]] * 2, 0.9, True, True),
]


class Problem:
    """A random linear system, measurements of some channels late by part of a step, or filtered."""

    def __init__(self, channel, part, phi, through, missing, steps=L):
        rng = np.random.default_rng(n)
        weights = [[w if isinstance(w, tuple) else (1 - w, w, 0.0) for w in run] for run in part]
        self.L, self.phi, self.late = steps, phi, Delayed(np.array(channel), np.array(weights))
        self.F = 0.9 * np.eye(n) + 0.1 * rng.standard_normal((steps, B, n, n))
        self.G = None
        if through:
            self.G = np.tile(np.eye(n), (steps, B, 1, 1))
            self.G[:, :, n - 1, : n - 1] = rng.standard_normal((steps, B, n - 1))
        self.A = coloured(self.F, phi, self.G)
        self.N = self.A.shape[-1]
        self.seen = np.ones((steps + 1, B, n))
        if missing:
            self.seen[1:] = rng.random((steps, B, n)) > 0.3
            self.seen[-3:, 1] = 0.0
        self.d = 0.3 * rng.standard_normal((steps, B, n, 2))
        self.r = rng.standard_normal((steps + 1, B, n, 2))
        self.q, self.v = np.exp(rng.standard_normal(self.N)), np.exp(rng.standard_normal(n))
        self.start = np.full((B, self.N - n), 0.7)
        self.first = self.v * np.where(self.seen[0] > 0, 1.0, 1e6)

    def system(self, q, v):
        R = np.broadcast_to(v, (self.L + 1, B, n))
        Q = np.broadcast_to(q, (self.L, B, self.N))
        first = np.hstack([self.first, self.start])
        return LinearSystem(self.A, Q, R, self.seen, first, self.G)

    def passes(self, q, v):
        g = gains(self.system(q, v), self.late)
        white, track = innovations(g, self.d, self.r, track=True)
        return g, white, track, smoother(g, white[..., 0])

    def dense(self, b):
        """Log density of what run b measures from step 1, all of it one normal vector."""
        G = np.tile(np.eye(n), (self.L, 1, 1)) if self.G is None else self.G[:, b]
        power = self.q[:n] + (self.start[b] if n < self.N else 0.0)
        first = self.first[b].copy()
        late = dict(zip(self.late.channel[b], self.late.weights[b], strict=True))
        for i, (now, _, kept) in late.items():
            first[i] += (1 - now) ** 2 / (1 - kept**2) * float(G[0][i] ** 2 @ power)
        variances = [*first, *self.start[b], *np.tile(self.q, self.L), *self.first[b]]
        sources = len(variances)
        shown = np.eye(n, sources, sources - n)  # what was shown at first is known by itself
        e = np.zeros((n, sources))
        e[:, :n] = np.eye(n)
        c = np.zeros((n, sources))
        if n < self.N:
            c[:, n : 2 * n] = np.eye(n)
        mean, at = self.r[0, b, :, 0] * self.seen[0, b], self.N
        mean_shown = mean.copy()
        rows, missed, noise = [], [], []
        for t in range(self.L):
            before, mean_before = e, mean
            w = np.zeros((n, sources))
            w[:, at : at + n] = np.eye(n)
            e = self.F[t, b] @ e + G[t] @ (c + w)
            mean = self.F[t, b] @ mean + self.d[t, b, :, 0]
            if n < self.N:
                c = self.phi * c
                c[:, at + n : at + 2 * n] += np.eye(n)
            at += self.N
            for i in range(n):
                w = late.get(i, (1.0, 0.0, 0.0))
                shown[i] = w @ np.array([e[i], before[i], shown[i]])
                mean_shown[i] = w @ np.array([mean[i], mean_before[i], mean_shown[i]])
                if self.seen[t + 1, b, i]:
                    rows.append(shown[i].copy())
                    missed.append(self.r[t + 1, b, i, 0] - mean_shown[i])
                    noise.append(self.v[i])
        H, nu = np.array(rows), np.array(missed)
        S = (H * np.array(variances)) @ H.T + np.diag(noise)
        return -0.5 * float(nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(S)[1])


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("case", CASES[2::2])
def test_the_likelihood_is_that_of_all_measurements_together(case, compiled, monkeypatch):
    problem = Problem(*case)
    if not compiled:
        monkeypatch.setattr(kernels, "available", lambda n, N: False)
    g, white, track, _ = problem.passes(problem.q, problem.v)
    found = -0.5 * ((white[..., 0] ** 2).sum(axis=(0, 2)) + g.logdet.sum(axis=0))
    assert found == pytest.approx([problem.dense(b) for b in range(B)], rel=1e-9)
    assert white.shape == problem.d.shape and track.shape == problem.r.shape


@pytest.mark.parametrize("case", CASES[3:])
def test_kernels_and_numpy_agree(case, monkeypatch):
    problem = Problem(*case)
    fast = problem.passes(problem.q, problem.v)
    monkeypatch.setattr(kernels, "available", lambda n, N: False)
    slow = problem.passes(problem.q, problem.v)
    for one, other in zip(fast[1:3], slow[1:3], strict=True):
        assert np.allclose(one, other, rtol=1e-8, atol=1e-8)
    for name in ("u", "D", "r", "N"):
        one, other = getattr(fast[3], name), getattr(slow[3], name)
        assert np.allclose(one, other, rtol=1e-8, atol=1e-8 * np.abs(other).max())


@pytest.mark.parametrize("case", CASES[3::3])
def test_smoother_gives_the_slope_of_the_likelihood(case):
    problem = Problem(*case, steps=40)
    back = problem.passes(problem.q, problem.v)[3]
    of_q = 0.5 * (problem.q * (back.r**2 - back.N))[1:].sum(axis=(0, 1))
    of_v = 0.5 * (problem.v * (back.u**2 - back.D)).sum(axis=(0, 1))

    def loglik(logs):
        Q = np.broadcast_to(problem.q, (problem.L, B, problem.N)).copy()
        Q[1:] *= np.exp(logs[: problem.N])  # the first step's is part of the start
        R = np.tile(problem.v, (problem.L + 1, B, 1))
        R[1:] *= np.exp(logs[problem.N :])
        g = gains(problem.system(Q, R), problem.late)
        white, _ = innovations(g, problem.d, problem.r)
        return -0.5 * float((white[..., 0] ** 2).sum() + g.logdet.sum())

    for at, slope in enumerate([*of_q, *of_v]):
        step = np.zeros(problem.N + n)
        step[at] = 1e-4
        assert slope == pytest.approx((loglik(step) - loglik(-step)) / 2e-4, rel=1e-4, abs=1e-3)


def hanging(late, trials=4, steps=200, dt=0.025):
    """Swings of a pole that hangs from a cart, its camera `late` steps late, by the model."""
    rng, found = np.random.default_rng(5), []
    for _ in range(trials):
        t, w, fine = np.arange(steps) * dt, rng.uniform(1.5, 5.0, 3), 5
        u = (2.0 * np.sin(np.outer(t, w) + rng.uniform(0, 6, 3))).sum(axis=1)[:, None]
        x = [np.array([0.0, np.pi, 0.0, 0.0])]
        for k in range(fine * steps):
            pushed = u[k // fine][None]
            after = cart_pole.system.step(x[-1][None], pushed, cart_pole.values, dt / fine)[0]
            x.append(after + [0, 0, 0.002, 0.003] * rng.standard_normal(4))
        log = np.array(x)
        log[:, [1, 3]] = np.stack([delayed(log[:, i], fine * late) for i in (1, 3)], axis=1)
        log = log[::fine] + [1e-3, 1e-3, 5e-3, 1e-2] * rng.standard_normal((steps + 1, 4))
        names = cart_pole.state_names, cart_pole.input_names
        found.append(Trial(log, u, dt, *names, start_inputs=np.zeros(1)))
    return found


def test_two_states_of_one_sensor_are_late_together_where_a_third_is_seen():
    trials, pair = hanging(0.0, trials=2, steps=60), "sensor_delay:theta+theta_vel"
    data = prepare(cart_pole, trials)
    assert pair in {e.name for e in knowable(data, Library().candidates(cart_pole, data.scales))}
    blind = [replace(t, states=t.states * [np.nan, 1, np.nan, 1]) for t in trials]
    data = prepare(cart_pole, blind)
    offered = {e.name for e in knowable(data, Library().candidates(cart_pole, data.scales))}
    assert "sensor_delay:theta" in offered and pair not in offered


def delayed(x, steps):
    at = np.maximum(np.arange(len(x)) - steps, 0.0)
    return np.interp(at, np.arange(len(x)), x)
