"""Where the object is, from cameras and sparse points alone: above the plane that it stands on."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..errors import UserError
from .camera import Camera

#: Fewer points tell nothing of a plane or an object.
_FEW = 30
#: A point belongs to a plane up to this share of the radius that is looked at.
_FLAT = 0.02
#: A plane needs this share of the points; of the rest, as much above it, and no more below.
_PLANE, _ABOVE, _BELOW = 0.08, 0.1, 0.1
#: Smaller clusters than this share of the object's points are left out.
_CLUSTER = 0.03
#: Radius of the core, as a share of that of the sphere that the frames hold.
_CORE = 0.4


@dataclass(frozen=True)
class Subject:
    """What the photographs are of.

    Attributes:
        box: (2, 3) corners, in the capture's world, of a box that holds the object with some room.
        points: (n, 3) points on the object, of its textured parts; none if there are too few to tell.
        floor: (4,) unit normal, towards the cameras, and offset of the plane that it stands on: ``normal .
            x + offset`` is a point's height; None if there is none.
        core: centre (3,) and radius of a ball about what the cameras look at, much of it the object; None if
            nobody knows.
    """

    box: np.ndarray
    points: np.ndarray
    floor: np.ndarray | None = None
    core: tuple[np.ndarray, float] | None = None

    @property
    def up(self) -> np.ndarray | None:
        return None if self.floor is None else self.floor[:3]


def find_subject(cameras: list[Camera], points: np.ndarray) -> Subject | None:
    """The object that cameras look at.

    Args:
        cameras: of the photographs.
        points: (n, 3) in their world, on the object and on what is around it; there may be none.

    Returns:
        None if the cameras look at no common point.
    """
    center = _looked_at(cameras)
    if center is None:
        return None
    radius = _framed(cameras, center)
    box, core = np.stack([center - radius, center + radius]), (center, _CORE * radius)
    near = points[np.linalg.norm(points - center, axis=1) < radius] if len(points) else points
    if len(near) < _FEW:
        return Subject(box, near[:0], core=core)
    floor = _floor(near, cameras, radius)
    on_object = near if floor is None else near[near @ floor[:3] + floor[3] > 2 * _FLAT * radius]
    if len(on_object) < _FEW:
        return Subject(box, on_object[:0], floor, core)
    on_object = _clusters(on_object)
    low, high = on_object.min(axis=0), on_object.max(axis=0)
    room = 0.1 * np.ptp(on_object, axis=0).max()
    box = np.stack([np.minimum(box[0], low - room), np.maximum(box[1], high + room)])
    return Subject(box, on_object, floor, core)


def _looked_at(cameras: list[Camera]) -> np.ndarray | None:
    """The point nearest to all optical axes, those that pass far by it left out."""
    kept = np.arange(len(cameras))
    for _ in range(3):
        lines, offsets = np.zeros((3, 3)), np.zeros(3)
        for index in kept:
            across = np.eye(3) - np.outer(cameras[index].forward, cameras[index].forward)
            lines += across
            offsets += across @ cameras[index].center
        if np.linalg.eigvalsh(lines)[0] < 1e-4 * len(kept):
            return None
        point = np.linalg.solve(lines, offsets)
        to_point = np.array([point - camera.center for camera in cameras])
        along = np.einsum("ij,ij->i", to_point, [camera.forward for camera in cameras])
        across = np.linalg.norm(to_point, axis=1) ** 2 - along**2
        ratio = np.sqrt(np.maximum(across, 0)) / np.maximum(along, 1e-9)
        kept = np.flatnonzero((along > 0) & (ratio <= max(3 * np.median(ratio), 0.05)))
        if len(kept) < 3:
            return None
    return point


def _framed(cameras: list[Camera], center: np.ndarray) -> float:
    """The radius of the sphere about a point that half of the frames hold."""
    radii = []
    for camera in cameras:
        depth = float((center - camera.center) @ camera.forward)
        if depth > 0:
            u, v = camera.project(center[None])[0]
            room = min(u, v, camera.width - u, camera.height - v)
            radii.append(max(room, 0.1 * camera.width) * depth / camera.fx)
    return float(np.median(radii))


def _floor(points: np.ndarray, cameras: list[Camera], radius: float, trials: int = 2000) -> np.ndarray | None:
    """The plane with most points that has the cameras and the other points on one side."""
    rng = np.random.default_rng(0)
    centers = np.array([camera.center for camera in cameras])
    best, most = None, max(_PLANE * len(points), _FEW)
    for _ in range(trials):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        size = np.linalg.norm(normal)
        if size < 1e-3 * radius**2:
            continue
        plane = _plane_seen_from(normal / size, a, centers)
        if plane is not None and (count := _support(points, plane, radius)) > most:
            best, most = plane, count
    if best is None:
        return None
    flat = points[np.abs(points @ best[:3] + best[3]) < _FLAT * radius]
    normal = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2][2]
    return _plane_seen_from(normal, flat.mean(axis=0), centers)


def _plane_seen_from(normal: np.ndarray, point: np.ndarray, centers: np.ndarray) -> np.ndarray | None:
    """(4,) the plane with its normal towards the cameras; None if they stand on both sides."""
    side = (centers - point) @ normal
    share = (side > 0).mean()
    if 0.1 < share < 0.9:
        return None
    normal = normal if share >= 0.9 else -normal
    return np.array([*normal, -normal @ point])


def _support(points: np.ndarray, plane: np.ndarray, radius: float) -> int:
    """Points in the plane; 0 if too few others are above it, or too many below."""
    height = points @ plane[:3] + plane[3]
    above, below = (height > 2 * _FLAT * radius).sum(), (height < -2 * _FLAT * radius).sum()
    fits = above > _ABOVE * len(points) and below < _BELOW * above
    return int((np.abs(height) < _FLAT * radius).sum()) if fits else 0


def _clusters(points: np.ndarray) -> np.ndarray:
    """The points in clusters of some size; few that are far off are mistakes of the matching."""
    distance = cKDTree(points).query(points, k=min(4, len(points)))[0][:, -1]
    pairs = cKDTree(points).sparse_distance_matrix(cKDTree(points), 6 * np.median(distance), p=2)
    label = connected_components(pairs, directed=False)[1]
    size = np.bincount(label)
    return points[size[label] >= _CLUSTER * len(points)]


def sparse_points(model: Path, shortest: int = 3) -> np.ndarray:
    """The points (n, 3) of a COLMAP model that at least ``shortest`` photographs show; none without a file.

    A binary file that is cut off gives those before its end.

    Raises:
        UserError: a coordinate is no number.
    """
    if (model / "points3D.bin").is_file():
        return _points_bin((model / "points3D.bin").read_bytes(), shortest)
    points, file = [], model / "points3D.txt"
    if file.is_file():
        for number, line in enumerate(file.read_text(errors="replace").splitlines(), start=1):
            words = line.split()
            if line.startswith("#") or len(words) < 8 + 2 * shortest:
                continue
            try:
                points.append([float(word) for word in words[1:4]])
            except ValueError:
                raise UserError(f"'{file}' is malformed in line {number}; export the model again.") from None
    return np.array(points, dtype=np.float64).reshape(-1, 3)


def _points_bin(data: bytes, shortest: int) -> np.ndarray:
    head, points, at = struct.Struct("<Q3d3BdQ"), [], 8
    while at + head.size <= len(data):
        _, x, y, z, *_, track = head.unpack_from(data, at)
        at += head.size + 8 * track
        if track >= shortest:
            points.append((x, y, z))
    return np.array(points, dtype=np.float64).reshape(-1, 3)
