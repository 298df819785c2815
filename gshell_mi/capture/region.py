"""Where the object is: from the lines of sight through the masks and from the volume that they share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from .camera import Camera

#: Masks are shrunk to this many pixels for the search.
MASK_SIZE = 160
#: Points per side of the grid that is carved.
_GRID = 48
#: Views, at most, whose common volume all are held against.
_MOST_JUDGES = 64
#: Share of the box's half side that the common volume fills.
_FILL = 0.92


@dataclass(frozen=True)
class Silhouette:
    """A small mask and its camera.

    Attributes:
        camera: for the mask's size; no distortion.
        alpha: (height, width) coverage.
        known: (height, width) share of each pixel of which coverage is known; None is everything.
    """

    camera: Camera
    alpha: np.ndarray
    known: np.ndarray | None = None

    @property
    def possible(self) -> np.ndarray:
        """(height, width) the largest coverage that what is known allows."""
        return self.alpha if self.known is None else np.maximum(self.alpha, 1 - self.known)

    @property
    def is_empty(self) -> bool:
        return not (self.alpha >= 0.5).any()

    def centroid(self) -> np.ndarray:
        """Pixel coordinates of the covered pixels' mean."""
        rows, columns = np.nonzero(self.alpha >= 0.5)
        return np.array([columns.mean(), rows.mean()]) + 0.5

    def radius(self) -> float:
        """Largest distance of a covered pixel from the centroid, in units of the focal length."""
        rows, columns = np.nonzero(self.alpha >= 0.5)
        offset = np.stack([columns, rows], axis=-1) + 0.5 - self.centroid()
        return float(np.linalg.norm(offset, axis=1).max() + 0.5) / self.camera.fx

    def direction(self, pixels: np.ndarray) -> np.ndarray:
        """World directions (n, 3), of depth 1, through pixel coordinates (n, 2)."""
        size = [self.camera.width, self.camera.height]
        film = np.concatenate([pixels / size, np.ones((len(pixels), 1))], axis=1)
        return film @ self.camera.basis().T


def common_point(silhouettes: list[Silhouette]) -> np.ndarray | None:
    """The point nearest to all lines of sight through the masks' centroids; None if they are parallel."""
    lines, offsets = np.zeros((3, 3)), np.zeros(3)
    for silhouette in silhouettes:
        ray = silhouette.direction(silhouette.centroid()[None])[0]
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        lines += across
        offsets += across @ silhouette.camera.center
    if np.linalg.eigvalsh(lines)[0] < 1e-4 * len(silhouettes):
        return None
    return np.linalg.solve(lines, offsets)


class Carving:
    """The volume that all masks share, tested at points.

    A point is kept if no view excludes it by more than ``slack``, so that a coarse grid misses nothing
    thin. A view excludes what falls beside its mask and what is unknown there, and what it does not frame if
    its mask keeps clear of the border, for then it shows the whole object. Daylight that a mask encloses
    excludes nothing, as in ``fields.visual_hull``.
    """

    def __init__(self, silhouettes: list[Silhouette]):
        self._views = []
        for silhouette in silhouettes:
            inside = ndimage.binary_fill_holes(silhouette.possible >= 0.5)
            mask = silhouette.alpha >= 0.5
            whole = not (mask[[0, -1]].any() or mask[:, [0, -1]].any())
            self._views.append((silhouette.camera, ndimage.distance_transform_edt(~inside), whole))

    def keeps(self, points: np.ndarray, slack: float) -> np.ndarray:
        """(n,) booleans of points (n, 3); ``slack`` in world units."""
        kept = np.arange(len(points))
        for camera, distance, whole in self._views:
            local = (points[kept] - camera.center) @ camera.to_world[:3, :3]
            depth = local[:, 2]
            front = depth > 1e-6
            pixel = camera.fx / np.where(front, depth, 1.0)
            u, v = local[:, 0] * pixel + camera.cx, local[:, 1] * pixel + camera.cy
            column = np.clip(u, 0, camera.width - 1).astype(int)
            row = np.clip(v, 0, camera.height - 1).astype(int)
            beyond = np.hypot(u - np.clip(u, 0, camera.width), v - np.clip(v, 0, camera.height))
            near = distance[row, column] + beyond <= slack * pixel + 1.0
            near = np.where(front, near if whole else near | (beyond > 0), not whole)
            kept = kept[near]
        result = np.zeros(len(points), bool)
        result[kept] = True
        return result


