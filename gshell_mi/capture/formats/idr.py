"""IDR's and NeuS's ``cameras*.npz``: DTU, BlendedMVS and what follows them.

``world_mat_i`` is a projection ``K [R | t]`` from the world to pixels with integer centres (0, 0), and
``scale_mat_i`` maps the unit sphere, which holds the object, to the world. In DVR's files of the same names
``world_mat_i`` is ``[R | t]`` alone, and ``camera_mat_i`` is ``K`` for an image from -1 to 1.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.linalg import rq

from ...errors import UserError
from ..camera import Camera
from ..decoding import image_size, images_in
from ..file_names import entry_of
from ..frames import Capture, Frame, camera_for_image, pose_of

_NAMES = ("cameras_sphere.npz", "cameras.npz", "cameras_large.npz")
#: Bytes that the matrices may take; 100 000 views take a quarter.
_LARGEST = 1 << 26
_FOLDERS = ("image", "images", "rgb")


def find(source: Path) -> Path | None:
    """The npz file: the given one, or that in the folder."""
    if source.is_file():
        return source if source.suffix.lower() == ".npz" else None
    named = [path for path in (entry_of(source, name) for name in _NAMES) if path.is_file()]
    return next(iter(named or sorted(source.glob("cameras*.npz"))), None)


def read(source: Path, images: Path | None = None) -> Capture:
    """Reads ``cameras*.npz`` and the images in ``image/`` (or ``images/``, ``rgb/``) in the order of names.

    Raises:
        UserError: the file is malformed, or the numbers of cameras and images differ.
    """
    path = find(source)
    assert path is not None, "``find`` knows the source"
    root = source if source.is_dir() else source.parent
    named = (entry_of(root, name) for name in _FOLDERS)
    folder = images or next((path for path in named if path.is_dir()), None)
    if folder is None:
        raise UserError(f"'{path}' has no folder 'image' beside it; name it with --images.")
    files = images_in(folder)
    try:
        with np.load(path) as stored:
            unpacked = sum(entry.file_size for entry in stored.zip.infolist())
            if unpacked > _LARGEST:
                raise ValueError(f"it unpacks to {unpacked >> 20} MiB")
            arrays = {
                key: np.array(stored[key], dtype=np.float64)
                for key in stored.files
                if key.startswith(("world_mat_", "scale_mat_", "camera_mat_")) and "_inv" not in key
            }
    except Exception as error:
        raise UserError(f"'{path}' cannot be read ({error}); copy or export it again.") from error
    count = sum(key.startswith("world_mat_") for key in arrays)
    if count == 0:
        raise UserError(
            f"'{path}' has no world_mat_0, so it holds no IDR or NeuS cameras; give another file."
        )
    if count != len(files):
        raise UserError(
            f"'{path}' has {count} cameras, but '{folder}' has {len(files)} images; remove or "
            f"add what does not belong."
        )
    frames, regions = [], []
    for index, image in enumerate(files):
        owner = f"camera {index} of '{path}'"
        world = arrays.get(f"world_mat_{index}", np.zeros(0))
        frames.append(Frame(image, _camera(world, arrays.get(f"camera_mat_{index}"), image, owner)))
        scale = arrays.get(f"scale_mat_{index}")
        # NaN, infinity and what nobody can compute with is no region.
        if scale is not None and scale.shape == (4, 4) and (np.abs(scale) <= 1e12).all():
            radius = np.linalg.norm(scale[:3, :3], axis=1)
            regions.append([scale[:3, 3] - radius, scale[:3, 3] + radius])
    region = np.mean(regions, axis=0) if regions else None
    return Capture("IDR / NeuS", source, tuple(frames), region=region)


def _camera(matrix: np.ndarray, given: np.ndarray | None, image: Path, owner: str) -> Camera:
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise UserError(f"The world_mat of {owner} is no finite 4 x 4 matrix; export the cameras again.")
    size = image_size(image)
    projection = matrix[:3]
    if np.allclose(projection[:, :3] @ projection[:, :3].T, np.eye(3), atol=1e-3):
        projection = _to_pixels(given, size, owner) @ projection
    # A projection means the same with the opposite sign; depth is to grow forwards.
    projection = projection * np.sign(np.linalg.det(projection[:, :3]) or 1.0)
    intrinsic, rotation = rq(projection[:, :3])
    if abs(intrinsic[2, 2]) < 1e-12 or np.abs(np.diag(intrinsic)).min() < 1e-12:
        raise UserError(f"The world_mat of {owner} is singular; export the cameras again.")
    signs = np.diag(np.sign(np.diag(intrinsic)))
    intrinsic, rotation = intrinsic @ signs, signs @ rotation
    center = -np.linalg.solve(projection[:, :3], projection[:, 3])
    intrinsic /= intrinsic[2, 2]
    if abs(intrinsic[0, 1]) > 1e-3 * intrinsic[0, 0]:
        raise UserError(
            f"The world_mat of {owner} has skewed pixels, which are not supported; resample its image."
        )
    pose = pose_of(np.concatenate([rotation.T, center[:, None]], axis=1), owner)
    # Half a pixel: from integer centres to corners at integers.
    cx, cy = intrinsic[:2, 2] + 0.5
    return camera_for_image(Camera(*size, intrinsic[0, 0], intrinsic[1, 1], cx, cy, pose), size, image)


def _to_pixels(intrinsic: np.ndarray | None, size: tuple[int, int], owner: str) -> np.ndarray:
    """(3, 3) from camera axes to pixels with integer centres; ``camera_mat`` is for an image from -1 to 1."""
    if intrinsic is None or intrinsic.shape not in ((3, 3), (4, 4)) or not np.isfinite(intrinsic).all():
        raise UserError(
            f"The world_mat of {owner} is a pose without a focal length, and there is no finite "
            f"camera_mat with it; export the cameras as K [R | t]."
        )
    width, height = size
    film = np.array([[width / 2, 0, (width - 1) / 2], [0, height / 2, (height - 1) / 2], [0, 0, 1]])
    return film @ intrinsic[:3, :3]
