"""Masks of photographs that come without: GrabCut in each view, tied across views by the hull they imply.

Where the floor behind the object is known, it tells what lies before it (see ``floor``). The rest of a view
is cut by its own colours: those outside the object's box are the background's, those where its sparse points
are seen are the object's (Rother et al., GrabCut, SIGGRAPH 2004). What nearly all views call the object is
its visual hull; its image in each view says what is certain there, and the views are cut anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from PIL import Image
from scipy import ndimage

from ..errors import UserError
from .camera import Camera
from .floor import floor_evidence
from .parallel import in_order
from .subject import Subject
from .workspace import Progress

#: Longer side, in pixels, of the images that are cut.
SIZE = 500
#: Per round: by how much the images are reduced, and the voxels along the longest side of the box.
_ROUNDS = ((2, 48), (2, 64), (1, 80))
#: The box grows on the sides that the first hull reaches, by this share of its size, so many times.
_GROWTH, _GROWTHS = 0.2, 4
#: Share of the views that may call a voxel of the object background.
_DISSENT = 0.12
#: OpenCV's codes of a guess.
_UNLIKELY, _LIKELY = 2, 3
#: A first cut that keeps less than this share of the guess has lost the object.
_LOST = 0.5
#: So does one of less than this share of the median's area.
_TINY = 0.1
#: Cuts of a view are trusted up to so many voxels from the hull's outline.
_BAND = 3.0
#: What is nearer to the floor than this share of the box may be floor.
_LIFT = 0.01


@dataclass(frozen=True)
class View:
    """A photograph to cut.

    Attributes:
        image: (height, width, 3) uint8, encoded.
        camera: for this size.
        prior: (height, width) probability that a pixel is the object's, from a network or from a photograph
            of the background; None without one.
        floor: (height, width) what is known from the floor, see ``floor.floor_evidence``; None if nothing.
    """

    image: np.ndarray
    camera: Camera
    prior: np.ndarray | None = None
    floor: np.ndarray | None = None

    def reduced(self, by: int) -> View:
        """A copy of a fraction of the size."""
        if by == 1:
            return self
        size = (self.camera.width // by, self.camera.height // by)
        prior, floor = (
            None if values is None else _resized(values, size) for values in (self.prior, self.floor)
        )
        image = np.array(Image.fromarray(self.image).resize(size, Image.Resampling.BOX))
        return View(image, self.camera.resized(*size), prior, floor)


def _resized(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(h, w) floats or booleans at another (width, height); booleans by their majority."""
    image = Image.fromarray(values.astype(np.float32)).resize(size, Image.Resampling.BILINEAR)
    return np.array(image) >= 0.5 if values.dtype == bool else np.array(image)


def cut_out(views: list[View], subject: Subject, progress: Progress | None = None) -> list[np.ndarray]:
    """Per view (height, width) booleans: the object.

    Args:
        views: of any number; with few, the hull says little.
        subject: where it is.
        progress: called with ("masks", done, in all).

    Raises:
        UserError: OpenCV is missing, or no view shows the object.
    """
    try:
        import cv2  # noqa: F401
    except ImportError:
        raise UserError(
            "The photographs have no masks, and making them takes OpenCV: install it with `pip "
            "install 'gshell_mi[masks]'`, or supply masks."
        ) from None
    done = 0

    def cut(
        reduction: int, grid: _Voxels, hull: np.ndarray | None, masks: Sequence[np.ndarray | None]
    ) -> tuple[list[View], list[np.ndarray]]:
        nonlocal done
        reduced, cuts = [view.reduced(reduction) for view in views], []
        for mask in in_order(partial(_cut, subject, grid, hull), list(zip(reduced, masks, strict=True))):
            cuts.append(mask)
            done = min(done + 1, len(_ROUNDS) * len(views))
            if progress:
                progress("masks", done, len(_ROUNDS) * len(views))
        return reduced, cuts

    reduced = [view.reduced(_ROUNDS[0][0]) for view in views]
    evidence = floor_evidence([view.image for view in reduced], [view.camera for view in reduced], subject)
    views = [
        replace(view, floor=_resized(floor, view.image.shape[1::-1]))
        for view, floor in zip(views, evidence, strict=True)
    ]
    for _ in range(_GROWTHS):
        grid = _Voxels(subject, _ROUNDS[0][1])
        reduced, masks = cut(_ROUNDS[0][0], grid, None, [None] * len(views))
        grown = grid.grown(_hull(grid, reduced, masks))
        if (grown == subject.box).all():
            break
        subject, done = replace(subject, box=grown), 0
    for reduction, voxels in _ROUNDS[1:]:
        grid = _Voxels(subject, voxels)
        reduced, masks = cut(reduction, grid, _hull(grid, reduced, masks), masks)
    hull = _hull(grid, reduced, masks)
    return [_tidied(mask, grid.seen_by(view.camera, hull)) for view, mask in zip(views, masks, strict=True)]


