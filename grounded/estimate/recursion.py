"""The filter in NumPy, step by step: the reference, and the way where nothing can be compiled."""

from __future__ import annotations

import numpy as np

from grounded.estimate.batch import Batch
from grounded.estimate.filtered import Filtered
from grounded.estimate.measurement import Measurement, Noise
from grounded.estimate.steps import Advance
from grounded.frozen import Array


def recursion(batch: Batch, measurement: Measurement, noise: Noise, advance: Advance) -> Filtered:
    """One pass over a batch, linearising at each state that it reaches."""
    T, B, n, ny = len(batch.dt), len(batch.lengths), batch.start.shape[1], measurement.ny
    R = noise.measurement**2
    out = _room(T, B, n, ny)
    out["R"] = np.where(batch.seen, R, 1.0)
    x, P = batch.start, _start_covariance(batch, R)
    scale = np.where(batch.valid, batch.dt, 0.0)[..., None, None] * np.diag(
        noise.process**2 / noise.dt
    )
    eye, loglik = np.eye(n), 0.0
    with np.errstate(all="ignore"):
        for t in range(T + 1):
            seen = batch.seen[t]
            e = measurement.innovation(batch.y[t], measurement.function(x))
            e = np.where(seen, e, 0.0)
            H = measurement.jacobian(x) * seen[..., None]
            Ht, Rt = H.transpose(0, 2, 1), out["R"][t][..., None] * np.eye(ny)
            for name, value in (("x_prior", x), ("P_prior", P), ("e", e), ("H", H)):
                out[name][t] = value
            try:
                C = np.linalg.inv(np.linalg.cholesky(H @ P @ Ht + Rt))
            except np.linalg.LinAlgError:
                return _failed(out, t)
            K = P @ Ht @ C.transpose(0, 2, 1) @ C
            kept = eye - K @ H
            x = x + (K @ e[..., None])[..., 0]
            P = kept @ P @ kept.transpose(0, 2, 1) + K @ Rt @ K.transpose(0, 2, 1)
            out["x"][t], out["std"][t] = x, np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
            log_det = np.log(np.diagonal(C, axis1=-2, axis2=-1))[seen]
            loglik += float(log_det.sum() - 0.5 * np.sum((C @ e[..., None]) ** 2))
            if t == T:
                break
            f, A, more = advance(t, x, out["std"][t])
            if not (np.isfinite(f).all() and np.isfinite(A).all()):
                return _failed(out, t + 1)
            out["f"][t], out["A"][t], out["more"][t] = f, A, more
            x, P = f, A @ P @ A.transpose(0, 2, 1) + scale[t] + more[..., None] * eye
    loglik -= 0.5 * np.log(2 * np.pi) * batch.count
    return made(out, loglik if np.isfinite(loglik) else -np.inf, "filtered")


def made(out: dict[str, Array], loglik: float, status: str) -> Filtered:
    """A pass from its arrays (spelt out, so that the type checker sees each field)."""
    return Filtered(
        x=out["x"],
        std=out["std"],
        x_prior=out["x_prior"],
        P_prior=out["P_prior"],
        e=out["e"],
        H=out["H"],
        R=out["R"],
        A=out["A"],
        f=out["f"],
        more=out["more"],
        loglik=loglik,
        status=status,
    )


def _room(T: int, B: int, n: int, ny: int) -> dict[str, Array]:
    tails = {"x": (n,), "std": (n,), "x_prior": (n,), "P_prior": (n, n), "e": (ny,), "H": (ny, n)}
    room = {name: np.zeros((T + 1, B, *tail)) for name, tail in tails.items()}
    return room | {
        "A": np.zeros((T, B, n, n)),
        "f": np.zeros((T, B, n)),
        "more": np.zeros((T, B, n)),
    }


def _start_covariance(batch: Batch, R: Array) -> Array:
    channel = batch.start_channel
    var = batch.start_var + np.where(channel >= 0, R[np.maximum(channel, 0)], 0.0)
    return var[..., None] * np.eye(var.shape[1])


def _failed(out: dict[str, Array], t: int) -> Filtered:
    return made(out, -np.inf, f"the filter left the finite numbers at step {t}")
