"""Where the viewer looks from: plane paths from above, volumes and mechanisms from the side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from grounded.figures.body import Body
from grounded.frozen import Array
from grounded_trials.report.bodies import is_mechanism, reach
from grounded_trials.report.findings import Findings
from grounded_trials.report.scene import Scene
from grounded_trials.wording import labelled

FAR = 1.1  # times the size of what is seen
ASIDE = 1.5  # the same of a mechanism: its parts have a width


@dataclass(frozen=True, eq=False)
class Space:
    """Views of the space that a body moves in."""

    findings: Findings
    scene: Scene
    body: Body

    @property
    def title(self) -> str:
        """What the first view shows."""
        if is_mechanism(self.body):
            return "Real and predicted, from the side"
        axes = [labelled(*one) for one in zip(self.scene.names, self.scene.units, strict=True)]
        return "Paths: " + " over ".join(reversed(axes)) if len(axes) == 2 else "Paths"

    def view(self, contents: Sequence[str], name: str) -> Any:
        """A view of some entities; from above y points up, from the side z does."""
        import rerun.blueprint as rrb

        (centre, extent), up = self._bounds, (0, 0, 1)
        distance = max(extent, 1e-3) * FAR
        if is_mechanism(self.body):
            direction, distance = np.array([0.0, -1.0, 0.1]), max(extent, 1e-3) * ASIDE
        elif self.scene.volume:
            direction = np.array([0.0, -1.0, 0.7])
        else:
            direction, up = np.array([0.0, 0.0, 1.0]), (0, 1, 0)
        eye = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=centre + distance * direction / np.linalg.norm(direction),
            look_target=centre,
            eye_up=up,
        )
        spacing = 10.0 ** math.floor(math.log10(max(extent, 1e-3) / 2))
        grid = rrb.LineGrid3D(visible=True, spacing=spacing, color=(90, 90, 90, 60))
        return rrb.Spatial3DView(
            origin="/", contents=list(contents), name=name, eye_controls=eye, line_grid=grid
        )

    @cached_property
    def _bounds(self) -> tuple[Array, float]:
        """The middle and the size of all that is drawn, without runs that went astray."""
        findings = self.findings
        shown = [findings.task.target]
        shown += [run.trial.states for run in (findings.best, findings.first) if run is not None]
        shown += [log.trial.states for log in findings.logs] if not findings.runs else []
        points = np.vstack([reach(self.body, states) for states in shown])
        if not len(points):
            return np.zeros(3), 1.0
        low, high = points.min(axis=0), points.max(axis=0)
        return (low + high) / 2, float((high - low).max() or 1.0)
