"""The surface of a radiance volume, as fields on a lattice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy import ndimage

from ...fields.depth_fusion import fused_distance
from ...fields.lattice_fields import closed_at_border
from ...fields.smoothing import MeshDiffusion
from ...fields.visual_hull import visual_hull
from ...lattice import Lattice
from ...scene import FitScene
from ...template.sides import normals_at_vertices
from ..template import Template, closed_template
from .volume import RadianceVolume

#: The template is this far outside of what is there, in cells: a sheet, which is seen from both sides, has no
#: inside, and a lattice holds nothing thinner than about a cell.
_MARGIN = 0.6

#: Largest distance that is told from others, in cells.
_TRUNCATION = 3.0

#: Share of the views from which nothing hides a point that have to see through it. The more, the nearer to
#: the masks; the fewer, the thinner may be what is seen from one side only.
_VOTES = 0.3

#: Coverage from which on a pixel shows the object.
_COVERED = 0.5

#: What floats and has fewer lattice vertices than a ball of this radius, in cells, is noise.
_FLOATER = 2.0

#: Lambda that smooths the way back along the template.
_SMOOTHING = 1.0


@dataclass(frozen=True)
class VolumeSurface:
    """A closed template around a volume's surface.

    Attributes:
        template: outside of it.
        positions: (V, 3) where the template's vertices belong. Both sides of a sheet are in one place.
        radiance: (V, 3) there.
    """

    template: Template
    positions: np.ndarray
    radiance: np.ndarray


def volume_surface(volume: RadianceVolume, scene: FitScene, lattice: Lattice,
                   progress: Callable[[], None] = lambda: None) -> VolumeSurface | None:
    """Finds the surface of a trained volume.

    Every view tells how deep it sees, where its mask does not say that it sees nothing. What no view looks
    through is there (``fused_distance``), within the visual hull.

    Args:
        volume: trained.
        scene: its subject is left with other fields.
        lattice: whose vertices make a cube.
        progress: called without arguments after each view.

    Returns:
        None if nothing is there.
    """
    subject, views = scene.subject, volume.views
    cell, margin = subject.length_scale * lattice.spacing, _MARGIN
    points = mi.Transform4f(subject.to_world) @ mi.Point3f(lattice.points(mi.Float))
    alphas = [target.most_alpha for target in scene.targets]
    distance = visual_hull(points, views, alphas).numpy()
    depths = []
    for index, (target, alpha) in enumerate(zip(scene.targets, alphas, strict=True)):
        depth = volume.depth(index)
        unknown = np.where(np.isfinite(depth), depth, np.nan) if target.has_alpha else depth
        depths.append(np.where(alpha < _COVERED, np.inf, unknown))
        progress()
    near = np.flatnonzero(distance < 2 * cell)
    inside = fused_distance(mi.Point3f(points.numpy()[:, near]), views, depths, truncation=_TRUNCATION * cell,
                            share=_VOTES)
    distance[near] = np.maximum(distance[near], inside.numpy())
    outside = _without_specks((distance / cell).reshape((lattice.stride,) * 3), margin) - margin
    sdf = closed_at_border(lattice.spacing * outside.ravel(), lattice)
    if not (sdf < 0).any():
        return None
    mesh, vertices, faces = closed_template(subject, sdf, lattice)
    # Smoothed positions would shrink rims.
    smooth = MeshDiffusion(faces, len(vertices), _SMOOTHING)
    inwards = [smooth(mi.Float(np.ascontiguousarray(column, np.float32))).numpy()
               for column in normals_at_vertices(vertices, faces).T]
    back = vertices - margin * cell * np.stack(inwards, axis=1)
    template = Template(mesh, vertices, faces, np.ones(len(vertices)), back)
    return VolumeSurface(template, back, volume.radiance_at(back))


def _without_specks(distance: np.ndarray, level: float) -> np.ndarray:
    """Distances without the small floaters below a level, and without air that nothing leads to."""
    everywhere = np.ones((3, 3, 3))
    label, _ = ndimage.label(distance < level, everywhere)
    size = np.bincount(label.ravel())
    small = (label > 0) & (size[label] < 4 / 3 * np.pi * _FLOATER**3)
    distance = np.where(small, level + 0.5, distance)
    label, count = ndimage.label(distance >= level)
    if not count:
        return distance
    outer = np.argmax(np.bincount(label.ravel())[1:]) + 1
    return np.where((label > 0) & (label != outer), level - 0.5, distance)
