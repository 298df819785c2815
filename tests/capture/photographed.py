"""Photographs of a ball on a table, in closed form: what people have who have no cameras and no masks."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from gshell_mi.capture import Camera

RADIUS = 0.5
#: The table is the plane y = 0.
CENTER = np.array([0.0, RADIUS, 0.0])


def cameras(count: int, width: int = 320, height: int = 240, distance: float = 2.6) -> list[Camera]:
    """All around the ball, from two elevations, in order."""
    result = []
    for k in range(count):
        azimuth, elevation = 2 * np.pi * k / count, np.radians(25 if k % 2 else 40)
        direction = np.array(
            [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
        )
        forward = -direction
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(forward, right), forward, CENTER + distance * direction], axis=1)
        focal = 1.2 * width
        result.append(Camera(width, height, focal, focal, width / 2, height / 2, pose))
    return result


def _noise(seed: int, size: int, blur: float) -> np.ndarray:
    values = np.random.default_rng(seed).standard_normal((size, size))
    values = ndimage.gaussian_filter(values, blur, mode="wrap")
    return values / values.std()


_TABLE = _noise(1, 512, 1.5) + _noise(2, 512, 5)
_BALL = _noise(3, 512, 2) + _noise(4, 512, 6)


def photograph(camera: Camera, samples: int = 2, *, plain: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 3) uint8 photograph, reddish ball on bluish table, and (h, w) coverage.

    Args:
        plain: the ball has one colour, which is one of the table's.
    """
    n = samples
    v, u = (np.mgrid[: camera.height * n, : camera.width * n] + 0.5) / n
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    ray = ray @ camera.to_world[:3, :3].T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    to_ball = CENTER - camera.center
    along = ray @ to_ball
    room = RADIUS**2 - (to_ball @ to_ball - along**2)
    ball = (room > 0) & (along > 0)
    point = camera.center + (along - np.sqrt(np.maximum(room, 0)))[..., None] * ray - CENTER
    turn = (np.arctan2(point[..., 0], point[..., 2]) / (2 * np.pi) * 512).astype(int) % 512
    height = (np.arccos(np.clip(point[..., 1] / RADIUS, -1, 1)) / np.pi * 255).astype(int)
    on_ball = 0.5 + 0.15 * _BALL[height, turn]
    table = camera.center + ray * (-camera.center[1] / np.minimum(ray[..., 1], -1e-3))[..., None]
    cells = np.floor(table[..., [0, 2]] * 80).astype(int) % 512
    on_table = 0.5 + 0.15 * _TABLE[cells[..., 0], cells[..., 1]]
    color = np.where(
        ball[..., None], on_ball[..., None] * [1.0, 0.5, 0.3], on_table[..., None] * [0.4, 0.6, 1.0]
    )
    if plain:
        color[ball] = [0.2, 0.3, 0.5]
    rgba = np.concatenate([np.clip(color, 0, 1), ball[..., None]], axis=-1)
    rgba = rgba.reshape(camera.height, n, camera.width, n, 4).mean(axis=(1, 3))
    return (rgba[..., :3] * 255 + 0.5).astype(np.uint8), rgba[..., 3]


def points(seed: int = 0) -> np.ndarray:
    """(n, 3) sparse points, on the upper part of the ball and on the table around it."""
    rng = np.random.default_rng(seed)
    ball = rng.standard_normal((400, 3))
    ball = CENTER + RADIUS * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    table = np.zeros((500, 3))
    table[:, [0, 2]] = rng.uniform(-1.5, 1.5, (500, 2))
    strays = rng.uniform([-1, 0.2, -1], [1, 2.2, 1], (10, 3))
    return np.concatenate([ball[ball[:, 1] > 0.15], table, strays])


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union of two masks."""
    return float((first & second).sum() / (first | second).sum())
