"""What a kernel is called with: the names of its words, in order, and the layout of z.

A kernel takes one pointer, to a table of 64-bit words: addresses, integers, doubles. `emit` writes
the code that reads the table, `run` fills it; nothing else is shared between the two.
"""

from __future__ import annotations

from dataclasses import dataclass

BATCH = ("x", "u", "p", "dt", "eps", "N", "out", "f_x", "f_u", "f_p")
MARCH = (*BATCH, "steps", "lengths")
ROLLOUT = (
    *("start", "ubar", "K", "zbar", "k", "alphas", "p", "dt", "eps", "bias", "target", "weight"),
    *("shift", "input_target", "R", "S", "low", "high", "now", "past", "H", "runs", "z", "u"),
    "cost",
)
SWEEP = (
    *("z_run", "u_run", "shift", "p", "dt", "eps", "target", "weight", "input_target", "R", "S"),
    *("low", "high", "now", "past", "damping", "H", "k", "K", "expected", "jacobian"),
)
DESCENT = (
    *("rollout", "sweep", "z0", "u0", "z1", "u1", "k", "K", "scale", "damping", "alphas", "costs"),
    *("expected", "halvings", "max_iterations", "tolerance", "accept", "lines", "result"),
)
COST, COUNT, FAILED_AT, TURN = range(4)  # of a descent's result; TURN: 0 when z0, u0 are the last
LANES = 4  # runs of a rollout side by side
MAX_INPUTS = 8  # of a sweep: its box-limited programme is written out


@dataclass(frozen=True)
class Layout:
    """z = [x, past inputs]: sizes, angles, and where each input's past begins."""

    n: int
    depths: tuple[int, ...]  # (m,)
    angles: tuple[bool, ...]  # (n,)
    prompt: tuple[bool, ...]  # (m,) whether u_j acts at once: then its past costs, and does no more

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.depths)

    @property
    def nz(self) -> int:
        """Size of z."""
        return self.n + sum(self.depths)

    @property
    def moving(self) -> list[int]:
        """Entries of z that the next z depends on, in order."""
        idle = {self.slot(j) for j, prompt in enumerate(self.prompt) if prompt}
        return [i for i in range(self.nz) if i not in idle]

    def input_of(self, i: int) -> int:
        """Whose past entry i of z is, i >= n."""
        return max(j for j in range(self.m) if self.slot(j) <= i)

    def slot(self, j: int, i: int = 0) -> int:
        """Index in z of u_j[t - 1 - i]."""
        return self.n + sum(self.depths[:j]) + i
