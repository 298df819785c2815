"""What photographs show of the floor: where most agree it is the floor, elsewhere something before it.

All that is needed is a patterned floor; the object may be as plain as it likes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..triangles import unit
from .camera import Camera
from .subject import Subject

#: The patch of floor that is looked at, in sizes of the object's box: behind an object as high as wide, a
#: camera that looks down by 25 degrees sees it.
_REACH = 2.0
#: Texels along the patch's side: about a pixel each where a box fills half an image of 250 pixels.
_TEXELS = 400
#: Photographs that have to show a texel, and the share of them that has to agree.
_FEWEST, _AGREEING = 5, 0.6
#: Photographs, at most, that tell what the floor looks like.
_MOST = 60
#: In units of the noise: an area looks like the floor up to the first, a pixel does not from the second on.
_ALIKE, _OTHER = 1.5, 3.0
#: Side of that area, in pixels.
_WINDOW = 5
#: A pattern varies within so many texels by so many times a pixel's noise, of which the median keeps a fifth.
_AREA, _PATTERN = 15, 1.0
#: Standard deviation of the filter against noise, in pixels.
_BLUR = 0.7
#: Least noise, in values of 0 to 255: rounding and compression.
_LEAST_NOISE = 3.0


@dataclass(frozen=True)
class _Patch:
    """A square of the floor.

    Attributes:
        center: (3,) in the world.
        axes: (2, 3) orthogonal vectors in the plane, as long as half its side.
    """

    center: np.ndarray
    axes: np.ndarray

    @classmethod
    def below(cls, subject: Subject) -> _Patch:
        assert subject.floor is not None
        normal, offset = subject.floor[:3], subject.floor[3]
        middle = subject.box.mean(axis=0)
        first = unit(np.cross(normal, np.eye(3)[np.abs(normal).argmin()]))
        half = _REACH * np.ptp(subject.box, axis=0).max()
        return cls(
            middle - (middle @ normal + offset) * normal, half * np.stack([first, np.cross(normal, first)])
        )

    def points(self) -> np.ndarray:
        """(``_TEXELS`` squared, 3) the texels' centres, row by row."""
        along = (np.arange(_TEXELS) + 0.5) / _TEXELS * 2 - 1
        row, column = np.meshgrid(along, along, indexing="ij")
        return self.center + np.stack([row.ravel(), column.ravel()], axis=1) @ self.axes

    def texel(self, camera: Camera) -> np.ndarray:
        """(2, height, width) row and column of the texel in each pixel; NaN above the horizon."""
        normal = np.cross(*self.axes)
        rays = _directions(camera)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = ((self.center - camera.center) @ normal) / (rays @ normal)
            distance[distance <= 0] = np.nan
            offset = camera.center + distance[..., None] * rays - self.center
            return (
                np.moveaxis(offset @ (self.axes / (self.axes**2).sum(axis=1)[:, None]).T, -1, 0)
                * (_TEXELS / 2)
                + (_TEXELS - 1) / 2
            )


def floor_evidence(
    images: Sequence[np.ndarray], cameras: Sequence[Camera], subject: Subject
) -> list[np.ndarray]:
    """Per image (height, width): -1 where it shows the floor, 1 where something before it, and 0 where no
    floor is behind it that enough other images show alike.

    Args:
        images: (height, width, 3) uint8.
        subject: lines of sight through its core do not tell of the floor.
    """
    if subject.floor is None:
        return [np.zeros(image.shape[:2], np.float32) for image in images]
    patch = _Patch.below(subject)
    images = [ndimage.gaussian_filter(image.astype(np.float32), (_BLUR, _BLUR, 0)) for image in images]
    few = -(-len(images) // _MOST)
    points = patch.points()
    texture, noise = _texture(
        np.stack(
            [
                _colors(image, camera, points, subject)
                for image, camera in zip(images[::few], cameras[::few], strict=True)
            ]
        )
    )
    found = []
    for image, camera in zip(images, cameras, strict=True):
        off = np.abs(image - _sampled(texture, patch.texel(camera))).max(axis=-1) / noise
        # Single pixels may look like the floor by chance, and those at an outline are of both.
        alike = ndimage.uniform_filter(np.nan_to_num(off, nan=_OTHER), _WINDOW) < _ALIKE
        other = ndimage.minimum_filter(np.nan_to_num(off, nan=np.inf), 3) > _OTHER
        found.append(np.where(np.isnan(off), 0, np.where(alike, -1, other)).astype(np.float32))
    return found


def _texture(seen: np.ndarray) -> tuple[np.ndarray, float]:
    """What most images show of the floor, (``_TEXELS``, ``_TEXELS``, 3), NaN where they do not agree or would
    anyway, and their noise; from what each shows, (images, texels, 3)."""
    told = np.isfinite(seen[..., 0]).sum(axis=0)
    middle = np.maximum(told - 1, 0)[None, :, None] // 2  # NaN is sorted to the end
    median = np.take_along_axis(np.sort(seen, axis=0), middle, axis=0)[0]
    off = np.abs(seen - median).max(axis=2)
    noise = max(_LEAST_NOISE, 1.5 * float(np.nanmedian(off)) if told.any() else 0)
    agreed = (told >= _FEWEST) & ((off < _OTHER * noise).sum(axis=0) >= _AGREEING * told)
    texture = median.reshape(_TEXELS, _TEXELS, 3)
    known = agreed.reshape(_TEXELS, _TEXELS) & _patterned(texture, noise)
    return np.where(known[..., None], texture, np.nan), noise


def _patterned(texture: np.ndarray, noise: float) -> np.ndarray:
    """(h, w) where images can only agree if it is the floor that they show.

    On a plain object they agree on the floor behind it, too, and so they nearly do on its soft shading.
    """
    values, area = np.nan_to_num(texture), (_AREA, _AREA, 0)
    fine = values - ndimage.uniform_filter(values, area)
    # The filter's running sums can end a little below 0.
    spread = np.sqrt(np.maximum(ndimage.uniform_filter(fine**2, area), 0)).max(axis=-1)
    # Where a plain area ends there is a contrast, too.
    return ndimage.minimum_filter(spread > _PATTERN * noise, _AREA)


def _directions(camera: Camera) -> np.ndarray:
    """(height, width, 3) world directions of the pixels' centres, of depth 1."""
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    seen = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy], axis=-1)
    ideal = seen
    for _ in range(5 if camera.distortion else 0):
        ideal = seen - (camera.distortion.apply(ideal) - ideal)
    return np.concatenate([ideal, np.ones((*ideal.shape[:2], 1))], axis=-1) @ camera.to_world[:3, :3].T


def _colors(image: np.ndarray, camera: Camera, points: np.ndarray, subject: Subject) -> np.ndarray:
    """(n, 3) what an image shows at points; NaN beyond its frame, and behind the subject's core."""
    (u, v), free = (values.T for values in camera.project_front(points))
    if subject.core is not None:
        center, radius = subject.core
        ray = unit(points - camera.center)
        free = free & (np.linalg.norm(np.cross(ray, center - camera.center), axis=1) > radius)
    at = np.stack([v, u]).reshape(2, _TEXELS, _TEXELS) - 0.5
    return np.where(free[:, None], _sampled(image, at).reshape(-1, 3), np.nan)


def _sampled(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(h, w, 3) an image between its pixels, at rows and columns (2, h, w); NaN beyond its border."""
    import cv2

    row, column = np.nan_to_num(np.clip(at, -9, 1e4), nan=-9).astype(np.float32)
    return cv2.remap(
        image,
        column,
        row,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(np.nan, np.nan, np.nan),
    )
