"""LLFF's ``poses_bounds.npy``.

A row of 17 per image: a 3 x 5 matrix of camera-to-world rotation (camera axes down, right, backward),
position and (height, width, focal length), then the nearest and farthest depth. The principal point
is the image's centre. https://github.com/Fyusion/LLFF
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import UserError
from ..camera import Camera
from ..decoding import image_size, images_in
from ..file_names import entry_of
from ..frames import Capture, Frame, camera_for_image, pose_of


def find(source: Path) -> Path | None:
    """The npy file: the given one, or that in the folder."""
    if source.is_file():
        return source if source.suffix.lower() == ".npy" else None
    named = entry_of(source, "poses_bounds.npy")
    return named if named.is_file() else None


def read(source: Path, images: Path | None = None) -> Capture:
    """Reads ``poses_bounds.npy`` and the images in ``images/`` in the order of their names.

    Args:
        images: another folder, such as LLFF's shrunk copies ``images_4``.

    Raises:
        UserError: the file is malformed, or the numbers of poses and images differ.
    """
    path = find(source)
    assert path is not None, "``find`` knows the source"
    folder = images or entry_of(path.parent, "images")
    if not folder.is_dir():
        raise UserError(f"'{path}' has no folder 'images' beside it; name it with --images.")
    try:
        rows = np.load(path)
        rows = np.asarray(rows, dtype=np.float64)
    except Exception as error:
        raise UserError(f"'{path}' cannot be read ({error}); copy or export it again.") from error
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise UserError(
            f"'{path}' has the shape {rows.shape} where (images, 17) is expected; give LLFF's own file."
        )
    files = images_in(folder)
    if len(files) != len(rows):
        raise UserError(
            f"'{path}' has {len(rows)} poses, but '{folder}' has {len(files)} images; remove or "
            f"add what does not belong."
        )
    frames = []
    for index, (row, image) in enumerate(zip(rows, files, strict=True)):
        matrix = row[:15].reshape(3, 5)
        down, right, backward, center = matrix[:, :4].T
        owner = f"image {index} of '{path}'"
        pose = pose_of(np.stack([right, down, -backward, center], axis=1), owner)
        height, width, focal = matrix[:, 4]
        if not np.isfinite(row).all():
            raise UserError(
                f"The size, focal length or bounds of {owner} are NaN or infinite; export it again."
            )
        width, height = round(width), round(height)
        declared = Camera(width, height, focal, focal, width / 2, height / 2, pose)
        frames.append(Frame(image, camera_for_image(declared, image_size(image), image)))
    return Capture("LLFF", source, tuple(frames))
