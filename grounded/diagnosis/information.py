"""What the data know of the noise: the curvature of the likelihood in all log variances.

Channels share their noise: an encoder's noise can pass for a disturbance of the speed behind it.
Scoring with one channel at a time then steps across the ridge and back. So where a hypothesis
climbs, the curvature is measured: the exact slope (`noise.slopes`) at a small change of each log
variance, all changes through one filter at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from grounded.diagnosis import filter as kalman
from grounded.diagnosis.noise import Noise, slopes
from grounded.frozen import Array

SMALL = 0.1  # change of a log variance


def information(
    noise: Noise, adjoints: Callable[[list[Noise]], list[kalman.Adjoint]], dt: float
) -> Array:
    """Minus the second derivative of the log-likelihood in the log variances, (K, K).

    Args:
        noise: about which; K is 2 n, or 3 n with a coloured part.
        adjoints: the smoother's answer under each of several noises.
        dt: [s].
    """
    names = ("log_q", "log_r", "log_c")[: 2 if noise.structure.tau is None else 3]
    n, changed = len(noise.log_q), [noise]
    for name in names:
        for i in range(n):
            moved = getattr(noise, name).copy()
            moved[i] += SMALL
            changed.append(replace(noise, **{name: moved}))
    found = [
        slopes(one, adjoint, dt).reshape(-1)
        for one, adjoint in zip(changed, adjoints(changed), strict=True)
    ]
    curvature = -(np.array(found[1:]) - found[0]) / SMALL
    return 0.5 * (curvature + curvature.T)
