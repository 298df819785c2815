"""What views see of the same places of a surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import mitsuba as mi
import numpy as np
from scipy import ndimage, sparse
from scipy.cluster.vq import kmeans2

from ..compat import mesh_scene
from ..fields.smoothing import MeshDiffusion
from ..pixels import COVERED, DARK
from ..targets import Target, mean_radiance
from ..template.normals import vertex_normals
from ..triangles import unit
from ..views import PinholeViews
from ..visibility import GRAZING, hidden

#: Lambda that smooths normals along the mesh: those of a lattice's mesh have its steps in them.
_SMOOTHING = 8.0

#: An 8-bit photograph ends at 1. What is nearly as bright may have been brighter.
_CLIPPED = 0.97

#: Parts of the surface, of which the others foretell what is seen of one.
REGIONS = 8


@dataclass(frozen=True)
class Observations:
    """What E sightings tell of the places of a surface. A vertex has two places, its sides.

    Attributes:
        views: how many there are, N.
        place, view: (E,) indices of what is seen by which.
        region: (E,) which part of the surface the place is in, from 0.
        log_radiance: (E, 3) per channel.
        weight: (E, 3) how much that counts: little where it is dark.
        normal, mirrored, toward: (E, 3) unit vectors in the frame that the light is fixed to: the normal of
            the side that is seen, the direction that it mirrors, and that to the camera.
    """

    views: int
    place: np.ndarray
    view: np.ndarray
    region: np.ndarray
    log_radiance: np.ndarray
    weight: np.ndarray
    normal: np.ndarray
    mirrored: np.ndarray
    toward: np.ndarray

    def __len__(self) -> int:
        return len(self.place)

    @cached_property
    def places(self) -> sparse.csr_array:
        """(P, E) of the places that are seen at all: which sightings are theirs."""
        _, row = np.unique(self.place, return_inverse=True)
        count = len(self)
        return sparse.csr_array((np.ones(count), (row, np.arange(count))), (row.max(initial=-1) + 1, count))

    def only(self, chosen: np.ndarray) -> Observations:
        """Those that (E,) chooses."""
        arrays = ("place", "view", "region", "log_radiance", "weight", "normal", "mirrored", "toward")
        return replace(self, **{name: getattr(self, name)[chosen] for name in arrays})

    def turned(self, turns: np.ndarray) -> Observations:
        """The same in a frame that turns with the views, by (N, 3, 3) rotations."""
        axes = turns[self.view]
        vectors = {name: getattr(self, name) for name in ("normal", "mirrored", "toward")}
        return replace(self, **{name: np.einsum("ei,eij->ej", told, axes) for name, told in vectors.items()})


def observe(
    mesh: tuple[np.ndarray, np.ndarray],
    views: PinholeViews,
    targets: list[Target],
    *,
    places: int,
    cell: float,
    seed: int = 0,
) -> Observations:
    """Looks at random vertices of a mesh from all views.

    A place is as large as a cell: over so many pixels targets are averaged, so that neither texture nor small
    errors of poses count. It has to be covered as a whole, and nothing of it may be clipped.

    Args:
        mesh: vertices (V, 3) and faces (F, 3), world units.
        views, targets: the images.
        places: vertices that are looked at, at most.
        cell: side of a cell, world units.
        seed: of the vertices.
    """
    vertices, faces = mesh
    scene, rng = mesh_scene(vertices, faces), np.random.default_rng(seed)
    chosen = np.sort(rng.choice(len(vertices), min(places, len(vertices)), replace=False))
    points, normals = vertices[chosen], _normals(vertices, faces)[chosen]
    region = _regions(points, rng)
    device_points = mi.Point3f(np.ascontiguousarray(points.T, np.float32))
    found: list[tuple[np.ndarray, ...]] = []
    floor = DARK * mean_radiance(targets)
    for view, target in enumerate(targets):
        film, depth = (np.array(value) for value in views.project(view, device_points))
        outwards = unit(views.origins[view] - points)
        cosine = (normals * outwards).sum(axis=1)
        size = views.sizes[view]
        column, row = np.floor(film * size[:, None]).astype(int)
        seen = (
            (np.abs(cosine) > GRAZING)
            & (depth > 0)
            & (column >= 0)
            & (column < size[0])
            & (row >= 0)
            & (row < size[1])
        )
        seen &= ~hidden(scene, points + cell * outwards, outwards)
        index = np.flatnonzero(seen)
        if not len(index):
            continue
        width = cell / (float(views.pixel_size(mi.UInt32(view))[0]) * float(np.median(depth[index])))
        radiance, whole = _averages(target, max(round(width), 1))
        index = index[whole[row[index], column[index]]]
        radiance = radiance[row[index], column[index]]
        back = cosine[index] < 0
        normal = np.where(back[:, None], -normals[index], normals[index])
        toward = outwards[index]
        found.append(
            (
                2 * index + back,
                np.full(len(index), view),
                region[index],
                np.log(np.maximum(radiance, 1e-6)),
                (radiance / (radiance + floor)) ** 2,
                normal,
                2 * np.abs(cosine[index])[:, None] * normal - toward,
                toward,
            )
        )
    if not found:
        return Observations(
            len(views), *(np.zeros(0, int) for _ in range(3)), *(np.zeros((0, 3)) for _ in range(5))
        )
    seen = Observations(len(views), *(np.concatenate(arrays) for arrays in zip(*found, strict=True)))
    return seen if views.turns is None else seen.turned(views.turns)


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit normals, smooth."""
    positions, corners = mi.Float(vertices.ravel().astype(np.float32)), mi.Vector3u(faces.T.astype(np.uint32))
    smooth = MeshDiffusion(faces, len(vertices), _SMOOTHING)
    normals = smooth(vertex_normals(positions, corners)).numpy().reshape(-1, 3).astype(np.float64)
    return unit(normals)


def _regions(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(P,) parts of about the same extent, from 0."""
    if len(points) < REGIONS:
        return np.arange(len(points))
    return kmeans2(points, REGIONS, minit="++", rng=rng)[1]


def _averages(target: Target, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Means of a target over squares of so many pixels: radiance (height, width, 3), and (height, width)
    whether all of a square is the object's and known, and nothing clipped."""
    rgba = target.rgba
    color, alpha = rgba[..., :3], rgba[..., 3]
    spoilt = (alpha < COVERED) | (np.asarray(target.known) < COVERED)
    if color.max() <= 1:
        spoilt |= color.max(axis=-1) > _CLIPPED
    whole = ~ndimage.maximum_filter(spoilt, side, mode="constant", cval=True)
    return ndimage.uniform_filter(color, (side, side, 0)), whole