def find_box(silhouettes: list[Silhouette], region: np.ndarray | None = None) -> np.ndarray | None:
    """Corners (2, 3) of a cube around the volume that all masks share; None if there is no such volume.

    Args:
        silhouettes: of the training views, none empty.
        region: (2, 3) where to look first, if the capture says so.
    """
    if not silhouettes:
        return None
    if region is None:
        center = common_point(silhouettes)
        if center is None:
            return None
        depths = np.array([(center - s.camera.center) @ s.camera.forward for s in silhouettes])
        if (depths > 0).mean() < 0.5:
            return None
        seen = [s.radius() * depth for s, depth in zip(silhouettes, depths, strict=True) if depth > 0]
        half = 1.5 * max(seen)
    else:
        center, half = region.mean(axis=0), np.ptp(region, axis=0).max() / 2
    carving = Carving(silhouettes)
    axis = np.linspace(-1, 1, _GRID)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    for _ in range(8):
        spacing = 2 * half / (_GRID - 1)
        inside = center + half * grid[carving.keeps(center + half * grid, 0.5 * spacing)]
        if len(inside) == 0:
            return None
        low, high = inside.min(axis=0) - spacing / 2, inside.max(axis=0) + spacing / 2
        extent = (high - low).max() / 2
        if extent > half * 0.999:  # it goes on beyond the cube
            center, half = (low + high) / 2, 1.6 * half
            continue
        settled = extent > 0.75 * half
        center, half = (low + high) / 2, extent / _FILL
        if settled:
            break
    return np.stack([center - half, center + half])


def agreement(silhouettes: list[Silhouette], box: np.ndarray, rays: int = 32) -> np.ndarray:
    """Per view the share of its mask that the volume common to all masks, inside the box, explains.

    With right cameras it is 1 up to the masks' errors. Of very many views, some spread over the rest make up
    the common volume, so that the time grows with the number of views and not with its square.
    """
    judges = silhouettes[:: -(-len(silhouettes) // _MOST_JUDGES)]
    rng = np.random.default_rng(0)
    center, half = box.mean(axis=0), np.ptp(box, axis=0).max() / 2
    # Along a ray, from its entry into the sphere around the box to its exit.
    steps = np.linspace(-1, 1, 2 * _GRID)
    points = np.full((len(silhouettes), rays, len(steps), 3), np.nan)
    for view, silhouette in enumerate(silhouettes):
        rows, columns = np.nonzero(silhouette.alpha >= 0.5)
        if len(rows) == 0:
            continue
        chosen = rng.integers(len(rows), size=rays)
        ray = silhouette.direction(np.stack([columns[chosen], rows[chosen]], axis=-1) + 0.5)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        origin = silhouette.camera.center
        along = (center - origin) @ ray.T
        reach = np.sqrt(3) * half
        points[view] = origin + (along[:, None] + reach * steps)[..., None] * ray[:, None]
    flat = points.reshape(-1, 3)
    boxed = np.flatnonzero((np.abs(flat - center) <= half).all(axis=1))
    slack = np.sqrt(3) * half / (len(steps) - 1)
    kept = boxed[Carving(judges).keeps(flat[boxed], slack)]
    hit = np.zeros(len(flat), bool)
    hit[kept] = True
    share = hit.reshape(len(silhouettes), rays, -1).any(axis=2).mean(axis=1)
    return np.where([s.is_empty for s in silhouettes], 1.0, share)


_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
#: The misreading that the importer has an option for.
FLIPPED_AXES = "their y and z axes point the other way (OpenCV's and OpenGL's conventions are mixed up)"
_INVERSE = "their matrices are world-to-camera where camera-to-world is expected"
#: Ways to misread a pose: what would be the case, and how the camera-to-world matrix has to change.
_MISREADINGS = (
    (FLIPPED_AXES, lambda pose: pose @ _FLIP),
    (_INVERSE, lambda pose: np.linalg.inv(pose @ _FLIP) @ _FLIP),
    (_INVERSE, np.linalg.inv),
    (f"{_INVERSE}, and {FLIPPED_AXES}", lambda pose: np.linalg.inv(pose @ _FLIP)),
    ("their images are upside down", lambda pose: pose @ np.diag([-1.0, -1.0, 1.0, 1.0])),
)


def likely_misreading(silhouettes: list[Silhouette], to_scene: np.ndarray, limit: int = 40) -> str | None:
    """The misreading of the cameras under which their masks agree, if there is one.

    Args:
        to_scene: (4, 4) how the world was turned after the cameras had been read.
        limit: of the number of views that are tried.
    """
    some = silhouettes[:: max(len(silhouettes) // limit, 1)]
    to_capture = np.linalg.inv(to_scene)
    best, name = 0.9, None
    for candidate, reread in _MISREADINGS:
        poses = [reread(to_capture @ s.camera.to_world) for s in some]
        changed = [
            replace(s, camera=replace(s.camera, to_world=pose)) for s, pose in zip(some, poses, strict=True)
        ]
        box = find_box(changed)
        if box is not None and (score := float(agreement(changed, box).mean())) > best:
            best, name = score, candidate
    return name
