"""A part of a body as Rerun draws it."""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.figures.body import Part

Colour = tuple[int, int, int]


def drawn(part: Part, colour: Colour, ghost: bool = False) -> Any:
    """The archetype of a part, in one colour; a ghost, what was only predicted, as its edges."""
    import rerun as rr

    modes, size = rr.components.FillMode, part.size
    look = modes.MajorWireframe if ghost else modes.Solid
    if part.shape == "box":
        return rr.Boxes3D(half_sizes=[size], colors=colour, fill_mode=look)
    if part.shape == "ellipsoid":
        return rr.Ellipsoids3D(half_sizes=[size], colors=colour, fill_mode=look)
    if part.shape == "capsule":
        return rr.Capsules3D(radii=[size[0]], lengths=[size[1]], colors=colour, fill_mode=look)
    if part.shape == "cylinder":
        return rr.Cylinders3D(radii=[size[0]], lengths=[size[1]], colors=colour, fill_mode=look)
    if part.shape == "mesh":
        faces = part.faces.astype(np.uint32)
        return rr.Mesh3D(vertex_positions=part.points, triangle_indices=faces, albedo_factor=colour)
    if part.shape == "lines":
        return rr.LineStrips3D(part.strips, colors=colour, radii=rr.Radius.ui_points(2))
    return rr.Points3D([[0, 0, 0]], colors=colour, radii=rr.Radius.ui_points(6))
