"""Dents: hollows that are none, such as what a radiance volume digs where something is mirrored.

A mirror image lies behind the surface, and a fog that shows it is a crater. Where the views that meet it
disagree on much else, too, it may explain them better than the hull; on the surface that the joint stage
leaves, seen by corrected cameras, it no longer does. So everything narrow enough is tried without: the
surface's morphological closing (Serra 1982) goes straight across it.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from ..judge import Verdict, places_of
from ..sheets import SURE
from ..stage import Fit
from ..surface import Surface
from ..template import at_nearest, lattice_index

#: Radii of balls that do not fit into a dent, in cells: craters in a gilded hat are 6 to 12 cells wide.
_RADII = 8.0, 4.0

#: What has fewer lattice vertices than a ball of this radius, in cells, is no more than a rounded edge.
_SMALLEST = 2.0

#: Standard deviation, in cells, that smooths what is filled in.
_BLUR = 1.0

#: A vertex is where there was nothing before if it is so far, in cells, from the surface.
_MOVED = 0.3


def without_dents(fit: Fit, surface: Surface) -> tuple[Surface, Verdict | None]:
    """The surface without the dents that unseen views are explained better without.

    Args:
        fit: the views.
        surface: one whose lattice's vertices make no cube stays as it is.

    Returns:
        The surface, the given one if no dent goes, and what the judge says of each dent.
    """
    blocks, whole = surface.fields.blocks is not None, surface.whole()
    lattice, judge, verdicts = whole.lattice, fit.outline_judge, []
    if lattice.vertex_count != lattice.stride**3:
        return surface, None
    filled, shown = whole, None
    for radius in _RADII:
        distance = filled.fields.sdf.reshape((lattice.stride,) * 3) / lattice.spacing
        label = dents(distance, radius)
        if not label.any():
            continue
        after = fit.mesh(_without(filled, label > 0))
        index = lattice_index(after[0], fit.scene.subject.to_world, lattice.stride - 1)
        # Vertices beside a dent belong to it, if they are where nothing was.
        near = at_nearest(ndimage.maximum_filter(label, 3), index)
        moved = (near > 0) & (ndimage.map_coordinates(distance, index, order=1) > _MOVED)
        if not moved.any():
            continue
        shown = shown or judge.shown(fit.mesh(filled))
        other = judge.shown(after, like=shown)
        verdict = judge.compare(shown.whole, other.whole, places_of(moved, near), other)
        verdicts.append(verdict)
        better = np.unique(near[moved])[verdict.accepted]
        if len(better):
            filled, shown = _without(filled, np.isin(label, better)), None
    said = Verdict.together(verdicts) if verdicts else None
    if filled is whole:
        return surface, said
    return filled.in_blocks() if blocks else filled, said


def dents(distance: np.ndarray, radius: float) -> np.ndarray:
    """(n, n, n) ids, from 1, of the dents of a solid that no ball of that radius fits into; 0 elsewhere. The
    distance, (n, n, n) in cells, is negative in the solid.

    >>> distance = np.full((9, 24, 24), 4.0)
    >>> distance[:5, 3:21, 3:21] = -4
    >>> distance[1:5, 10:14, 10:14] = 4
    >>> int(dents(distance, 4.0).max()), int(dents(distance, 1.0).max())
    (1, 0)
    """
    solid = np.pad(distance < 0, int(radius) + 2)
    wide = ndimage.distance_transform_edt(~solid) <= radius
    closed = (ndimage.distance_transform_edt(wide) > radius) & ~solid
    inner = (slice(int(radius) + 2, -int(radius) - 2),) * 3
    label, _ = ndimage.label(closed[inner], np.ones((3, 3, 3)))
    small = np.bincount(label.ravel()) < 4 / 3 * np.pi * _SMALLEST**3
    return np.where(small[label], 0, label)


def _without(surface: Surface, dent: np.ndarray) -> Surface:
    """The surface where some of its dents, (n, n, n), are filled in, and closed there."""
    lattice = surface.lattice
    distance = surface.fields.sdf.reshape(dent.shape) / lattice.spacing
    solid = (distance < 0) | dent
    straight = ndimage.distance_transform_edt(~solid) - ndimage.distance_transform_edt(solid)
    near = ndimage.binary_dilation(dent, iterations=2)
    sdf = np.where(near, np.minimum(distance, ndimage.gaussian_filter(straight, _BLUR)), distance)
    msdf = surface.fields.msdf.reshape(dent.shape)
    msdf = np.where(near, np.maximum(np.abs(msdf), SURE * lattice.spacing), msdf)
    return surface.with_fields(sdf=(lattice.spacing * sdf).astype(np.float32).ravel(), msdf=msdf.ravel())
