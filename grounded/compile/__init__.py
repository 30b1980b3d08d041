"""From a few lines of NumPy to numbers: trace, differentiate, compile; or difference.

`system_of` is the door: it returns the fastest path that a user's function allows, and the paths
agree, so that nobody above needs to know which one it was.

Read `problem` first (what is solved, and what an engine must answer), then the rooms in the order
in which a function passes through them: `trace` (run once on expressions, differentiated), `emit`
(written as LLVM IR), `run` (the three engines). `names` hands arrays to the function by name.
"""

from __future__ import annotations

import copyreg
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from grounded.compile.names import Named, where
from grounded.compile.problem import (
    Backward,
    Descent,
    DescentOptions,
    Integrator,
    Kind,
    Problem,
    Status,
    Swarm,
    System,
    deepest,
)
from grounded.compile.run.compiled import MAX_PLACES, CompiledSteps, CompiledSystem
from grounded.compile.run.differenced import DifferencedSystem
from grounded.compile.run.interpreted import Interpreted
from grounded.compile.run.traced import TracedSystem
from grounded.compile.trace.graph import TooLong
from grounded.compile.trace.tracing import Signature, trace

__all__ = [
    "Backward",
    "Descent",
    "DescentOptions",
    "Named",
    "Problem",
    "Status",
    "Swarm",
    "System",
    "deepest",
    "system_of",
]
MAX_COMPILED = 30_000  # operations that kernels are written with, about 7 s of compiling
MAX_STEPS = 4_000  # of a model alone, where its derivatives are too many


def system_of(
    function: Callable[..., Mapping[str, Any]],
    *,
    kind: Kind,
    states: Sequence[str],
    inputs: Sequence[str],
    params: Sequence[str],
    integrator: Integrator = "rk4",
    substeps: int = 1,
    jacobian: Callable[..., tuple[Any, Any]] | None = None,
    derivatives: bool = True,
) -> System:
    """The System of a user's function.

    Args:
        function: f(s, a, p) -> ds/dt, or f(s, a, p, dt) -> next state, dicts of state names.
        kind: "derivative" or "step".
        states: names in array order; likewise `inputs` and `params`.
        inputs: see `states`.
        params: see `states`.
        integrator: "rk4" or "euler", for a derivative.
        substeps: steps of the integrator within a control step, for a derivative.
        jacobian: f(s, a, p, dt) -> f_x (n, n), f_u (n, m) of a step; None: by the fastest path.
        derivatives: whether they are asked for often: else they are not compiled.

    Raises:
        GroundedError: if the function can't be a model of these names, naming its file and line.
    """
    signature = Signature(function, kind, tuple(states), tuple(inputs), tuple(params))
    if kind == "derivative" and substeps > 1:
        signature = replace(signature, kind="step", within=(integrator, substeps))
    return system_from(replace(signature, jacobian=jacobian), integrator, derivatives)


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
        return TracedSystem(signature, found, integrator, f"not compiled {slow}, more slowly")
    note = f"compiled but for its derivatives {slow}, more slowly"
    return CompiledSteps(signature, found, integrator, note)


def _again(system: Interpreted) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """In another process it is made again from the function: code and caches stay here."""
    return system_from, (system.signature, system.integrator)


for engine in (CompiledSteps, CompiledSystem, DifferencedSystem, TracedSystem):
    copyreg.pickle(engine, _again)
