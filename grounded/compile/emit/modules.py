"""The modules that are compiled: which kernels lie together, and how their text is put together."""

from __future__ import annotations

from dataclasses import dataclass

from grounded.compile.emit.llvm_batch import linearise_kernel, march_kernel, step_kernel
from grounded.compile.emit.llvm_box import box_functions
from grounded.compile.emit.llvm_descent import descent_kernel
from grounded.compile.emit.llvm_riccati import sweep_kernel
from grounded.compile.emit.llvm_rollout import rollout_kernel
from grounded.compile.emit.llvm_step import Dynamics, dynamics_of, jacobian_function, stage_tables
from grounded.compile.emit.llvm_text import declarations
from grounded.compile.kernel_words import LANES, MAX_INPUTS, Layout
from grounded.compile.problem import Integrator, Kind
from grounded.compile.trace.tracing import Variant


@dataclass(frozen=True, eq=False)
class Source:
    """A traced model and its sizes (n, m, k), from which every module is written."""

    variant: Variant
    sizes: tuple[int, int, int]
    kind: Kind
    integrator: Integrator
    derivatives: bool = True  # else steps and rollouts alone

    def text(self, which: Layout | str, width: int) -> str:
        """LLVM IR of a module, for vectors of `width` doubles.

        Args:
            which: "batch" (step and linearise), "full" (with the parameters), or a layout of z:
                rollout and, for few enough inputs, sweep and descent about it.
            width: doubles in the widest vector of the machine.
        """
        n, m, k = self.sizes
        columns = n + m + (k if which == "full" else 0)
        d = self._dynamics(columns if self.derivatives else 0)
        if isinstance(which, Layout):
            return self._search(d, which, width)
        if not self.derivatives:
            return _start(d, width) + step_kernel(d, width) + march_kernel(d)
        columns = k if which == "full" else 0
        text = _start(d, width) + jacobian_function(d, width) + linearise_kernel(d, width, columns)
        return text if which == "full" else text + step_kernel(d, width) + march_kernel(d)

    @property
    def operations(self) -> int:
        """Operations that are written, as far as parameters are left out."""
        return self._dynamics(sum(self.sizes[:2])).operations

    def _dynamics(self, columns: int) -> Dynamics:
        n, m, _ = self.sizes
        return dynamics_of(self.variant, n, m, columns, self.kind, self.integrator)

    def _search(self, d: Dynamics, layout: Layout, width: int) -> str:
        text = _start(d, width) + rollout_kernel(d, layout)
        if layout.m > MAX_INPUTS or not self.derivatives:
            return text
        text += box_functions(layout.m) + sweep_kernel(d, layout, width)
        return text + descent_kernel(layout.m, layout.nz)


def _start(d: Dynamics, width: int) -> str:
    return declarations({width, LANES, 2}) + stage_tables(d) + d.uniforms.function()
