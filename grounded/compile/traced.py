"""The path between: the user's function as a graph, run by NumPy, with exact derivatives.

It needs no compiler, vectorises over samples even where the function itself can't, and is the
twin against which the compiled kernels are tested. The derivative of an integration step follows
the stages of Runge-Kutta: with k_i = f(x_i), x_i = x + c_i dt k_{i-1}, T_i = d x_i / d (x, u, p),

    K_i = f_x(x_i) T_i + [0 f_u f_p],    T_{i+1} = [I 0 0] + c_{i+1} dt K_i,
    d x' / d (x, u, p) = [I 0 0] + dt sum_i b_i K_i.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from grounded.compile.derivative import jacobian
from grounded.compile.graph import Program
from grounded.compile.interpreted import Integrator, Interpreted
from grounded.compile.names import where
from grounded.compile.problem import Array
from grounded.compile.python import DifferencedSystem
from grounded.compile.tracing import Signature, Trace, leaves_of, trace
from grounded.errors import GroundedError

STAGES: dict[str, tuple[tuple[float, float], ...]] = {  # (c, b): where and with what weight
    "rk4": ((0.0, 1 / 6), (0.5, 1 / 3), (0.5, 1 / 3), (1.0, 1 / 6)),
    "euler": ((0.0, 1.0),),
}
CHUNK = 1024  # samples at once
AGREE = 1e-9  # a trace and its original, relative to the size of the state's values


class Variant:
    """One trace; its derivatives and the programs made of them, when they are asked for."""

    def __init__(self, found: Trace, sizes: tuple[int, int, int]) -> None:
        self.trace, self.sizes = found, sizes
        self.values = Program(found.graph, found.outputs)

    def entries(self, width: int) -> list[tuple[int, int, int]]:
        """(row, column, node) of the non-zero derivatives by the first `width` of x, u, p."""
        graph = self.trace.graph
        letters = [
            (letter, i) for letter, size in zip("xup", self.sizes, strict=True) for i in range(size)
        ]
        variables = [graph.leaf(*letter) for letter in letters[:width]]
        column = {v: c for c, v in enumerate(variables)}
        rows = jacobian(graph, self.trace.outputs, variables)
        return sorted((r, column[v], i) for r, row in enumerate(rows) for v, i in row.items())

    @cached_property
    def small(self) -> tuple[Program, list[tuple[int, int]]]:
        """Values and derivatives by state and input."""
        return self._program(self.sizes[0] + self.sizes[1])

    @cached_property
    def full(self) -> tuple[Program, list[tuple[int, int]]]:
        """Values and derivatives by state, input and parameter."""
        return self._program(sum(self.sizes))

    def operations(self) -> int:
        """Nodes of the values and of their derivatives by state and input."""
        entries = self.entries(self.sizes[0] + self.sizes[1])
        return len(self.trace.graph.live([*self.trace.outputs, *(i for _, _, i in entries)]))

    def _program(self, width: int) -> tuple[Program, list[tuple[int, int]]]:
        entries = self.entries(width)
        outputs = [*self.trace.outputs, *(i for _, _, i in entries)]
        return Program(self.trace.graph, outputs), [(r, c) for r, c, _ in entries]


class TracedSystem(Interpreted):
    """A traced function, interpreted."""

    how = "traced"

    def __init__(
        self, signature: Signature, first: Trace, integrator: Integrator, note: str
    ) -> None:
        sizes = (len(signature.states), len(signature.inputs), len(signature.params))
        super().__init__(signature.kind, integrator, sizes, note)
        self.signature, self.source = signature, where(signature.function)
        self.states = signature.states
        self.original = DifferencedSystem(
            signature.function,
            kind=signature.kind,
            states=signature.states,
            inputs=signature.inputs,
            params=signature.params,
            integrator=integrator,
        )
        self._variants = [Variant(first, sizes)] if not first.guards else []

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
            raise GroundedError(f"{found}; with these parameters only; use np.where")
        self._variants.append(Variant(found, (self.n, self.m, self.k)))
        return self._variants[-1]

    def evaluate(self, x: Array, u: Array, p: Array, dt: float, smoothing: float) -> Array:
        """The graph at N samples."""
        values = self.variant(p, dt).values(leaves_of(x, u, p, dt), smoothing)
        return np.stack([np.broadcast_to(v, len(x)) for v in values], axis=1)

    def linearise(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0
    ) -> tuple[Array, Array]:
        """f_x and f_u, exact."""
        J = self._derivatives(x, u, p, dt, smoothing, False)
        return np.ascontiguousarray(J[:, :, : self.n]), np.ascontiguousarray(J[:, :, self.n :])

    def sensitivities(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0
    ) -> tuple[Array, Array, Array]:
        """f_x, f_u and f_p, exact."""
        J = self._derivatives(x, u, p, dt, smoothing, True)
        ends = (self.n, self.n + self.m)
        f_x, f_u, f_p = np.split(J, ends, axis=2)
        return np.ascontiguousarray(f_x), np.ascontiguousarray(f_u), np.ascontiguousarray(f_p)

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
            raise GroundedError(
                f"{where(self.signature.function)}: the traced model differs from the function: "
                f"at sample {t}, state '{self.signature.states[i]}', the trace gives "
                f"{mine[t, i]!r} and the function {theirs[t, i]!r}. Does it use random numbers, "
                "keep a memory, or look at the type of its arguments?"
            )

    def _derivatives(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float, full: bool
    ) -> Array:
        width = self.n + self.m + (self.k if full else 0)
        J = np.empty((len(x), self.n, width))
        variant = self.variant(p, dt)
        program = variant.full if full else variant.small
        for at in range(0, len(x), CHUNK):
            some = slice(at, at + CHUNK)
            with np.errstate(all="ignore"):
                J[some] = self._chain(program, x[some], u[some], p, dt, smoothing, width)
        return J

    def _chain(
        self,
        program: tuple[Program, list[tuple[int, int]]],
        x: Array,
        u: Array,
        p: Array,
        dt: float,
        smoothing: float,
        width: int,
    ) -> Array:
        if self.kind == "step":
            return values_and_jacobian(program, leaves_of(x, u, p, dt), smoothing, len(x), width)[1]
        identity = np.eye(self.n, width)
        k, K = np.zeros_like(x), np.zeros((len(x), self.n, width))
        total = np.zeros_like(K)
        for c, b in STAGES[self.integrator]:
            leaves = leaves_of(x + c * dt * k, u, p, dt)
            k, K_own = values_and_jacobian(program, leaves, smoothing, len(x), width)
            T = identity + c * dt * K
            K = K_own[:, :, : self.n] @ T
            K[:, :, self.n :] += K_own[:, :, self.n :]
            total = total + b * K
        return np.asarray(identity + dt * total)


def values_and_jacobian(
    program: tuple[Program, list[tuple[int, int]]],
    leaves: Mapping[tuple[str, int], Any],
    smoothing: float,
    N: int,
    width: int,
) -> tuple[Array, Array]:
    """The r outputs (N, r) and their Jacobian (N, r, width) at N samples."""
    run, places = program
    found = run(leaves, smoothing)
    values = found[: len(found) - len(places)]
    J = np.zeros((N, len(values), width))
    for (r, c), value in zip(places, found[len(values) :], strict=True):
        J[:, r, c] = value
    return np.stack([np.broadcast_to(v, N) for v in values], axis=1), J
