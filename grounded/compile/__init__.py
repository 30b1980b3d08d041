"""From a few lines of NumPy to numbers: trace, differentiate, compile; or difference.

`system_of` is the door: it returns the fastest path that a user's function allows, and the paths
agree, so that nobody above needs to know which one it was.

Read `problem` first (what is solved), then the rooms in the order in which a function passes
through them: `trace` (run once on expressions, differentiated), `emit` (written as LLVM IR), `run`
(the engines). `names` hands arrays to the function by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from grounded.compile.names import Integrator, Kind, Named, Signature

if TYPE_CHECKING:
    from grounded.compile.run.interpreted import System

__all__ = ["Kind", "Named", "Signature", "system_of"]


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
    from grounded.compile.run.compiled import system_from  # slow, and all that is above may not ask

    signature = Signature(function, kind, tuple(states), tuple(inputs), tuple(params))
    if substeps > 1:
        signature = signature.whole(integrator, substeps)
    return system_from(replace(signature, jacobian=jacobian), integrator, derivatives)
