"""The filter's likelihood has the slopes that the smoother says, compiled or not."""

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from grounded.diagnosis.likelihood.noise import (
    NoiseModel,
    Structure,
    average,
    climbed,
    likelihood_slopes,
    working,
)
from grounded.filter import kalman, kernels
from grounded.filter.augmented import Delayed, coloured
from grounded.filter.kalman import innovations, smoother
from grounded.filter.tempering import tempering
from stepped import slopes

L, B = 150, 2
# states, noise through G, colour, missing samples
CASES = [
    (2, False, None, False),
    (3, True, None, False),
    (3, True, 0.8, True),
    (6, False, 0.9, True),
]
# the same, late channels of each run, p of each (or a, b, c)
LATE = [
    (3, False, 0.8, True, [[0], [2]], [[0.4], [0.9]]),
    (3, True, 0.9, True, [[0, 2], [0, 1]], [[0.0, 0.7], [0.4, 0.4]]),
    (3, True, None, True, [[2, 1], [2, 1]], [[0.5, 0.2], [0.1, 0.3]]),
    (3, True, None, False, [[1], [1]], [[(0.2, 0.1, 0.7)], [(0.4, 0.3, 0.3)]]),
    (3, True, 0.9, True, [[0, 2], [0, 1]], [[(0.7, 0.3, 0.0), (0.2, 0.1, 0.7)]] * 2),
]


