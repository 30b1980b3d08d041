"""Compare the commands of a log with a policy's, for every instant at which its run may begin.

The commands are compared with what the policy would send, including feedback, on the states logged
from that instant on. Instants are as fine as the log was sampled.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.returned.who_drove import LEAST
from grounded.trial import LAST
from grounded_trials.logs.resample import Gridded

QUIET_S = 1.0  # time without a change of commands before a run that is cut short in the log
SHORT = 4  # at least 1 / SHORT of a run must be in the log
EXACTLY = 0.02  # mean difference, relative to an input's size, below which commands are alike
BATCH = 256  # instants compared at once


def instants_apart(
    log: Gridded, parts: int, policy: Policy, instants: Sequence[int] | None = None
) -> tuple[Array, Array, Array]:
    """Return three measures for every instant, infinite where no run can begin, (N,) each.

    Args:
        log: states and inputs at N instants.
        parts: instants per step of the policy.
        policy: the policy for these states and inputs.
        instants: the indices to compute; None: all.

    Returns:
        The mean difference of the commands, if the log has the complete run or commands are
        constant before it; the share of the run after which commands are no longer the policy's,
        for runs that were cut or stopped; and the share of the first commands that are not the
        policy's.
    """
    sent, H = np.clip(log.inputs, policy.low, policy.high), policy.horizon
    changed = np.any(np.diff(sent, axis=0, prepend=sent[:1]) != 0, axis=1)
    count, quiet = np.cumsum(changed), round(QUIET_S / policy.dt * parts)
    apart, until, strays = np.full((3, len(sent)), np.inf)
    least, steps = least_of(H), np.arange(1, H + 1)
    asked = range(len(sent)) if instants is None else instants
    lasting = [(len(sent) - k - parts // 2 - 1) // parts + 1 for k in asked]
    enough = min(least, H - LAST)
    wanted = [k for k, some in zip(asked, lasting, strict=True) if some >= enough]
    for ks, off, known in _off(log, parts, policy, wanted):
        left = known.sum(axis=1)
        before = np.maximum(ks - 1, 0)
        begun = count[before] == count[np.maximum(ks - 1 - quiet, 0)]
        whole = (left >= H - LAST) | (begun & (left >= least))
        apart[ks[whole]] = ((off * known).sum(axis=1) / left)[whole]
        mean = np.where(known, np.cumsum(off, axis=1) / steps, np.inf)
        alike = np.where(mean < EXACTLY, steps, 0).max(axis=1)
        at = mean[np.arange(len(ks)), np.maximum(alike - 1, 0)]
        lost = 1 - alike / H + 0.1 * at / EXACTLY  # one more step must not cost a worse fit
        until[ks] = np.where(alike >= least, lost, np.inf)
        strays[ks] = (off[:, :least] > EXACTLY).mean(axis=1)
    return apart, until, strays


def least_of(horizon: int) -> int:
    """Return the number of steps at the beginning that identify a run."""
    return max(LEAST, horizon // SHORT)


def _off(
    log: Gridded, parts: int, policy: Policy, wanted: Sequence[int]
) -> Iterator[tuple[Any, Any, Any]]:
    """Yield instants (K,), differences of the commands from there (K, H), and which are known."""
    states, H = log.states, policy.horizon
    sent, width = np.clip(log.inputs, policy.low, policy.high), policy.high - policy.low
    size = np.maximum(np.abs(sent).max(axis=0), np.abs(policy.feedforward).max(axis=0))
    size = size + np.where(np.isfinite(width), 0.1 * width, 1e-12)
    steps = parts * np.arange(H)
    for at in range(0, len(wanted), BATCH):
        ks = np.array(wanted[at : at + BATCH])
        x = states[np.minimum(ks[:, None] + steps, len(states) - 1)]
        here = ks[:, None] + steps + parts // 2
        u = sent[np.minimum(here, len(sent) - 1)]
        off = (np.abs(policy.commands(x, policy.past) - u) / size).mean(axis=2)
        yield ks, off, here < len(sent)
