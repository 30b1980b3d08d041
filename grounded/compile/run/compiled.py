"""The fast path: the user's function as machine code.

Three modules, each made when it is first asked for: steps and Jacobians of many samples; rollouts
and sweeps about one layout of z (its delays); the sensitivities that a fit needs. Parameters, bias,
targets and weights are arguments: one compile serves every trial, every perturbed model, every fit.
What would take too long to compile is left to NumPy (`interpreted.py`).
"""

from __future__ import annotations

import copyreg
import ctypes
import hashlib
import struct
import threading
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded.checks import refused
from grounded.compile.kernel_words import (
    BATCH,
    COST,
    COUNT,
    DESCENT,
    FAILED_AT,
    LANES,
    MARCH,
    MAX_INPUTS,
    ROLLOUT,
    SWEEP,
    TURN,
    Layout,
)
from grounded.compile.names import Integrator, Signature, where
from grounded.compile.problem import (
    STATUSES,
    Backward,
    Controls,
    Descent,
    DescentOptions,
    Limits,
    Problem,
    Swarm,
)
from grounded.compile.run import jit
from grounded.compile.run.arguments import (
    address,
    packed,
    plain,
    run,
    side_by_side,
    table,
)
from grounded.compile.run.differenced import DifferencedSystem
from grounded.compile.run.interpreted import System
from grounded.compile.trace.graph import TooLong
from grounded.compile.trace.tracing import Trace, trace
from grounded.frozen import Array

Words = ctypes.c_int64 * len(BATCH)
RESULTS = BATCH[6:]
POINT = struct.Struct(f"=3q2dq{len(RESULTS)}q")  # the words of a batch
UNCOUNTED = 600  # operations of a model, or places of its Jacobian, of which no count is needed
MAX_COMPILED = 30_000  # operations that kernels are written with, about 7 s of compiling
MAX_STEPS = 4_000  # of a model alone, where its derivatives are too many
MAX_PLACES = 8_000  # of a Jacobian that a kernel keeps on its stack, 4 MB of it
AGREE = 1e-9  # a trace and its original, relative to the size of the state's values
FORMAT = 1  # raise when kernels change their words or their meaning


class Kernels:
    """The compiled modules of one trace, each made (or loaded) when it is first called."""

    def __init__(self, trace: Trace, system: CompiledSystem) -> None:
        self._about = trace, system.kind, system.integrator
        self._derivatives = system.derivatives
        graph = trace.graph.digest(trace.outputs)  # its derivatives follow from it
        n, m, k = trace.sizes
        self._key = (
            f"{FORMAT} {jit.writers()} {graph} {n} {m} {k} {system.kind} {system.integrator} "
            f"{system.derivatives}"
        )
        self._libraries: dict[Any, jit.Library] = {}
        self._lock = threading.RLock()

    def batch(self) -> jit.Library:
        """Step and, unless derivatives are left out, linearise, of many samples."""
        more = ("linearise", "jacobian") if self._derivatives else ()
        return self._library("batch", ("step", "march", *more))

    def search(self, layout: Layout) -> jit.Library:
        """Rollout and, for few enough inputs, sweep and descent; about a layout of z."""
        small = layout.m <= MAX_INPUTS and self._derivatives
        names = ("rollout", *(("sweep", "descent") if small else ()))
        return self._library(layout, names)

    def full(self) -> jit.Library:
        """Linearise with respect to the parameters as well."""
        return self._library("full", ("linearise",))

    def _library(self, key: Layout | str, names: Sequence[str]) -> jit.Library:
        known = self._libraries.get(key)
        if known is not None:
            return known
        with self._lock:
            if key not in self._libraries:
                digest = hashlib.sha256(f"{self._key} {key}".encode()).hexdigest()
                self._libraries[key] = jit.library(digest, lambda: self.text(key), names)
            return self._libraries[key]

    def text(self, which: Layout | str) -> str:
        """Write the LLVM code of a module; only what no cache holds is written."""
        from grounded.compile.emit.modules import module_text

        return module_text(*self._about, which, jit.lanes(), self._derivatives)


