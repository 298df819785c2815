"""NeRF's ``transforms*.json``: Blender's synthetic sets, instant-ngp and nerfstudio.

Camera-to-world matrices with the camera's x right, y up and z backwards; z is up in the world.
"""

from __future__ import annotations

import math
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, overload

import numpy as np

from ...errors import UserError
from ...json_files import read_json
from ..camera import Camera, Distortion
from ..decoding import image_size
from ..file_names import Copies, entry_of, existing
from ..frames import Capture, Frame, camera_for_image, pose_of

_MODELS = ("", "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
#: Flags of instant-ngp for cameras that are no pinholes with OpenCV's distortion.
_OTHER_LENSES = ("is_fisheye", "ftheta_p0", "latlong", "equirectangular")
#: Beyond what any camera has; integers of JSON may be too large for floating point.
_LARGEST = 1e300
_Z_UP = np.array([0.0, 0.0, 1.0])


def find(source: Path) -> Path | None:
    """The folder or file, if it is such a capture."""
    if source.is_file():
        return source if source.suffix.lower() == ".json" else None
    return source if _transforms(source) else None


def read(source: Path, images: Path | None = None, *, opencv_axes: bool = False) -> Capture:
    """Reads a folder (``transforms_train.json`` and ``_test.json``, or ``transforms.json``) or one file.

    ``transforms_val.json`` takes the place of ``_test.json`` if there is none; nerfstudio's lists
    ``train_filenames``, ``val_filenames`` and ``test_filenames`` hold out what is not in the first, or,
    without it, what is in the others.

    Args:
        source: the folder or file.
        images: folder of other copies of the images, found there by as much of their paths as it has;
            default: where the files say.
        opencv_axes: take the camera's axes as right, down, forward, as some exporters wrongly write them.

    Raises:
        UserError: of anything in the files that is missing, malformed or not supported.
    """
    documents = [(path, held_out, _load(path)) for path, held_out in _files(source)]
    entries = [entry for _, _, document in documents for entry in document["frames"]]
    find = _Finder(images, entries)
    frames: list[Frame] = []
    for path, held_out, document in documents:
        frames += _frames(path, document, find, held_out, opencv_axes)
    return Capture("NeRF transforms.json", source, tuple(frames), up=_Z_UP, has_opengl_axes=True)


def _transforms(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*") if fnmatch(path.name.casefold(), "transforms*.json"))


def _files(source: Path) -> list[tuple[Path, bool]]:
    if source.is_file():
        return [(source, False)]
    train, plain = entry_of(source, "transforms_train.json"), entry_of(source, "transforms.json")
    if train.is_file():
        held_out = [entry_of(source, f"transforms_{split}.json") for split in ("test", "val")]
        return [(train, False), *[(path, True) for path in held_out if path.is_file()][:1]]
    if plain.is_file():
        return [(plain, False)]
    found = _transforms(source)
    if len(found) != 1:
        names = ", ".join(path.name for path in found)
        raise UserError(
            f"'{source}' has {names}, and neither transforms.json nor transforms_train.json; "
            f"give the file that you want instead of the folder."
        )
    return [(found[0], False)]


def _frames(
    path: Path, document: dict[str, Any], find: _Finder, held_out: bool, opencv_axes: bool
) -> list[Frame]:
    frames = []
    for index, entry in enumerate(document["frames"]):
        owner = f"frame {index} of '{path}'"
        if not isinstance(entry, dict):
            raise UserError(
                f"Frame {index} of '{path}' is not an object with file_path and "
                f"transform_matrix; export the capture again."
            )
        image = find(path, entry.get("file_path"), owner)
        pose = pose_of(entry.get("transform_matrix"), owner)
        pose = pose if opencv_axes else Camera.opengl_pose(pose)
        camera = _camera({**document, **entry}, pose, image, owner)
        mask = entry.get("mask_path")
        frames.append(Frame(image, camera, _mask(path, mask, owner) if mask else None, held_out))
    held = _held_out(document, frames, find, path)
    return [replace(frame, held_out=held_out or frame.image.resolve() in held) for frame in frames]


def _load(path: Path) -> dict[str, Any]:
    try:
        document = read_json(path)
    except (OSError, ValueError) as error:
        raise UserError(f"'{path}' is no JSON file ({error}); export the capture again.") from error
    if not isinstance(document, dict):
        raise UserError(
            f"'{path}' holds a JSON {type(document).__name__} where an object with frames is "
            f"expected; export the capture again."
        )
    if not isinstance(document.get("frames"), list) or not document["frames"]:
        raise UserError(f"'{path}' has no list of frames; it is no NeRF capture, or an empty one.")
    return document


class _Finder:
    """Finds the image that a frame names, beside the JSON file or in the folder of other copies."""

    def __init__(self, images: Path | None, entries: list):
        self.images = images
        names = [entry.get("file_path") for entry in entries if isinstance(entry, dict)]
        self.copies = Copies(name for name in names if isinstance(name, str))

    def __call__(self, path: Path, name: object, owner: str) -> Path:
        named = _named(path, name, owner)
        if self.images is None:
            found, where = existing(named), f"Image '{named}' of {owner} is missing"
            cure = "put it there, or name the folder of the images with --images"
        else:
            found = self.copies.find(self.images, str(name))
            where = f"Image '{name}' of {owner} is not in '{self.images}'"
            cure = "put it there under its own name, in folders as in its path where names repeat"
        if found is None:
            raise UserError(f"{where}, with or without a suffix such as .png; {cure}.")
        return found


def _named(path: Path, name: object, owner: str) -> Path:
    if not isinstance(name, str) or not name.strip("/\\ ") or "\0" in name:
        raise UserError(
            f"The file_path or mask_path of {owner} is not a file's name; export the capture again."
        )
    return path.parent / name.replace("\\", "/")


def _mask(path: Path, name: object, owner: str) -> Path:
    """The mask that a frame names, which need not exist: --masks may name others."""
    named = _named(path, name, owner)
    return existing(named) or named


def _held_out(document: dict[str, Any], frames: list[Frame], find: _Finder, path: Path) -> set[Path]:
    """The images that nerfstudio's lists keep from training; its names may be written in several ways."""
    shown = {frame.image.resolve() for frame in frames}
    lists = {}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        names = document.get(key)
        if names is None:
            continue
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise UserError(f"'{key}' of '{path}' is no list of file names; export the capture again.")
        lists[key] = {find(path, name, f"'{key}' of '{path}'").resolve() for name in names}
        unknown = sorted(lists[key] - shown)
        if unknown:
            raise UserError(
                f"'{key}' of '{path}' names '{unknown[0]}', which no frame shows; correct the list."
            )
    if lists.get("train_filenames"):
        return shown - lists["train_filenames"]
    return set().union(*lists.values())


def _camera(values: dict[str, Any], pose: np.ndarray, image: Path, owner: str) -> Camera:
    model = str(values.get("camera_model") or "").upper()
    other = model if model not in _MODELS else next((key for key in _OTHER_LENSES if values.get(key)), None)
    if other:
        raise UserError(
            f"The camera of {owner} is of the kind {other}, which is not supported; undistort "
            f"the images to a pinhole camera first."
        )

    @overload
    def number(key: str, default: float, *, positive: bool = False) -> float: ...

    @overload
    def number(key: str, default: None = None, *, positive: bool = False) -> float | None: ...

    def number(key: str, default: float | None = None, *, positive: bool = False) -> float | None:
        value = values.get(key)
        if value is None:
            return default
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _LARGEST:
            raise UserError(f"'{key}' of {owner} is {_short(value)}, not a number; export the capture again.")
        if positive and value <= 0:
            raise UserError(
                f"'{key}' of {owner} is {value:g}, and must be positive; export the capture again."
            )
        return float(value)

    size = image_size(image)
    width = round(number("w", size[0], positive=True))
    height = round(number("h", size[1], positive=True))
    fx = number("fl_x", positive=True) or _focal(number("camera_angle_x", positive=True), width, owner)
    fy = number("fl_y", positive=True) or _focal(number("camera_angle_y", positive=True), height, owner)
    fx, fy = fx or fy, fy or fx
    if fx is None or fy is None:
        raise UserError(
            f"{owner[0].upper()}{owner[1:]} has no focal length: neither fl_x nor "
            f"camera_angle_x; add one, in pixels or radians."
        )
    distortion = Distortion(*(number(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4")))
    declared = Camera(
        width, height, fx, fy, number("cx", width / 2), number("cy", height / 2), pose, distortion
    )
    return camera_for_image(declared, size, image)


def _short(value: object) -> str:
    text = f"an integer of {value.bit_length()} bits" if isinstance(value, int) else repr(value)
    return text if len(text) < 60 else text[:50] + " ..."


def _focal(angle: float | None, size: int, owner: str) -> float | None:
    if angle is None:
        return None
    if angle >= math.pi:
        raise UserError(
            f"The camera angle of {owner} is {angle:g}, but it is in radians and below pi; "
            f"convert it from degrees."
        )
    return size / 2 / math.tan(angle / 2)
