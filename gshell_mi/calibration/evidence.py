"""What images tell of where they were taken from: how a surface's texture and its outline lie in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from scipy import ndimage

from ..compat import mesh_scene
from ..pixels import COVERED, DARK
from ..targets import Target, mean_radiance
from ..triangles import unit
from ..views import PinholeViews
from ..visibility import GRAZING, hidden
from .corrections import projected

#: Of a blur that texture is left of, and of one, wider by this factor, that is taken away: shading and
#: exposure differ from view to view, fine texture does not.
_BAND = 5.0

#: Views that see a place, at least, for their mean to be a texture.
_VIEWS = 3

#: Pixels from the border of an image that are left out: what goes on there is not known.
_BORDER = 4

#: Outlines farther apart than this many pixels are not the same.
_REACH = 8.0


@dataclass(frozen=True)
class Evidence:
    """What K places in one view tell of its camera.

    Attributes:
        offsets: (K, 3) of what is seen, from the centre of projection, world units.
        pixels: (K, 2) where it is in the image.
        slopes: (K, 2) how a value changes with that.
        values: (K,) which all views have in common at a place if their cameras are right.
        weights: (K,) of these.
        places: (K,) indices of places.
        shared: whether what is right is known from the other views alone; else it is 0.
    """

    offsets: np.ndarray
    pixels: np.ndarray
    slopes: np.ndarray
    values: np.ndarray
    weights: np.ndarray
    places: np.ndarray
    shared: bool


class Texture:
    """Fine texture: a place looks the same in all views.

    Args:
        mesh: vertices (V, 3) and faces (F, 3), world units.
        targets: the images.
        count: random places on the mesh.
        cell: side of a lattice cell, world units; what is nearer than that does not hide a place.
        seed: of the places.

    Attributes:
        points: (K, 3) the places.
    """

    def __init__(
        self, mesh: tuple[np.ndarray, np.ndarray], targets: list[Target], count: int, cell: float, seed: int
    ):
        vertices, faces = mesh
        surface = trimesh.Trimesh(vertices, faces, process=False)
        self.points, face = trimesh.sample.sample_surface(surface, count, seed=seed)[:2]
        weights = trimesh.triangles.points_to_barycentric(surface.triangles[face], self.points)
        self._normals = unit(np.einsum("ij,ijk->ik", weights, surface.vertex_normals[faces[face]]))
        self._scene, self._cell, self._targets = mesh_scene(vertices, faces), cell, targets
        self._dark = DARK * mean_radiance(targets)

    def level(self, blur: float, views: PinholeViews) -> Callable[[PinholeViews], list[Evidence]]:
        """Evidence in images that are blurred by so many pixels; what is hidden is told for given views."""
        images = [self._band(target, blur) for target in self._targets]
        seen = [self._seen(views, view) for view in range(len(views))]
        return lambda now: self._evidence(images, seen, now)

    def _band(self, target: Target, blur: float) -> np.ndarray:
        """(height, width) logarithm of radiance, band-passed; NaN near what is not the object's."""
        whole = (target.rgba[..., 3] > COVERED) & (np.asarray(target.known) > COVERED)
        value = np.log(np.maximum(target.rgba[..., :3], 0) + self._dark).mean(axis=-1)

        def blurred(sigma: float) -> np.ndarray:
            weight = ndimage.gaussian_filter(whole.astype(np.float32), sigma)
            return ndimage.gaussian_filter(np.where(whole, value, 0), sigma) / np.maximum(weight, 1e-3)

        inside = ndimage.binary_erosion(whole, iterations=int(2 * blur) + 2)
        return np.where(inside, blurred(blur) - blurred(_BAND * blur), np.nan).astype(np.float32)

    def _seen(self, views: PinholeViews, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of what a view sees: which points, which places (a point has two, its sides), and cosines."""
        points = self.points
        toward = unit(views.origins[view] - points)
        cosine = (self._normals * toward).sum(axis=1)
        behind = hidden(self._scene, points + self._cell * toward, toward)
        index = np.flatnonzero(~behind & (np.abs(cosine) > GRAZING))
        return index, 2 * index + (cosine[index] < 0), np.abs(cosine[index])

    def _evidence(
        self,
        images: list[np.ndarray],
        seen: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
        views: PinholeViews,
    ) -> list[Evidence]:
        number, found = np.zeros(2 * len(self.points), int), []
        for view, (image, (index, place, cosine)) in enumerate(zip(images, seen, strict=True)):
            offset = self.points[index] - views.origins[view]
            pixel = projected(offset, views, view)
            value = _sampled(image, pixel)
            slope = _slopes(image, pixel)
            good = np.isfinite(value) & np.isfinite(slope).all(axis=1)
            offset, pixel, value, slope, place, cosine = (
                array[good] for array in (offset, pixel, value, slope, place, cosine)
            )
            number += np.bincount(place, minlength=len(number))
            found.append((offset, pixel, slope, value, cosine, place))
        return [
            Evidence(*(array[number[told[-1]] >= _VIEWS] for array in told), shared=True) for told in found
        ]


class Outline:
    """Outlines: that of the surface lies on that of the mask.

    Args:
        mesh: vertices (V, 3) and faces (F, 3), world units.
        targets: the images, with masks.
    """

    def __init__(self, mesh: tuple[np.ndarray, np.ndarray], targets: list[Target]):
        self._scene = mesh_scene(*mesh)
        self._distances = [_distance(target) for target in targets]

    def evidence(self, views: PinholeViews) -> list[Evidence]:
        """What the views tell."""
        found = [self._of_view(views, view) for view in range(len(views))]
        # A surface that is a little too thick everywhere says nothing of cameras.
        everything = np.concatenate([each.values for each in found])
        thick = float(np.median(everything)) if len(everything) else 0.0
        return [replace(each, values=each.values - thick) for each in found]

    def _of_view(self, views: PinholeViews, view: int) -> Evidence:
        width, height = (int(side) for side in views.sizes[view])
        ray = views.pixel_rays(view)
        found = self._scene.ray_intersect_preliminary(ray)
        hit = found.is_valid().numpy().reshape(height, width)
        edge = hit & ~ndimage.binary_erosion(hit, border_value=1)
        edge &= _framed(hit.shape) & np.isfinite(self._distances[view])
        row, column = np.nonzero(edge)
        index = row * width + column
        offset = ray.d.numpy().T[index] * found.t.numpy()[index, None]
        pixel = np.stack([column, row], axis=1).astype(float)
        value = self._distances[view][row, column]
        slope = _slopes(self._distances[view], pixel)
        # The outermost pixels are half a pixel inside.
        residual = value - 0.5
        good = (np.abs(residual) < _REACH) & np.isfinite(slope).all(axis=1)
        ones, places = np.ones(int(good.sum())), index[good]
        return Evidence(offset[good], pixel[good], slope[good], residual[good], ones, places, shared=False)


def _sampled(image: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Bilinear values at (K, 2) pixels, x first; NaN outside."""
    return ndimage.map_coordinates(image, pixel.T[::-1], order=1, mode="constant", cval=np.nan)


def _slopes(image: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """(K, 2) derivatives at (K, 2) pixels, per pixel."""
    return np.stack(
        [
            _sampled(image, pixel + step) - _sampled(image, pixel - step)
            for step in (np.array([0.5, 0]), np.array([0, 0.5]))
        ],
        axis=1,
    )


def _framed(shape: tuple[int, ...]) -> np.ndarray:
    """Pixels that are not at an image's border."""
    inside = np.zeros(shape, bool)
    inside[_BORDER:-_BORDER, _BORDER:-_BORDER] = True
    return inside


def _distance(target: Target) -> np.ndarray:
    """(height, width) pixels to a mask's outline, positive inside; NaN near what is unknown."""
    mask = target.rgba[..., 3] > 0.5
    known = np.asarray(target.known) > COVERED
    if mask.all() or not mask.any():
        return np.full(mask.shape, np.nan, np.float32)
    signed = ndimage.distance_transform_edt(mask) - ndimage.distance_transform_edt(~mask)
    signed = ndimage.gaussian_filter(signed - 0.5 * np.sign(signed), 1.0)
    if not known.all():
        signed[ndimage.binary_dilation(np.broadcast_to(~known, mask.shape), iterations=_BORDER)] = np.nan
    return signed.astype(np.float32)
