"""Where in a recording the run of a candidate begins: whoever records begins before the run.

Without a [log.span] the run is taken to begin with the first command in the log. A robot that sends
zeros while it waits has sent commands for a second by then, and its log looks like somebody else's
run. So the commands are laid against the candidate's feed-forward at every step of the log; where
that fits best, the policy itself is compared (`follows`), feedback and all, at every quarter of a
step, since a log's own grid is not the run's. The instants at which commands change say the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from grounded.frozen import Array
from grounded.policy import Policy
from grounded.trial import LAST, Trial
from grounded_trials.logs.resample import Gridded
from grounded_trials.workspace.trial_check import Following, follows

TRIED = 5  # steps of the log at which the feed-forward fits best
QUARTERS = 4  # of a step, between which the start is sought
CLEAR = 0.5
FEW = 5  # changes, which are too few to say when the steps begin


def likely_starts(policy: Policy, whole: Gridded) -> list[float]:
    """When the run may have begun, seconds after the log's first sample, the likeliest first.

    Args:
        policy: what is sought.
        whole: the log from its first command to its end, on the policy's grid.
    """
    sent, ubar = whole.inputs, policy.feedforward
    H = min(len(ubar), len(sent))
    if len(ubar) - LAST > H:
        return []
    ubar = np.clip(ubar, policy.low, policy.high)[:H]
    size = np.maximum(np.abs(ubar).max(axis=0), 1e-12)
    off = np.zeros(len(sent) - H + 1)
    for u, asked in zip((sent / size).T, (ubar / size).T, strict=True):
        power = np.concatenate([[0.0], np.cumsum(u**2)])
        off += power[H:] - power[:-H] - 2 * np.correlate(u, asked, "valid")
    best, left = list[int](), off.copy()
    while len(best) < TRIED and np.isfinite(left).any():
        best.append(int(np.argmin(left)))
        left[max(0, best[-1] - 2) : best[-1] + 3] = np.inf
    begin = (whole.start_ns - whole.origin_ns) * 1e-9
    return [begin + k * policy.dt for k in best]


def run_start(
    policy: Policy,
    starts: Iterable[float],
    changes: Array,
    trial_from: Callable[[float], Trial | None],
) -> float | None:
    """When the run of a policy begins, None where no start fits clearly.

    Clearly: at most half of what differs a step before is left there.

    Args:
        policy: what was to be run.
        starts: where it may begin, see `likely_starts`.
        changes: when a command changed, seconds after the log's first sample.
        trial_from: the log as a trial that begins then, None where it is too short.
    """

    def compared(start: float) -> Following | None:
        trial = trial_from(start) if start >= 0 else None
        return None if trial is None else follows(policy, trial.until(policy.horizon), 0)

    reach = policy.dt * (policy.horizon - 1) / 2
    for start in starts:
        tried = [start + k * policy.dt / QUARTERS for k in range(-QUARTERS, QUARTERS + 1)]
        found = [(f.error, one) for one in tried if (f := compared(one)) and f.alike and not f.late]
        if not found:
            continue
        error, best = min(found)
        before = compared(best - policy.dt)
        if before is not None and error < CLEAR * before.error:
            inside = changes[np.abs(changes - best - policy.dt * policy.horizon / 2) < reach]
            phase = (inside - best + policy.dt / 2) % policy.dt - policy.dt / 2
            return best + float(np.median(phase)) if len(phase) > FEW else best
    return None