class CompiledSystem(System):
    """A traced function, compiled."""

    how = "compiled"
    derivatives = True

    def __init__(
        self, signature: Signature, first: Trace, integrator: Integrator, note: str = ""
    ) -> None:
        super().__init__(signature, integrator, note)
        self._traces = [first] if not first.guards else []
        self._kernels: dict[int, Kernels] = {}
        self._differenced = False  # whether derivatives by the parameters are too long to compile

    @property
    def operations(self) -> int:
        """Operations of the kernels where the model is large; 0 says it is small."""
        from grounded.compile.emit.modules import operations

        places = self.n * (self.n + self.m)
        large = [one for one in self._traces if max(len(one.graph.nodes), places) > UNCOUNTED]
        return max((operations(one, self.kind, self.integrator) for one in large), default=0)

    @cached_property
    def original(self) -> DifferencedSystem:
        """The function as it is."""
        return DifferencedSystem(self.signature, self.integrator)

    def evaluate(self, x: Array, u: Array, p: Array, dt: float, smoothing: float) -> Array:
        """See `System.evaluate`."""
        return self.original.evaluate(x, u, p, dt, smoothing)

    def trace(self, p: Array, dt: float) -> Trace:
        """The trace that holds for these parameters."""
        for known in self._traces:
            if known.holds(p, dt):
                return known
        found = trace(self.signature, np.asarray(p, float), dt)
        if isinstance(found, str):
            raise refused("model.untraced", why=found)
        self._traces.append(found)
        return found

    def reads(self, p: Array, dt: float) -> NDArray[np.bool_]:
        """See `System.reads`; by the graph."""
        return self.trace(p, dt).reads

    def check(self, x: Array, u: Array, p: Array, dt: float) -> None:
        """See `System.check`."""
        x, u = np.asarray(x, float), np.asarray(u, float)
        mine, theirs = self.step(x, u, p, dt), self.original.step(x, u, p, dt)
        scale = 1.0 + np.max(np.abs(theirs), axis=0, initial=0.0, where=np.isfinite(theirs))
        differ = ~np.isclose(mine, theirs, rtol=AGREE, atol=0.0, equal_nan=True)
        with np.errstate(all="ignore"):
            differ &= ~(np.abs(mine - theirs) <= AGREE * scale)
        if differ.any():
            t, i = np.argwhere(differ)[0]
            ours, own = float(mine[t, i]), float(theirs[t, i])
            name = self.signature.states[i]
            raise refused("model.differs", self.source, state=name, ours=ours, own=own)

    def _compiled(self, p: Array, dt: float) -> Kernels:
        found = self.trace(p, dt)
        kernels = self._kernels.get(id(found))
        if kernels is None:
            kernels = self._kernels.setdefault(id(found), Kernels(found, self))
        return kernels

    def step(self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0) -> Array:
        """See `System.step`."""
        out = np.empty((len(x), self.n))
        library = self._compiled(p, dt).batch()
        self._batch(library["step"], (x, u, p, dt, smoothing), {"out": out})
        return out

    def march(self, x: Array, u: Array, p: Array, dt: float | Array) -> Array:
        """Steps one after the other: x (N, n), u (T, N, m) -> states (T + 1, N, n).

        dt: the length of every step, or of each (T,).
        """
        steps, u, p = len(u), plain(u), plain(p)
        z = np.empty((steps + 1, *x.shape))
        z[0] = x
        lengths = plain(np.broadcast_to(dt, steps))
        each = lengths.tolist() if len(x) else []
        of_length, t = {h: self._compiled(p, h) for h in set(each)}, 0
        of_step = map(of_length.__getitem__, each)
        if len({*map(id, of_length.values())}) > 1:
            stretches = [(kernels, len(list(some))) for kernels, some in groupby(of_step)]
        else:
            stretches = [(kernels, steps) for kernels in [*of_length.values()][:1]]
        for kernels, count in stretches:
            at = {"x": z[t], "u": u[t], "p": p, "out": z[t + 1], "eps": 0.0}
            at |= {"N": len(x), "steps": count, "lengths": lengths[t:]}
            run(kernels.batch()["march"], table(MARCH, {}, at))
            t += count
        return z

    def linearise(
        self,
        x: Array,
        u: Array,
        p: Array,
        dt: float,
        smoothing: float = 0.0,
        limits: Limits | None = None,
    ) -> tuple[Array, Array]:
        """See `System.linearise`."""
        N, n = len(x), self.n
        f_x, f_u = np.zeros((N, n, n)), np.zeros((N, n, self.m))
        library = self._compiled(p, dt).batch()
        self._batch(library["linearise"], (x, u, p, dt, smoothing), {"f_x": f_x, "f_u": f_u})
        return f_x, f_u

    def sensitivities(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0
    ) -> tuple[Array, Array, Array]:
        """See `System.sensitivities`."""
        full = self._full(p, dt)
        if full is None:
            return super().sensitivities(x, u, p, dt, smoothing)
        N, n = len(x), self.n
        f_x, f_u, f_p = np.zeros((N, n, n)), np.zeros((N, n, self.m)), np.zeros((N, n, self.k))
        out = {"f_x": f_x, "f_u": f_u, "f_p": f_p}
        self._batch(full["linearise"], (x, u, p, dt, smoothing), out)
        return f_x, f_u, f_p

    def _full(self, p: Array, dt: float) -> jit.Library | None:
        """Derivatives by the parameters too; None where they are too many to compile."""
        if self.n * (self.n + self.m + self.k) > MAX_PLACES or self._differenced:
            return None
        try:
            return self._compiled(p, dt).full()
        except TooLong:
            self._differenced = True
            return None

    def _batch(
        self, kernel: Any, point: tuple[Array, Array, Array, float, float], out: dict[str, Array]
    ) -> None:
        x, u, p, dt, eps = point
        if len(x) == 0:
            return
        x, u, p = plain(x), plain(u), plain(p)
        results = [address(out[name]) if name in out else 0 for name in RESULTS]
        words = Words()
        POINT.pack_into(words, 0, address(x), address(u), address(p), dt, eps, len(x), *results)
        run(kernel, words)

    def runs(self, problem: Problem, by: Controls, alphas: Array) -> Swarm:
        """See `System.rollout`."""
        runs, H, nz = len(alphas), problem.horizon, problem.nz
        z, u, cost = np.empty((runs, H + 1, nz)), np.empty((runs, H, self.m)), np.empty(runs)
        known, lanes = packed(problem), np.empty(LANES)
        values = _policy(by) | {"alphas": lanes}
        kernel = self._search(problem)[0]["rollout"]
        for at in range(0, runs, LANES):
            some = min(LANES, runs - at)
            lanes[:some], lanes[some:] = alphas[at : at + some], alphas[at]
            values |= {"runs": some, "z": z[at:], "u": u[at:], "cost": cost[at:]}
            run(kernel, table(ROLLOUT, known.words, values))
        return Swarm(z, u, cost)

    def backward(self, problem: Problem, z: Array, u: Array, damping: Array) -> Backward:
        """See `System.backward`."""
        if self.m > MAX_INPUTS:
            return super().backward(problem, z, u, damping)
        H, nz = problem.horizon, problem.nz
        expected = np.zeros(2)
        k, K = np.empty((H, self.m)), np.empty((H, self.m, nz))
        values = {"z_run": plain(z), "u_run": plain(u), "damping": plain(damping)}
        values |= {"k": k, "K": K, "expected": expected}
        library, jacobian = self._search(problem)
        words = table(SWEEP, packed(problem).words | {"jacobian": jacobian}, values)
        failed = run(library["sweep"], words)
        if failed >= 0:
            k[: failed + 1], K[: failed + 1] = 0.0, 0.0
        elif not np.isfinite(K[0]).all():
            failed = 0
        return Backward(k, K, float(expected[0]), float(expected[1]), failed)

    def descend(self, problem: Problem, first: Controls, options: DescentOptions) -> Descent | None:
        """See `System.descend`."""
        if self.m > MAX_INPUTS:
            return None
        H, nz, m, known = problem.horizon, problem.nz, self.m, packed(problem).words
        most = max(int(options.max_iterations), 0)
        library, jacobian = self._search(problem)
        results, at = side_by_side(
            {"z0": (H + 1, nz), "z1": (H + 1, nz), "u0": (H, m), "u1": (H, m), "k": (H, m)}
            | {"K": (H, m, nz), "damping": (m,), "alphas": (LANES,), "costs": (LANES,)}
            | {"expected": (2,), "result": (4,), "lines": (most + 1, 4)}
        )
        results["alphas"][:] = 1.0
        run_0 = {"cost": at["costs"], "runs": 1, "z": at["z0"], "u": at["u0"]}
        policy = _policy(first)  # the arrays live as long as the kernel runs
        rollout = table(ROLLOUT, known, at | run_0 | policy)
        sweep = table(SWEEP, known | {"jacobian": jacobian}, at)
        values = at | {"rollout": ctypes.addressof(rollout), "sweep": ctypes.addressof(sweep)}
        values |= {"halvings": int(options.halvings), "max_iterations": most}
        settings = {"accept": float(options.accept), "tolerance": float(options.tolerance)}
        words = table(DESCENT, {}, values | settings | {"scale": plain(problem.input_scale)})
        status = STATUSES[run(library["descent"], words)]
        found = results["result"]
        z, u = ("z1", "u1") if found[TURN] else ("z0", "u0")
        lines = results["lines"][: int(found[COUNT])].copy()
        gains, cost = (results["k"], results["K"]), float(found[COST])
        return Descent(status, results[z], results[u], *gains, cost, int(found[FAILED_AT]), lines)

    def _search(self, problem: Problem) -> tuple[jit.Library, int]:
        """The kernels about a problem's layout, and the address of the Jacobian they call."""
        known = packed(problem)
        if self not in known.kernels:
            kernels = self._compiled(problem.p, problem.dt)
            search = kernels.search(known.layout)
            known.kernels[self] = search, kernels.batch().addresses.get("jacobian", 0)
        found: tuple[jit.Library, int] = known.kernels[self]
        return found


