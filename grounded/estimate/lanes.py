"""Batches in the layout of the compiled recursions, and calls of those.

[group][time][entry][lane]: W trials side by side in a group, the last trial repeated to fill it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded.estimate import kernel
from grounded.estimate.batch import Batch
from grounded.estimate.measurement import Noise
from grounded.frozen import Array


def usable(T: int, n: int, ny: int) -> bool:
    """Whether the compiled recursions can run here, for these sizes."""
    from grounded.compile.run import jit

    return T > 0 and 0 < n <= kernel.LARGEST and 0 < ny <= kernel.LARGEST and not jit.trouble()


def pack(array: Array, width: int) -> Array:
    """(T, B, ...) to (G, T, size, W)."""
    T, B = array.shape[:2]
    flat = array.reshape(T, B, -1)
    missing = -B % width
    if missing:
        flat = np.concatenate([flat, np.repeat(flat[:, -1:], missing, axis=1)], axis=1)
    lanes = flat.reshape(T, -1, width, flat.shape[2]).transpose(1, 0, 3, 2)
    return np.ascontiguousarray(lanes)


def unpack(array: Array, B: int, *tail: int) -> Array:
    """(G, T, size, W) to (T, B, *tail)."""
    G, T, size, width = array.shape
    flat = array.transpose(1, 0, 3, 2).reshape(T, G * width, size)[:, :B]
    return np.ascontiguousarray(flat).reshape(T, B, *tail)


@dataclass(frozen=True, eq=False)
class Linearised:
    """A linearisation in lanes: f + A (x - track), h + H (x - xbar), and the batch's own arrays."""

    arrays: dict[str, Array]
    seen: NDArray[np.bool_]  # (G, T + 1, ny, W)
    dt: Array  # (G, T, 1, W), zero where not valid
    start_var: Array  # (G, n, W)
    start_channel: NDArray[np.int64]  # (G, n, W)
    weight: Array  # (G, 1, 1, W) 1 for a trial, 0 for a lane that only fills
    B: int

    @property
    def sizes(self) -> tuple[int, int, int, int, int]:
        """G, T, n, ny, W."""
        G, T, n, width = self.arrays["f"].shape
        return G, T, n, self.arrays["e0"].shape[2], width


@dataclass(frozen=True, eq=False)
class Pass:
    """What a forward pass leaves, in lanes."""

    linearised: Linearised
    out: dict[str, Array]
    r: Array  # (G, T + 1, ny, W) variance of the measurements, 1 where not seen
    loglik: float


def linearised(
    batch: Batch, A: Array, f: Array, more: Array, track: Array, H: Array, e0: Array, xbar: Array
) -> Linearised:
    """Packs a linearisation along a track.

    Args:
        batch: the records.
        A: (T, B, n, n), likewise f and track (T, B, n).
        f: what the model predicts from the track.
        more: variance added to the process noise (T, B, n).
        track: filtered states about which A holds.
        H: (T + 1, B, ny, n), rows of channels that were not seen are zero.
        e0: y - h(xbar), (T + 1, B, ny), zero where not seen.
        xbar: predicted states about which H holds, (T + 1, B, n).
    """
    from grounded.compile.run import jit

    width, B = jit.lanes(), len(batch.lengths)
    given = {"A": A, "f": f, "more": more, "track": track, "H": H, "e0": e0, "xbar": xbar}
    arrays = {name: pack(value, width) for name, value in given.items()}
    arrays["x0"] = pack(batch.start[None], width)[:, 0]
    dt = np.where(batch.valid, batch.dt, 0.0)[..., None]
    filled = np.arange(len(arrays["x0"]) * width) < B
    return Linearised(
        arrays=arrays,
        seen=pack(batch.seen.astype(float), width) > 0,
        dt=pack(dt, width),
        start_var=pack(batch.start_var[None], width)[:, 0],
        start_channel=pack(batch.start_channel[None].astype(float), width)[:, 0].astype(np.int64),
        weight=filled.astype(float).reshape(-1, 1, 1, width),
        B=B,
    )


def forward(lin: Linearised, noise: Noise) -> Pass:
    """The filter along a linearisation."""
    from grounded.compile.run.compiled import call

    G, T, n, ny, width = lin.sizes
    R = noise.measurement**2
    r = np.where(lin.seen, R[:, None], 1.0)
    q = lin.dt * (noise.process**2 / noise.dt)[:, None] + lin.arrays["more"]
    channel = lin.start_channel
    P0 = lin.start_var + np.where(channel >= 0, R[np.maximum(channel, 0)], 0.0)
    shapes = {"x": n, "x_prior": n, "P_prior": n * n, "e": ny, "s": ny, "g": ny * n}
    out = {name: np.empty((G, T + 1, size, width)) for name, size in shapes.items()}
    given: dict[str, Any] = {"G": G, "T": T, "q": np.ascontiguousarray(q), "r": r, "P0": P0}
    call(kernel.library(n, ny)["forward"], kernel.FORWARD, given | lin.arrays | out)
    with np.errstate(all="ignore"):
        each = np.where(lin.seen, out["e"] ** 2 / out["s"] + np.log(2 * np.pi * out["s"]), 0.0)
        total = -0.5 * float(np.sum(each * lin.weight))
    return Pass(lin, out, r, total if np.isfinite(total) else -np.inf)


def posterior_std(done: Pass) -> Array:
    """Standard deviations of the filtered states (G, T + 1, n, W)."""
    _, _, n, ny, _ = done.linearised.sizes
    variance = done.out["P_prior"][:, :, :: n + 1].copy()
    for c in range(ny):
        gain = done.out["g"][:, :, c * n : (c + 1) * n]
        variance -= gain**2 * done.out["s"][:, :, c : c + 1]
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def backward(done: Pass) -> dict[str, Array]:
    """The smoother: `ry` (G, T+1, n, W), `Ny` (G, T+1, n n, W), `r_slope` (G, T+1, ny, W)."""
    from grounded.compile.run.compiled import call

    lin = done.linearised
    G, T, n, ny, width = lin.sizes
    shapes = {"ry": n, "Ny": n * n, "r_slope": ny}
    out = {name: np.empty((G, T + 1, size, width)) for name, size in shapes.items()}
    given: dict[str, Any] = {"G": G, "T": T, "A": lin.arrays["A"], "H": lin.arrays["H"]}
    given |= {name: done.out[name] for name in ("e", "s", "g")}
    call(kernel.library(n, ny)["backward"], kernel.BACKWARD, given | out)
    return out


def variance_slopes(done: Pass, noise: Noise) -> Array:
    """Slope of the log-likelihood by the log variances of process and measurements, (n + ny,)."""
    back, lin = backward(done), done.linearised
    _, _, n, ny, _ = lin.sizes
    diagonal = back["Ny"][:, :, :: n + 1]
    half = 0.5 * (back["ry"] ** 2 - diagonal) * lin.weight
    by_q = np.sum(half[:, 1:] * lin.dt, axis=(0, 1, 3)) / noise.dt
    by_r = np.sum(np.where(lin.seen, back["r_slope"], 0.0) * lin.weight, axis=(0, 1, 3))
    for c in range(ny):
        by_r[c] += half[:, 0][lin.start_channel == c].sum()
    return np.concatenate([by_q * noise.process**2, by_r * noise.measurement**2])
