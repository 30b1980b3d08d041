"""JAX: the same DDP written with scans and jitted, 64 bit; a reference, not a package."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
from peer_data import fastest, load, reached, report, rk4

jax.config.update("jax_enable_x64", True)
case = load(jnp)
n, m = case.n, case.m
R, S = jnp.array(case.R), jnp.array(case.S)


def step(z, u):
    x = jnp.stack(rk4(case.rate, list(z[:n]), list(u), case.p, case.dt))
    return jnp.concatenate([x, u])


def stage(z, u, target, weight):
    return weight @ (z[:n] - target) ** 2 + R @ u**2 + S @ (u - z[n:]) ** 2


def total(z, u):
    return (
        jax.vmap(stage)(z[:-1], u, TARGET[:-1], WEIGHT[:-1]).sum()
        + WEIGHT[-1] @ (z[-1, :n] - TARGET[-1]) ** 2
    )


TARGET, WEIGHT = jnp.array(case.target), jnp.array(case.weight)


@jax.jit
def iterate(z, u):
    A, B = jax.vmap(jax.jacfwd(step, (0, 1)))(z[:-1], u)
    gradient = jax.vmap(jax.grad(stage, (0, 1)))(z[:-1], u, TARGET[:-1], WEIGHT[:-1])
    (l_zz, l_zu), (_, l_uu) = jax.vmap(jax.hessian(stage, (0, 1)))(
        z[:-1], u, TARGET[:-1], WEIGHT[:-1]
    )

    def back(value, now):
        v, V = value
        A, B, l_z, l_u, l_zz, l_zu, l_uu = now
        Q_z, Q_u = l_z + A.T @ v, l_u + B.T @ v
        Q_zz, Q_uu, Q_uz = l_zz + A.T @ V @ A, l_uu + B.T @ V @ B, l_zu.T + B.T @ V @ A
        both = -jax.scipy.linalg.solve(Q_uu, jnp.column_stack([Q_u, Q_uz]), assume_a="pos")
        k, K = both[:, 0], both[:, 1:]
        return (Q_z + Q_uz.T @ k, Q_zz + Q_uz.T @ K), (k, K)

    end = jnp.concatenate([2 * WEIGHT[-1] * (z[-1, :n] - TARGET[-1]), jnp.zeros(m)])
    end_V = jnp.diag(jnp.concatenate([2 * WEIGHT[-1], jnp.zeros(m)]))
    _, (k, K) = jax.lax.scan(back, (end, end_V), (A, B, *gradient, l_zz, l_zu, l_uu), reverse=True)

    def forward(now, data):
        zbar, ubar, k, K = data
        u = ubar + k + K @ (now - zbar)
        after = step(now, u)
        return after, (after, u)

    _, (after, u) = jax.lax.scan(forward, z[0], (z[:-1], u, k, K))
    z = jnp.concatenate([z[:1], after])
    return z, u, total(z, u)


def solve(iterations):
    z, u = jnp.array(case.z), jnp.array(case.u)
    for _ in range(iterations):
        z, u, cost = iterate(z, u)
    return float(cost)


started = time.process_time()
solve(1)
built = time.process_time() - started
iterations = 1
while not reached(case, cost := solve(iterations)) and iterations < 30:
    iterations += 1
report(
    peer="JAX, hand-written scan",
    version=jax.__version__,
    case=case.name,
    ms=1e3 * fastest(lambda: solve(iterations), 5),
    iterations=iterations,
    cost=cost,
    build_s=built,
)
