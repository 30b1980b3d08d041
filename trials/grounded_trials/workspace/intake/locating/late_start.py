"""Find the start of a run whose commands are some steps late, as sent or as logged.

Feedback on the samples of a step before fits nearly as well some rows off, where each command
stands beside newer samples: the run seemed to begin elsewhere, on "other states than the
controller used". With its commands moved earlier by these steps, it is the policy's to the last
digits, and only from where it began.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from grounded.accounts.sent import LATEST
from grounded.policy import Policy
from grounded_trials.logs.signals import Series
from grounded_trials.workspace.intake.locating.acted_on import acted_on
from grounded_trials.workspace.intake.locating.run_start import Recording, Start, instants_apart

NEAR = 5  # steps about a start that fits about, within which the true one is sought
EACH = 3  # instants that are examined for each lag


def late_start(log: Recording, policy: Policy, found: Start | None) -> Start | None:
    """Return where a run begins whose commands are exactly the policy's some steps before.

    Args:
        log: a log in which no start has the policy's commands to the last digits.
        policy: the policy, for the states and inputs of the log.
        found: the start that fits best there.
    """
    if policy.gain is None or (policy.state_names, policy.input_names) != log.names:
        return None
    exact = list[tuple[float, Start]]()  # with the age of the samples: on older ones, less late
    for steps in range(1, LATEST + 1):
        early = _earlier(log, steps)
        for at in _instants(early, policy, log.first if found is None else found.seconds):
            fit = acted_on(early, policy, at)
            if fit is not None and fit.throughout:
                apart = early.apart_at(policy, at)
                exact.append((float(fit.old.max()), Start(at, apart, True, True, exact=True)))
    return min(exact, key=lambda one: one[0])[1] if exact else None


def _instants(log: Recording, policy: Policy, about: float) -> Iterator[float]:
    """Yield the likeliest instants near a start, where commands change [s]."""
    middle, far = round((about - log.first) * log.parts / log.dt), NEAR * log.parts
    near = range(max(0, middle - far), min(len(log.whole.inputs), middle + far + 1))
    apart = instants_apart(log.whole, log.parts, policy, near)[0]
    told = [k for k in np.argsort(apart, kind="stable")[:EACH] if np.isfinite(apart[k])]
    instants = (log.on_step(policy, log.first + int(k) * log.dt / log.parts) for k in told)
    yield from dict.fromkeys(instants)


def _earlier(log: Recording, steps: int) -> Recording:
    """Return a log with all commands some steps earlier, from its first sample on."""
    by, (_, inputs) = steps * log.dt, log.names
    moved = {
        name: _moved(log.series[name], round(by * 1e9), log.whole.origin_ns) for name in inputs
    }
    at = np.minimum(np.arange(len(log.whole.inputs)) + steps * log.parts, len(log.whole.inputs) - 1)
    return replace(
        log,
        series={**log.series, **moved},
        whole=replace(log.whole, inputs=log.whole.inputs[at]),
        changes=log.changes - by,
    )


def _moved(series: Series, by_ns: int, first_ns: int) -> Series:
    """Return samples earlier by some time; of those before a time, the last is held from it on."""
    t = np.maximum(series.t - by_ns, first_ns)
    kept = np.append(t[1:] > t[:-1], True)
    return replace(
        series,
        t=t[kept],
        values=series.values[kept],
        log_times=series.log_times[kept] - by_ns,
    )