class Problem:
    """A random linear system with noise that may enter through G, be coloured, be missed.

    Some channels may be late by part of a step, or filtered.
    """

    def __init__(self, n, through, phi, missing, channel=None, part=(), steps=L):
        rng = np.random.default_rng(n)
        self.n, self.L, self.phi, self.late = n, steps, phi, None
        if channel is not None:
            weights = [
                [w if isinstance(w, tuple) else (1 - w, w, 0.0) for w in run] for run in part
            ]
            self.late = Delayed(np.array(channel), np.array(weights))
        self.F = 0.95 * np.eye(n) + 0.05 * rng.standard_normal((steps, B, n, n))
        self.G = None
        if through:
            self.G = np.tile(np.eye(n), (steps, B, 1, 1))
            self.G[:, :, n - 1, : n - 1] = 3 * rng.standard_normal((steps, B, n - 1))
        self.A = coloured(self.F, phi, self.G)
        self.N = self.A.shape[-1]
        self.seen = np.ones((steps + 1, B, n))
        if missing:
            self.seen[1:] = rng.random((steps, B, n)) > 0.2
            self.seen[-(steps // 15 + 1) :, 1] = 0.0
        self.d = 0.1 * rng.standard_normal((steps, B, n, 3))
        self.r = rng.standard_normal((steps + 1, B, n, 3))
        self.q = 0.1 * np.exp(rng.standard_normal(self.N))
        self.v = 0.1 * np.exp(rng.standard_normal(n))
        self.start = np.ones((B, self.N))
        self.start[:, :n] = self.v  # the start is given

    def passes(self, q, v):
        q = np.broadcast_to(q, (self.L, B, self.N))
        v = np.broadcast_to(v, (self.L + 1, B, self.n))
        system = kalman.LinearSystem(self.A, q, v, self.seen, self.start, self.G)
        g = kalman.gains(system, self.late)
        white, track = innovations(g, self.d, self.r, track=True)
        return g, white, track, smoother(g, white[..., 0])

    def loglik(self, q, v):
        g, white, *_ = self.passes(q, v)
        return -0.5 * float((white[..., 0] ** 2).sum() + g.logdet.sum())

    def dense(self, b):
        """What run b measures from step 1, as one normal vector of all sources of noise.

        Returns answers (samples, sources), their variances, the noise that each source is of (-1:
        the start), the channel of each sample, and what is measured beyond the mean.
        """
        n, N = self.n, self.N
        G = np.tile(np.eye(n), (self.L, 1, 1)) if self.G is None else self.G[:, b]
        first = self.start[b].copy()
        power = self.q[:n] + (self.start[b, n:] if n < N else 0.0)
        weights = {}
        if self.late is not None:
            weights = dict(zip(self.late.channel[b], self.late.weights[b], strict=True))
        for i, (now, _, kept) in weights.items():
            first[i] += (1 - now) ** 2 / (1 - kept**2) * float(G[0][i] ** 2 @ power)
        variances = np.array([*first, *np.tile(self.q, self.L), *self.v])
        kind = np.array([-1] * N + [*range(N)] * self.L + [-1] * n)
        sources = len(variances)
        shown = np.eye(n, sources, sources - n)  # what was shown at first is known by itself
        e, c = np.eye(n, sources), np.eye(n, sources, n) * (n < N)
        mean = self.r[0, b, :, 0] * self.seen[0, b]
        mean_shown, rows, missed, channel = mean.copy(), [], [], []
        for t in range(self.L):
            before, mean_before, at = e, mean, N * (t + 1)
            e = self.F[t, b] @ e + G[t] @ (c + np.eye(n, sources, at))
            mean = self.F[t, b] @ mean + self.d[t, b, :, 0]
            if n < N:
                c = self.phi * c + np.eye(n, sources, at + n)
            for i in range(n):
                w = weights.get(i, (1.0, 0.0, 0.0))
                shown[i] = w @ np.array([e[i], before[i], shown[i]])
                mean_shown[i] = w @ np.array([mean[i], mean_before[i], mean_shown[i]])
                if self.seen[t + 1, b, i]:
                    rows.append(shown[i].copy())
                    missed.append(self.r[t + 1, b, i, 0] - mean_shown[i])
                    channel.append(i)
        return np.array(rows), variances, kind, np.array(channel), np.array(missed)


@pytest.mark.parametrize("case", CASES)
def test_smoother_gives_the_slope_of_the_likelihood_after_many_steps(case, monkeypatch):
    problem = Problem(*case)
    for compiled in (True, False):
        if not compiled:
            monkeypatch.setattr(kernels, "available", lambda n, N: False)
        slopes_are_right(problem, 0)


@pytest.mark.parametrize("case", LATE[1::3])
def test_smoother_gives_the_slope_where_channels_are_late(case):
    slopes_are_right(Problem(*case, steps=40), 1)  # the first step's noise is part of the start


def slopes_are_right(problem, first):
    back = problem.passes(problem.q, problem.v)[3]
    of_q = 0.5 * (problem.q * (back.r**2 - back.N))[first:].sum(axis=(0, 1))
    of_v = 0.5 * (problem.v * (back.u**2 - back.D)).sum(axis=(0, 1))

    def loglik(logs):
        Q = np.tile(problem.q, (problem.L, B, 1))
        R = np.tile(problem.v, (problem.L + 1, B, 1))
        Q[first:] *= np.exp(logs[: problem.N])
        R[1:] *= np.exp(logs[problem.N :])
        return problem.loglik(Q, R)

    found = slopes(loglik, np.zeros(problem.N + problem.n), 1e-4)
    assert found == pytest.approx(np.array([*of_q, *of_v]), rel=1e-3, abs=0.01)


@pytest.mark.parametrize("case", [*CASES, *((*case, 12) for case in LATE[1:])])
def test_kernels_and_numpy_agree(case, monkeypatch):
    problem = Problem(*case)
    fast = problem.passes(problem.q, problem.v)
    monkeypatch.setattr(kernels, "available", lambda n, N: False)
    slow = problem.passes(problem.q, problem.v)
    for name in ("k", "weight", "logdet"):
        assert np.allclose(getattr(fast[0], name), getattr(slow[0], name), rtol=1e-9, atol=1e-11)
    for one, other in zip(fast[1:3], slow[1:3], strict=True):
        assert np.allclose(one, other, rtol=1e-8, atol=1e-8)
    for name in ("u", "D", "r", "N"):
        one, other = getattr(fast[3], name), getattr(slow[3], name)
        assert np.allclose(one, other, rtol=1e-8, atol=1e-8 * np.abs(other).max())


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("case", [*CASES[:3], *LATE[::2]])
def test_the_likelihood_is_that_of_all_measurements_together(case, compiled, monkeypatch):
    problem = Problem(*case[:4], *(case[4:] or (None, ())), steps=12)
    if not compiled:
        monkeypatch.setattr(kernels, "available", lambda n, N: False)
    g, white, *_ = problem.passes(problem.q, problem.v)
    found = -0.5 * ((white[..., 0] ** 2).sum(axis=(0, 2)) + g.logdet.sum(axis=0))
    for b in range(B):
        H, variances, _, channel, nu = problem.dense(b)
        S = (H * variances) @ H.T + np.diag(problem.v[channel])
        expected = -0.5 * float(nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(S)[1])
        assert found[b] == pytest.approx(expected, rel=1e-9)


def test_a_covariance_that_is_not_finite_is_an_error():
    problem = Problem(2, False, None, False)
    problem.A[3] = np.nan
    with pytest.raises(np.linalg.LinAlgError):
        problem.passes(problem.q, problem.v)


def noise_of(problem, phi, dt=0.05):
    tau = None if phi is None else -dt / np.log(phi)
    n, q = problem.n, np.log(problem.q)
    log_c = q[n:] - np.log(1 - phi**2) if phi else np.zeros(n)
    return NoiseModel(Structure(tau), q[:n], np.log(problem.v), log_c, np.full(n, -30.0))


def information(problem, noise, dt=0.05):
    g, _, _, back = problem.passes(noise.process(dt), np.exp(noise.log_r))
    columns = problem.n * (3 if noise.structure.tau else 2)
    d, r = (np.zeros((T, B, problem.n, columns)) for T in (L, L + 1))
    working(noise, back, problem.G, dt, (d, r))
    return average(innovations(g, d, r)[0]), back


@pytest.mark.parametrize("case", CASES[:3])
def test_average_information_is_that_of_the_dense_covariance(case):
    problem = Problem(*case)
    found, _ = information(problem, noise_of(problem, case[2]))
    expected, n = 0.0, problem.n
    for b in range(B):
        H, variances, kind, channel, y = problem.dense(b)
        whole = (H * variances) @ H.T + np.diag(problem.v[channel])
        parts = [(H * (variances * (kind == i))) @ H.T for i in range(problem.N)]
        parts[n:n] = [np.diag(problem.v[i] * (channel == i)) for i in range(n)]
        weighed = np.linalg.solve(whole, y)
        answers = np.stack([part @ weighed for part in parts])
        expected = expected + 0.5 * answers @ np.linalg.solve(whole, answers.T)
    assert np.allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_noise_climbs_to_the_top_though_channels_share_it():
    problem = Problem(3, True, None, False)
    noise = noise_of(problem, None)
    for _ in range(12):
        info, back = information(problem, noise)
        noise = climbed(noise, likelihood_slopes(noise, back, 0.05), info, L * B)
    rest = likelihood_slopes(noise, information(problem, noise)[1], 0.05)
    assert np.abs(rest).max() < 0.01
    before = problem.loglik(problem.q, problem.v)
    assert problem.loglik(np.exp(noise.log_q), np.exp(noise.log_r)) > before


def test_kernels_that_another_version_of_us_wrote_are_not_used(monkeypatch):
    read, version = Path.read_bytes, kernels._version.__wrapped__
    before = version()
    monkeypatch.setattr(Path, "read_bytes", lambda p: read(p) + b"#" * (p.name == "kernels.py"))
    assert version() != before


@pytest.mark.parametrize("compiled", [True, False])
def test_the_covariance_of_an_unstable_plant_stays_symmetric_and_settles(compiled, monkeypatch):
    from scipy.linalg import solve_discrete_are

    if not compiled:
        monkeypatch.setattr(kernels, "available", lambda n, N: False)
    T, A = 400, np.array([[1.34, 0.3, 0.0], [0.02, 0.9, 0.4], [0.1, 0.0, 1.2]])
    Q, R, H = np.array([1e-6, 1e-4, 1e-5]), np.array([1e-3, 1e-4]), np.eye(2, 3)
    seen, start = np.ones((T + 1, 1, 2)), np.full((1, 3), 1e4)
    system = kalman.LinearSystem(np.tile(A, (T, 1, 1, 1)), Q, R, seen, start)
    g = kalman.gains(system, covariances=True)
    assert np.array_equal(g.P, g.P.swapaxes(-1, -2))
    exact = solve_discrete_are(A.T, H.T, np.diag(Q), np.diag(R))
    assert np.allclose(g.P[-1, 0], exact, rtol=1e-8)
    assert np.abs(smoother(g, np.ones((T, 1, 2))).N).max() < 1e9


def test_nats_of_correlated_innovations_are_worth_as_many_as_are_news():
    rng, T = np.random.default_rng(5), 4000
    white, seen = rng.standard_normal((T, 2, 2)), np.ones((T, 2, 2))
    found = tempering(white, seen)
    assert 0.9 < found.factor <= 1 and type(found.factor) is float
    coloured_ = white.copy()
    for t in range(1, T):
        coloured_[t] = 0.8 * coloured_[t - 1] + 0.6 * white[t]
    assert tempering(coloured_, seen).factor == pytest.approx(0.2 / 1.8, rel=0.25)
    assert tempering(3 * white, seen).factor == pytest.approx(1 / 9, rel=0.1)
    seen[: T // 2, :, 0] = 0.0
    assert tempering(np.where(seen > 0, coloured_, 99.0), seen).factor < 0.2


def test_threads_that_ask_at_once_get_one_library(monkeypatch):
    """Of two, one would be freed while its code runs."""
    made = []

    def slowly(key, write, names):
        time.sleep(0.05)
        made.append(key)
        return object()

    monkeypatch.setattr(kernels.jit, "library", slowly)
    kernels._made.cache_clear()
    try:
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(lambda _: kernels._library(3, 5, False), range(4)))
    finally:
        kernels._made.cache_clear()
    assert len(made) == 1
    assert all(one is found[0] for one in found)


def test_tempering_changes_little_where_a_correlation_passes_its_threshold():
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((401, 1, 1))
    shape = np.convolve(rng.standard_normal(460), np.ones(60) / 8, "valid")[:401, None, None]
    seen = np.ones_like(noise)
    found = [tempering(shape + k * noise, seen).factor for k in np.linspace(0.0, 3.0, 3001)]
    steps = np.abs(np.diff(np.log(found)))
    assert min(found) < 0.05 and max(found) > 0.2 and steps.max() < 0.03
