"""The surface of a radiance volume, as fields on a lattice."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np
from scipy import ndimage

from ...fields import LatticeFields
from ...fields.depth_fusion import fused_distance
from ...fields.lattice_fields import closed_at_border
from ...fields.mask_distances import MaskDistances
from ...fields.visual_hull import visual_hull
from ...lattice import Lattice
from ...radiance.volume import RadianceVolume
from ...scene import FitScene
from ...template.denoise import denoised
from ...template.sides import normals_at_vertices
from ..surface import Seen, Surface
from ..template import closed_template

#: The surface is this far outside of what is there, in cells: a sheet, which is seen from both sides, has no
#: inside, and a lattice holds nothing thinner than about a cell. The joint stage takes it back where it can.
_MARGIN = 0.6

#: How far a surface that views vote for may be off, in cells: they vote at vertices, which are a cell apart.
_ERROR = 0.4

#: Largest distance that is told from others, in cells.
_TRUNCATION = 3.0

#: Share of the views from which nothing hides a point that have to see through it. The more, the nearer to
#: the masks; the fewer, the thinner may be what is seen from one side only.
_VOTES = 0.3

#: Coverage from which on a pixel shows the object.
_COVERED = 0.5

#: What floats and has fewer lattice vertices than a ball of this radius, in cells, is noise.
_FLOATER = 2.0


def volume_surface(
    volume: RadianceVolume,
    scene: FitScene,
    masks: MaskDistances,
    lattice: Lattice,
    light: np.float32,
    progress: Callable[[], None] = lambda: None,
) -> Surface | None:
    """Finds the surface of a trained volume. It is closed, and a little outside of what is there.

    Every view tells how deep it sees, where its mask does not say that it sees nothing. What no view looks
    through is there (``fused_distance``), within the visual hull.

    Args:
        volume: trained.
        scene: whose subject says where the lattice is.
        masks: of its targets.
        lattice: whose vertices make a cube.
        light: of what was seen.
        progress: called without arguments after each view.

    Returns:
        None if nothing is there.
    """
    subject, views = scene.subject, volume.views
    cell, margin = subject.length_scale * lattice.spacing, _MARGIN
    points = mi.Transform4f(subject.to_world) @ mi.Point3f(lattice.points(mi.Float))
    alphas = [target.most_alpha for target in scene.targets]
    distance = visual_hull(points, masks).numpy()
    depths = []
    for target, alpha, depth in zip(scene.targets, alphas, volume.depths(), strict=True):
        unknown = np.where(np.isfinite(depth), depth, np.nan) if target.has_alpha else depth
        depths.append(np.where(alpha < _COVERED, np.inf, unknown))
        progress()
    near = np.flatnonzero(distance < 2 * cell)
    inside = fused_distance(
        mi.Point3f(points.numpy()[:, near]), views, depths, truncation=_TRUNCATION * cell, share=_VOTES
    )
    distance[near] = np.maximum(distance[near], inside.numpy())
    sdf = closed_at_border(lattice.spacing * (distance / cell - margin), lattice)
    cells = denoised(sdf, lattice, _ERROR) / lattice.spacing
    cells = without_floaters(cells.reshape((lattice.stride,) * 3)).ravel()
    sdf = closed_at_border(lattice.spacing * cells, lattice)
    if not (sdf < 0).any():
        return None
    mesh, vertices, faces = closed_template(subject, sdf, lattice)
    # What it shows is where it is.
    inside = vertices - margin * cell * normals_at_vertices(vertices, faces)
    seen = Seen.on(lattice, mesh, volume.radiance_at(inside), light)
    return Surface(LatticeFields.closed(sdf, lattice.grid), seen=seen)


def without_floaters(distance: np.ndarray) -> np.ndarray:
    """Distances, in cells, without what is small and floats, and without air that nothing leads to."""
    everywhere = np.ones((3, 3, 3))
    label, _ = ndimage.label(distance < 0, everywhere)
    size = np.bincount(label.ravel())
    small = (label > 0) & (size[label] < 4 / 3 * np.pi * _FLOATER**3)
    distance = np.where(small, 0.5, distance)
    label, count = ndimage.label(distance >= 0)
    if not count:
        return distance
    outer = np.argmax(np.bincount(label.ravel())[1:]) + 1
    return np.where((label > 0) & (label != outer), -0.5, distance)
