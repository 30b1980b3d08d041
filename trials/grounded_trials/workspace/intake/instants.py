"""How far the commands of a log are from a policy's, if its run began at this instant or that one.

At every instant of the log, as finely as it was sampled, what was sent is compared with what the
policy would send on the states logged from there on, feedback and all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from grounded.frozen import Array
from grounded.policy import Policy
from grounded.trial import LAST
from grounded_trials.logs.resample import Gridded
from grounded_trials.workspace.intake.who_drove import LEAST

QUIET_S = 1.0  # without a change of commands, before a run that the log does not have whole
SHORT = 4  # at least 1 / SHORT of a run tells that it was one
EXACTLY = 0.02  # of an input's size: the mean difference of a run that is sought by how it begins
BATCH = 256  # instants compared at once


def instants_apart(
    log: Gridded, parts: int, policy: Policy, instants: Sequence[int] | None = None
) -> tuple[Array, Array, Array]:
    """Three measures of every instant, infinite where it can't begin a run, (N,) each.

    Args:
        log: states and inputs at N instants.
        parts: so many a step of the policy.
        policy: for these states and inputs.
        instants: those that are asked for; None: all.

    Returns:
        The mean difference of the commands, where the log has the run whole, or begins it after a
        rest. The part of the run after which commands are the policy's no more: of one that was
        cut, or stopped, in a log in which something moved before it. And the share of the first
        commands that are not the policy's.
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
        lost = 1 - alike / H + 0.1 * at / EXACTLY  # a step more is no better, for more apart
        until[ks] = np.where(alike >= least, lost, np.inf)
        strays[ks] = (off[:, :least] > EXACTLY).mean(axis=1)
    return apart, until, strays


def least_of(horizon: int) -> int:
    """Steps at the beginning of a run that tell that it was one."""
    return max(LEAST, horizon // SHORT)


def _off(
    log: Gridded, parts: int, policy: Policy, wanted: Sequence[int]
) -> Iterator[tuple[Any, Any, Any]]:
    """Differences of the commands (K, H), of instants (K,), and whether they are known."""
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