def _hull(grid: _Voxels, views: list[View], masks: list[np.ndarray]) -> np.ndarray:
    """(n,) the voxels at the surface of the hull; the others are seen behind these in every view."""
    hull = grid.carve(views, masks)
    if not hull.any():
        raise UserError(
            "The object could not be told from its background; supply masks with --masks, or "
            "give --background or --box."
        )
    return grid.surface(hull)


def _cut(
    subject: Subject, grid: _Voxels, hull: np.ndarray | None, work: tuple[View, np.ndarray | None]
) -> np.ndarray:
    view, mask = work
    if mask is not None:
        mask = _resized(mask, view.image.shape[1::-1])
    trimap = _trimap(view, subject, grid, hull, mask)
    cut = _grab_cut(view.image, trimap)
    guessed = trimap == _LIKELY
    if hull is None and cut.sum() < _LOST * guessed.sum():
        # The guess was too small: the object's colours went to the background. All of the box, then.
        cut = _grab_cut(view.image, np.where(trimap == _UNLIKELY, _LIKELY, trimap).astype(np.uint8))
    return cut


class _Voxels:
    """The box as a grid of voxels above the floor."""

    def __init__(self, subject: Subject, count: int):
        self.box = subject.box
        low, high = self.box
        self.size = float(np.ptp(subject.box, axis=0).max()) / count
        axes = [np.arange(a + self.size / 2, b, self.size) for a, b in zip(low, high, strict=True)]
        self.shape = tuple(len(axis) for axis in axes)
        self.points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self.allowed = np.ones(len(self.points), bool)
        if subject.floor is not None:
            height = self.points @ subject.floor[:3] + subject.floor[3]
            self.allowed = height > _LIFT * count * self.size
        self.corners = self.points[np.flatnonzero(self.surface(self.allowed))[::7]]

    def pixels(self, camera: Camera, which: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows and columns of the chosen voxels' centres, and whether the frame holds them."""
        (u, v), front = (values.T for values in camera.project_front(self.points[which]))
        framed = front & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        return np.where(framed, v, 0).astype(int), np.where(framed, u, 0).astype(int), framed

    def carve(self, views: list[View], masks: list[np.ndarray]) -> np.ndarray:
        """(n,) the voxels that all but few of the views that frame them call the object.

        Views that lost the object, whose cuts are far smaller than most, have no say.
        """
        seen, against = np.zeros(len(self.points), np.int16), np.zeros(len(self.points), np.int16)
        which = np.flatnonzero(self.allowed)
        areas = np.array([mask.sum() for mask in masks])
        for view, mask in zip(views, masks, strict=True):
            if mask.sum() < _TINY * np.median(areas):
                continue
            row, column, framed = self.pixels(view.camera, which)
            seen[which] += framed
            against[which] += framed & ~mask[row, column]
        kept = self.allowed & (against <= _DISSENT * seen) & (seen >= max(2, 0.3 * len(views)))
        label, count = ndimage.label(kept.reshape(self.shape))
        if count > 1:  # the object is one thing, perhaps with loose parts of some size
            volume = np.bincount(label.ravel())
            volume[0] = 0
            kept &= (volume >= 0.02 * volume.max())[label].ravel()
        return kept

    def within(self, center: np.ndarray, radius: float) -> np.ndarray:
        """(n, 3) the centres of the voxels of a ball above the floor."""
        return self.points[self.allowed & (np.linalg.norm(self.points - center, axis=1) < radius)]

    def grown(self, surface: np.ndarray) -> np.ndarray:
        """(2, 3) the box, larger on the sides that the voxels at a hull's surface reach."""
        filled = surface.reshape(self.shape)
        box = self.box.copy()
        for axis in range(3):
            for side, layer in enumerate((0, -1)):
                if filled.take(layer, axis=axis).any():
                    box[side, axis] += (2 * side - 1) * _GROWTH * np.ptp(self.box, axis=0).max()
        return box

    def surface(self, which: np.ndarray) -> np.ndarray:
        """(n,) those of the chosen voxels that are not wholly among others."""
        solid = which.reshape(self.shape)
        return which & ~ndimage.binary_erosion(solid, np.ones((3, 3, 3))).ravel()

    def seen_by(self, camera: Camera, which: np.ndarray) -> np.ndarray:
        """(height, width) booleans: the image of what the chosen voxels enclose, without its holes, if they
        have any, of less than a voxel."""
        chosen = np.flatnonzero(which)
        row, column, framed = self.pixels(camera, chosen)
        result = np.zeros((camera.height, camera.width), bool)
        result[row[framed], column[framed]] = True
        # A voxel's image is larger than a pixel.
        reach = int(np.ceil(self.pixels_per_voxel(camera) / 2))
        return ndimage.binary_closing(np.pad(result, reach), np.ones((3, 3)), iterations=reach)[
            reach:-reach, reach:-reach
        ]

    def pixels_per_voxel(self, camera: Camera) -> float:
        depth = (self.points.mean(axis=0) - camera.center) @ camera.forward
        return float(self.size * camera.fx / max(depth, 1e-9))


def _trimap(
    view: View, subject: Subject, grid: _Voxels, hull: np.ndarray | None, mask: np.ndarray | None
) -> np.ndarray:
    """What is known of a view, in OpenCV's codes."""
    import cv2

    camera = view.camera
    boxed = _solid(camera, grid.corners)
    result = np.full(boxed.shape, cv2.GC_PR_BGD, np.uint8)
    if hull is None:
        result[_solid(camera, subject.points)] = cv2.GC_PR_FGD
        if subject.core is not None:
            result[_solid(camera, grid.within(*subject.core))] = cv2.GC_PR_FGD
        if view.prior is not None:
            result[view.prior >= 0.5] = cv2.GC_PR_FGD
            result[view.prior < 0.5] = cv2.GC_PR_BGD
        if view.floor is not None:
            result[view.floor > 0.5] = cv2.GC_FGD
            result[view.floor < -0.5] = cv2.GC_BGD
    else:
        image = grid.seen_by(camera, hull)
        band = _BAND * grid.pixels_per_voxel(camera)
        outside, inside = ndimage.distance_transform_edt(~image), ndimage.distance_transform_edt(image)
        result[mask] = cv2.GC_PR_FGD
        result[inside > band / 2] = cv2.GC_PR_FGD
        if view.floor is not None:
            result[view.floor > 0.5] = cv2.GC_PR_FGD
            result[(view.floor > 0.5) & image] = cv2.GC_FGD
            result[view.floor < -0.5] = cv2.GC_BGD
        result[inside > band] = cv2.GC_FGD
        result[outside > band] = cv2.GC_BGD
    result[~boxed] = cv2.GC_BGD
    return result


def _solid(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(height, width) the convex hull of the points' image."""
    import cv2

    result = np.zeros((camera.height, camera.width), np.uint8)
    if len(points) >= 3:
        pixels = np.clip(camera.project(points), -1e4, 1e4).astype(np.float32)
        outline = cv2.convexHull(pixels).astype(np.int32)
        cv2.fillConvexPoly(result, outline, 1)
    return result > 0


def _grab_cut(image: np.ndarray, trimap: np.ndarray) -> np.ndarray:
    import cv2

    possible = trimap != cv2.GC_BGD
    if not (possible & (trimap != cv2.GC_PR_BGD)).any() or possible.all():
        return np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))
    # The background's colours are learned from what is near: a margin of a quarter of the box.
    rows, columns = np.flatnonzero(possible.any(axis=1)), np.flatnonzero(possible.any(axis=0))
    margin = max(len(rows), len(columns)) // 4
    window = (
        slice(max(rows[0] - margin, 0), rows[-1] + margin),
        slice(max(columns[0] - margin, 0), columns[-1] + margin),
    )
    marked = trimap[window].copy()
    cv2.setRNGSeed(0)
    nowhere = (0, 0, 0, 0)  # the mask says where to begin
    cv2.grabCut(
        np.ascontiguousarray(image[window]),
        marked,
        nowhere,
        np.zeros((1, 65)),
        np.zeros((1, 65)),
        4,
        cv2.GC_INIT_WITH_MASK,
    )
    result = np.zeros(trimap.shape, bool)
    result[window] = np.isin(marked, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return result


def _tidied(mask: np.ndarray, hull: np.ndarray) -> np.ndarray:
    """Without specks: pieces that the hull does not know, and holes of a few pixels."""
    label, count = ndimage.label(mask)
    if count:
        known = np.bincount(label.ravel(), weights=hull.ravel(), minlength=count + 1) > 0
        known[0] = False
        mask = known[label]
    holes, count = ndimage.label(~mask)
    if count:
        size = np.bincount(holes.ravel())
        mask = mask | ((size < 2e-4 * mask.size)[holes] & (holes > 0))
    return mask