class CompiledSteps(CompiledSystem):
    """Steps and rollouts compiled, of which derivatives are differences: a large model's."""

    how = "compiled steps"
    derivatives = False

    linearise = System.linearise
    sensitivities = System.sensitivities
    backward = System.backward
    descend = System.descend


def _policy(by: Controls) -> dict[str, Any]:
    """Words of a policy: those that are not given are null."""
    given = by._asdict() | {"K": None if by.zbar is None else by.K}
    return {name: 0 if array is None else plain(array) for name, array in given.items()}


# --- which engine -------------------------------------------------------------------------------


def system_from(signature: Signature, integrator: Integrator, derivatives: bool = True) -> System:
    """The System of a function that is called so."""
    if signature.jacobian is not None:
        note = "not compiled: it is run as it is, with the derivatives that come with it"
        return DifferencedSystem(signature, integrator, note)
    found = trace(signature, None, 1.0)
    if isinstance(found, str):
        return DifferencedSystem(signature, integrator, f"not compiled, {found}")
    if not derivatives and len(found.graph.live(found.outputs)) <= MAX_STEPS:
        return CompiledSteps(signature, found, integrator, "")
    system, place = CompiledSystem(signature, found, integrator), where(signature.function)
    size = f"the derivatives of {system.n} states by {system.n + system.m} states and inputs"
    if system.n * (system.n + system.m) <= MAX_PLACES:
        try:
            if (operations := system.operations) <= MAX_COMPILED:
                return system
            size = f"{operations:,} operations of {system.n} states"
        except TooLong as error:
            size = str(error)
    slow = f"({place}): to compile {size} would take too long; it is planned with all the same"
    if len(found.graph.live(found.outputs)) > MAX_STEPS:
        return DifferencedSystem(signature, integrator, f"not compiled {slow}, more slowly")
    note = f"compiled but for its derivatives {slow}, more slowly"
    return CompiledSteps(signature, found, integrator, note)


def _again(system: System) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """In another process it is made again from the function: code and caches stay here."""
    return system_from, (system.signature, system.integrator)


for engine in (CompiledSteps, CompiledSystem, DifferencedSystem):
    copyreg.pickle(engine, _again)
