"""NeRF's ``transforms*.json``: Blender's synthetic sets, instant-ngp and nerfstudio.

Camera-to-world matrices with the camera's x right, y up and z backwards; z is up in the world.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import UserError
from ..camera import Camera, Distortion
from ..decoding import SUFFIXES, image_size
from ..frames import Capture, Frame, camera_for_image, pose_of

_MODELS = ("", "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
#: Flags of instant-ngp for cameras that are no pinholes with OpenCV's distortion.
_OTHER_LENSES = ("is_fisheye", "ftheta_p0", "latlong", "equirectangular")
_Z_UP = np.array([0.0, 0.0, 1.0])


def find(source: Path) -> Path | None:
    """The folder or file, if it is such a capture."""
    if source.is_file():
        return source if source.suffix == ".json" else None
    return source if any(source.glob("transforms*.json")) else None


def read(source: Path, images: Path | None = None, *, opencv_axes: bool = False) -> Capture:
    """Reads a folder (``transforms_train.json`` and ``_test.json``, or ``transforms.json``) or one file.

    ``transforms_val.json`` takes the place of ``_test.json`` if there is none; nerfstudio's lists
    ``train_filenames``, ``val_filenames`` and ``test_filenames`` hold out what is not in the first.

    Args:
        source: the folder or file.
        images: unused: the files say where each image is.
        opencv_axes: take the camera's axes as right, down, forward, as some exporters wrongly write them.

    Raises:
        UserError: of anything in the files that is missing, malformed or not supported.
    """
    frames: list[Frame] = []
    for path, held_out in _files(source):
        frames += _read_file(path, held_out, opencv_axes)
    return Capture("NeRF transforms.json", source, tuple(frames), up=_Z_UP, has_opengl_axes=True)


def _files(source: Path) -> list[tuple[Path, bool]]:
    if source.is_file():
        return [(source, False)]
    train = source / "transforms_train.json"
    if train.is_file():
        held_out = [source / f"transforms_{split}.json" for split in ("test", "val")]
        return [(train, False), *[(path, True) for path in held_out if path.is_file()][:1]]
    if (source / "transforms.json").is_file():
        return [(source / "transforms.json", False)]
    found = sorted(source.glob("transforms*.json"))
    if len(found) != 1:
        names = ", ".join(path.name for path in found)
        raise UserError(f"'{source}' has {names}, and neither transforms.json nor transforms_train.json; "
                        f"give the file that you want instead of the folder.")
    return [(found[0], False)]


def _read_file(path: Path, held_out: bool, opencv_axes: bool) -> list[Frame]:
    document = _load(path)
    entries = document.get("frames")
    if not isinstance(entries, list) or not entries:
        raise UserError(f"'{path}' has no list of frames; it is no NeRF capture, or an empty one.")
    held = {name for key in ("val_filenames", "test_filenames") for name in document.get(key) or ()}
    held -= set(document.get("train_filenames") or ())
    frames = []
    for index, entry in enumerate(entries):
        owner = f"frame {index} of '{path}'"
        if not isinstance(entry, dict):
            raise UserError(f"Frame {index} of '{path}' is not an object with file_path and "
                            f"transform_matrix; export the capture again.")
        image = _file(path, entry.get("file_path"), owner)
        pose = pose_of(entry.get("transform_matrix"), owner)
        pose = pose if opencv_axes else Camera.opengl_pose(pose)
        camera = _camera({**document, **entry}, pose, image, owner)
        mask = entry.get("mask_path")
        frames.append(Frame(image, camera, _file(path, mask, owner) if mask else None,
                            held_out or entry.get("file_path") in held))
    return frames


def _load(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise UserError(f"'{path}' is no JSON file ({error}); export the capture again.") from error
    if not isinstance(document, dict):
        raise UserError(f"'{path}' holds a JSON {type(document).__name__} where an object with frames is "
                        f"expected; export the capture again.")
    return document


def _file(path: Path, name: object, owner: str) -> Path:
    """The image or mask that a frame names, whether with its suffix or without."""
    if not isinstance(name, str) or not name:
        raise UserError(f"The file_path or mask_path of {owner} is not a file's name; export the capture "
                        "again.")
    named = path.parent / name.replace("\\", "/")
    # Blender's sets leave the suffix out; a name's own dots are no suffix.
    candidates = [named, *(named.with_name(named.name + suffix) for suffix in SUFFIXES)]
    found = next((candidate for candidate in candidates if candidate.is_file()), None)
    if found is None:
        raise UserError(f"Image '{named}' of {owner} is missing, with or without a suffix such as .png; put "
                        f"it there.")
    return found


def _camera(values: dict[str, Any], pose: np.ndarray, image: Path, owner: str) -> Camera:
    model = str(values.get("camera_model") or "").upper()
    other = model if model not in _MODELS else next((key for key in _OTHER_LENSES if values.get(key)), None)
    if other:
        raise UserError(f"The camera of {owner} is of the kind {other}, which is not supported; undistort "
                        f"the images to a pinhole camera first.")

    def number(key: str, default: float | None = None, *, positive: bool = False) -> float | None:
        value = values.get(key)
        if value is None:
            return default
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise UserError(f"'{key}' of {owner} is {value!r}, not a number; export the capture again.")
        if positive and value <= 0:
            raise UserError(f"'{key}' of {owner} is {value:g}, and must be positive; export the capture "
                            "again.")
        return float(value)

    size = image_size(image)
    width = round(number("w", size[0], positive=True))
    height = round(number("h", size[1], positive=True))
    fx = number("fl_x", positive=True) or _focal(number("camera_angle_x", positive=True), width, owner)
    fy = number("fl_y", positive=True) or _focal(number("camera_angle_y", positive=True), height, owner)
    if fx is None and fy is None:
        raise UserError(f"{owner[0].upper()}{owner[1:]} has no focal length: neither fl_x nor "
                        f"camera_angle_x; add one, in pixels or radians.")
    distortion = Distortion(*(number(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4")))
    declared = Camera(width, height, fx or fy, fy or fx, number("cx", width / 2), number("cy", height / 2),
                      pose, distortion)
    return camera_for_image(declared, size, image)


def _focal(angle: float | None, size: int, owner: str) -> float | None:
    if angle is None:
        return None
    if angle >= math.pi:
        raise UserError(f"The camera angle of {owner} is {angle:g}, but it is in radians and below pi; "
                        f"convert it from degrees.")
    return size / 2 / math.tan(angle / 2)
