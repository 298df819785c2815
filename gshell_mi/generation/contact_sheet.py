"""Pages of small pictures of many meshes, drawn as points: no renderer is needed, nor a variant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image, ImageDraw

from ..files import replacing
from .surface_points import surface_points

_FRONT, _BACK = np.array([0.36, 0.55, 0.72]), np.array([0.93, 0.55, 0.20])  # back faces are orange
_LIGHT = np.array([0.35, 0.65, 0.67])
_SUPER = 2  # points are drawn on a picture so much larger


def picture(
    mesh: trimesh.Trimesh, side: int = 128, *, azimuth: float = 0.5, elevation: float = 0.25, seed: int = 0
) -> np.ndarray:
    """(side, side, 3) uint8: the mesh, from [-1, 1]^3, as seen from afar, back faces in orange.

    Args:
        azimuth: of the viewer about the y axis, 0 on the z axis, in radians.
        elevation: of the viewer over the horizon, in radians.
    """
    size = _SUPER * side
    area = max(float(mesh.area), 1e-9)
    scale = size / 2 / 1.3
    count = int(np.clip(6 * area * scale**2, 2_000, 400_000))
    points, face = surface_points(mesh, count, seed)
    toward = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
    )
    right = np.array([np.cos(azimuth), 0, -np.sin(azimuth)])
    up = np.cross(toward, right)
    column = (size / 2 + scale * points @ right).astype(int)
    row = (size / 2 - scale * points @ up).astype(int)
    seen = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    column, row, face, depth = column[seen], row[seen], face[seen], (points @ toward)[seen]
    order = np.argsort(depth)  # the nearest is drawn last
    normals = mesh.face_normals[face]
    front = normals @ toward > 0
    light = right * _LIGHT[0] + up * _LIGHT[1] + toward * _LIGHT[2]
    shade = 0.25 + 0.75 * np.clip(np.where(front, 1, -1) * (normals @ light), 0, 1)
    image = np.ones((size, size, 3))
    image[row[order], column[order]] = (np.where(front[:, None], _FRONT, _BACK) * shade[:, None])[order]
    image = image.reshape(side, _SUPER, side, _SUPER, 3).mean(axis=(1, 3))
    return (255 * np.clip(image, 0, 1) ** (1 / 1.6)).astype(np.uint8)


def write_sheet(path: Path, pictures: list[np.ndarray], labels: list[str], columns: int = 8) -> None:
    """Writes pictures of one size, with a line under each, as one PNG."""
    side = pictures[0].shape[0]
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    sheet = Image.new("RGB", (columns * side, rows * (side + 14)), "white")
    pen = ImageDraw.Draw(sheet)
    for index, (image, label) in enumerate(zip(pictures, labels, strict=True)):
        left, top = index % columns * side, index // columns * (side + 14)
        sheet.paste(Image.fromarray(image), (left, top))
        pen.text((left + 3, top + side), label[: side // 6], fill=(60, 60, 60))
    with replacing(path) as partial:
        sheet.save(partial)
