"""The modules that are compiled: which kernels lie together, and how their text is put together."""

from __future__ import annotations

from grounded.compile.emit.llvm_batch import linearise_kernel, march_kernel, step_kernel
from grounded.compile.emit.llvm_box import box_functions
from grounded.compile.emit.llvm_descent import descent_kernel
from grounded.compile.emit.llvm_riccati import sweep_kernel
from grounded.compile.emit.llvm_rollout import rollout_kernel
from grounded.compile.emit.llvm_step import dynamics_of, jacobian_function, stage_tables
from grounded.compile.emit.llvm_text import declarations
from grounded.compile.kernel_words import LANES, MAX_INPUTS, Layout
from grounded.compile.names import Integrator, Kind
from grounded.compile.trace.tracing import Trace


def module_text(
    trace: Trace,
    kind: Kind,
    integrator: Integrator,
    which: Layout | str,
    width: int,
    derivatives: bool = True,
) -> str:
    """LLVM IR of a module, for vectors of `width` doubles; without derivatives, steps and rollouts.

    `which`: "batch" (step and linearise), "full" (with the parameters), or a layout of z: rollout
    and, for few enough inputs, sweep and descent about it.
    """
    n, m, k = trace.sizes
    more = k if which == "full" else 0
    d = dynamics_of(trace, n + m + more if derivatives else 0, kind, integrator)
    text = declarations({width, LANES, 2}) + stage_tables(d) + d.uniforms.function()
    if isinstance(which, Layout):
        text += rollout_kernel(d, which)
        if which.m > MAX_INPUTS or not derivatives:
            return text
        text += box_functions(which.m) + sweep_kernel(d, which, width)
        return text + descent_kernel(which.m, which.nz)
    if derivatives:
        text += jacobian_function(d, width) + linearise_kernel(d, width, more)
    return text if which == "full" else text + step_kernel(d, width) + march_kernel(d)


def operations(trace: Trace, kind: Kind, integrator: Integrator) -> int:
    """Operations that are written, as far as parameters are left out."""
    return dynamics_of(trace, sum(trace.sizes[:2]), kind, integrator).operations
