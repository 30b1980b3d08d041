"""The path between: the user's function as a graph, run by NumPy, with exact derivatives.

It needs no compiler, vectorises over samples even where the function itself can't, and is the
twin against which the compiled kernels are tested. The derivative of an integration step follows
the stages of Runge-Kutta: with k_i = f(x_i), x_i = x + c_i dt k_{i-1}, T_i = d x_i / d (x, u, p),

    K_i = f_x(x_i) T_i + [0 f_u f_p],    T_{i+1} = [I 0 0] + c_{i+1} dt K_i,
    d x' / d (x, u, p) = [I 0 0] + dt sum_i b_i K_i.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from grounded.checks import refused
from grounded.compile.names import Signature
from grounded.compile.problem import STAGES, Integrator, Samples
from grounded.compile.run.differenced import DifferencedSystem
from grounded.compile.run.interpreted import Interpreted
from grounded.compile.trace.graph import TooLong
from grounded.compile.trace.tracing import Trace, Variant, trace
from grounded.frozen import Array

CHUNK = 1024  # samples at once
AGREE = 1e-9  # a trace and its original, relative to the size of the state's values


class TracedSystem(Interpreted):
    """A traced function, interpreted."""

    how = "traced"

    def __init__(
        self, signature: Signature, first: Trace, integrator: Integrator, note: str
    ) -> None:
        super().__init__(signature, integrator, note)
        self._variants = [Variant(first, self.sizes)] if not first.guards else []
        self._too_long = set[int]()  # widths of derivatives that are differenced

    @cached_property
    def original(self) -> Interpreted:
        """The function as it is."""
        return DifferencedSystem(self.signature, self.integrator)

    def variant(self, p: Array, dt: float) -> Variant:
        """The trace that holds for these parameters.

        Raises:
            GroundedError: when the branch they take can't be traced.
        """
        for known in self._variants:
            if known.trace.holds(p, dt):
                return known
        found = trace(self.signature, np.asarray(p, float), dt)
        if isinstance(found, str):
            raise refused("model.untraced", why=found)
        self._variants.append(Variant(found, self.sizes))
        return self._variants[-1]

    def reads(self, p: Array, dt: float) -> NDArray[np.bool_]:
        """See `System.reads`; by the graph."""
        return self.variant(p, dt).reads

    def evaluate(self, x: Array, u: Array, p: Array, dt: float, smoothing: float) -> Array:
        """The graph at N samples."""
        return self.variant(p, dt).values(x, u, p, dt, smoothing)

    def check(self, x: Array, u: Array, p: Array, dt: float) -> None:
        """See `System.check`."""
        x, u = np.asarray(x, float), np.asarray(u, float)
        with np.errstate(all="ignore"):
            mine = self.evaluate(x, u, p, dt, 0.0)
            theirs = self.original.evaluate(x, u, p, dt, 0.0)
        scale = 1.0 + np.max(np.abs(theirs), axis=0, initial=0.0, where=np.isfinite(theirs))
        differ = ~np.isclose(mine, theirs, rtol=AGREE, atol=0.0, equal_nan=True)
        differ &= ~(np.abs(mine - theirs) <= AGREE * scale)
        if differ.any():
            t, i = np.argwhere(differ)[0]
            ours, own = float(mine[t, i]), float(theirs[t, i])
            name = self.signature.states[i]
            raise refused("model.differs", self.source, state=name, ours=ours, own=own)

    def jacobian(self, at: Samples, width: int) -> Array:
        """See `Interpreted.jacobian`; exact, or differences where that is too long."""
        x, u, p, dt, smoothing, _ = at
        J = np.empty((len(x), self.n, width))
        try:
            for first in range(0, len(x) if width not in self._too_long else 0, CHUNK):
                some = slice(first, first + CHUNK)
                with np.errstate(all="ignore"):
                    J[some] = self._chain(x[some], u[some], p, dt, smoothing, width)
        except TooLong:
            self._too_long.add(width)
        return self.differences(at, width) if width in self._too_long else J

    def _chain(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float, width: int
    ) -> Array:
        variant = self.variant(p, dt)
        if self.kind == "step":
            return variant.linearised(x, u, p, dt, smoothing, width)[1]
        identity = np.eye(self.n, width)
        k, K = np.zeros_like(x), np.zeros((len(x), self.n, width))
        total = np.zeros_like(K)
        for c, b in STAGES[self.integrator]:
            k, own = variant.linearised(x + c * dt * k, u, p, dt, smoothing, width)
            T = identity + c * dt * K
            K = own[:, :, : self.n] @ T
            K[:, :, self.n :] += own[:, :, self.n :]
            total = total + b * K
        return np.asarray(identity + dt * total)
