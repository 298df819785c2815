"""COLMAP's sparse models, text and binary.

World-to-camera quaternions and translations, camera axes right, down, forward; the upper left pixel's
centre is (0.5, 0.5). The files are simple and stable, so they are read here rather than by pycolmap,
which is large. https://colmap.github.io/format.html
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import UserError
from ..camera import Camera, Distortion
from ..decoding import image_size
from ..file_names import entry_of, existing
from ..frames import Capture, Frame, camera_for_image, pose_of

#: Number in binary models, and how many parameters each has.
_MODELS = {
    "SIMPLE_PINHOLE": (0, 3),
    "PINHOLE": (1, 4),
    "SIMPLE_RADIAL": (2, 4),
    "RADIAL": (3, 5),
    "OPENCV": (4, 8),
}
_OTHER_MODELS = {
    5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
}
_PLACES = ("", "sparse", "colmap/sparse", "colmap")


def find(source: Path) -> Path | None:
    """The folder of the model: the given one or its usual sub-folders; of several, that of most images."""
    for place in _PLACES:
        models = _models(entry_of(source, place))
        if models:
            return max(models, key=_image_count) if len(models) > 1 else models[0]
    return None


def _models(folder: Path) -> list[Path]:
    """The folder itself, if it is a model, or the numbered ones in it, into which COLMAP splits its own."""
    if _suffix(folder):
        return [folder]
    if folder.name.casefold() != "sparse" or not folder.is_dir():
        return []
    numbered = sorted((path for path in folder.iterdir() if path.name.isdecimal()), key=lambda p: int(p.name))
    return [path for path in numbered if _suffix(path)]


def _suffix(folder: Path) -> str | None:
    """Of the files of a model; the binary one if there are both."""
    return next(
        (
            suffix
            for suffix in (".bin", ".txt")
            if all(entry_of(folder, name + suffix).is_file() for name in ("cameras", "images"))
        ),
        None,
    )


def _image_count(model: Path) -> int:
    """Roughly, as the model may be malformed."""
    suffix = _suffix(model)
    file = entry_of(model, f"images{suffix}")
    if suffix == ".bin":
        with open(file, "rb") as stream:
            return int.from_bytes(stream.read(8), "little")
    with open(file, encoding="utf-8", errors="replace") as stream:
        lines = (line for line in stream if not line.startswith("#"))
        return sum(len(line.split(maxsplit=10)) >= 10 and not _are_keypoints(line) for line in lines)


def read(source: Path, images: Path | None = None) -> Capture:
    """Reads a model; the binary one if there are both.

    Args:
        source: a folder that holds ``cameras`` and ``images`` (``.bin`` or ``.txt``), or a project with
            ``sparse/0``.
        images: folder of the images; default: ``images`` in the project.

    Raises:
        UserError: the model is cut off or malformed, a camera model is not supported, an image is missing.
    """
    model = find(source)
    assert model is not None, "``find`` knows the source"
    images = images or _image_folder(source, model)
    others = [path for path in _models(model.parent) if path != model] if model != source else []
    notes = (
        [
            f"'{model.parent}' has {len(others) + 1} models; '{model.name}' is taken, as it has the most "
            f"images: merge them in COLMAP (model_merger) for the others."
        ]
        if others
        else []
    )
    suffix = _suffix(model)
    cameras_file, images_file = (entry_of(model, f"{name}{suffix}") for name in ("cameras", "images"))
    if suffix == ".bin":
        cameras, poses = _read_cameras_bin(cameras_file), _read_images_bin(images_file)
    else:
        cameras, poses = _read_cameras_txt(cameras_file), _read_images_txt(images_file)
    if not poses:
        raise UserError(f"The COLMAP model in '{model}' has no images; run its mapper first.")
    frames = []
    for name, (camera, quaternion, translation) in sorted(poses.items()):
        if camera not in cameras:
            raise UserError(
                f"The COLMAP model in '{model}' has no camera {camera}, which '{name}' was taken "
                f"with; export the model again."
            )
        path = _image(images, name)
        pose = pose_of(_camera_to_world(quaternion, translation), f"image '{name}' of '{model}'")
        frames.append(Frame(path, camera_for_image(_camera(*cameras[camera], pose), image_size(path), path)))
    return Capture("COLMAP", source, tuple(frames), notes=tuple(notes))


def _image(folder: Path, name: str) -> Path:
    # A model made on Windows may name its images with backslashes.
    candidates = (folder / name, folder / name.replace("\\", "/"))
    return next((found for found in map(existing, candidates) if found), candidates[0])


def _image_folder(source: Path, model: Path) -> Path:
    for parent in (source, *model.resolve().parents[:3]):
        if (folder := entry_of(parent, "images")).is_dir():
            return folder
    raise UserError(f"The COLMAP model in '{model}' has no folder 'images' near it; name it with --images.")


def _camera_to_world(quaternion: np.ndarray, translation: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):  # what is not finite, as of a quaternion of 0, is refused as a pose
        w, x, y, z = quaternion / np.linalg.norm(quaternion)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.concatenate([rotation.T, -rotation.T @ translation[:, None]], axis=1)


def _camera(model: str, width: int, height: int, p: np.ndarray, pose: np.ndarray) -> Camera:
    if model == "SIMPLE_PINHOLE":
        return Camera(width, height, p[0], p[0], p[1], p[2], pose)
    if model == "PINHOLE":
        return Camera(width, height, *p[:4], to_world=pose)
    if model == "SIMPLE_RADIAL":
        return Camera(width, height, p[0], p[0], p[1], p[2], pose, Distortion(p[3]))
    if model == "RADIAL":
        return Camera(width, height, p[0], p[0], p[1], p[2], pose, Distortion(p[3], p[4]))
    return Camera(width, height, *p[:4], to_world=pose, distortion=Distortion(*p[4:]))


def _check_model(model: str, path: Path) -> None:
    if model not in _MODELS:
        raise UserError(
            f"'{path}' has a camera of the model {model}, and only {', '.join(_MODELS)} are "
            f"supported; run `colmap image_undistorter` and import its output."
        )


# --- text


def _lines(path: Path) -> list[str]:
    try:
        # Names may hold what else ends lines in Python.
        return path.read_text(encoding="utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"'{path}' is no text file ({error}); export the model again.") from error


def _malformed(path: Path, line: int) -> UserError:
    return UserError(f"'{path}' is malformed in line {line}; export the model again.")


def _read_cameras_txt(path: Path) -> dict[int, tuple[str, int, int, np.ndarray]]:
    cameras = {}
    for number, line in enumerate(_lines(path), 1):
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split()
        if len(words) > 1:
            _check_model(words[1], path)
        try:
            index, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            parameters = np.array(words[4:], dtype=np.float64)
        except (ValueError, IndexError):
            raise _malformed(path, number) from None
        if len(parameters) != _MODELS[model][1] or not 0 < min(width, height) <= max(width, height) < 2**31:
            raise _malformed(path, number)
        cameras[index] = (model, width, height, parameters)
    return cameras


def _read_images_txt(path: Path) -> dict[str, tuple[int, np.ndarray, np.ndarray]]:
    poses = {}
    keypoints_next = False
    for number, line in enumerate(_lines(path), 1):
        # As COLMAP reads: the line after an image's holds its keypoints, and may be empty; before an image,
        # empty lines and comments do not count. Some exporters leave the keypoints' lines out.
        if keypoints_next and _are_keypoints(line):
            keypoints_next = False
            continue
        if not line.strip() or line.startswith("#"):
            continue
        keypoints_next = True
        words = line.split(maxsplit=9)  # a name may hold spaces
        try:
            values = np.array(words[1:8], dtype=np.float64)
            camera, name = int(words[8]), words[9].rstrip()
        except (ValueError, IndexError):
            raise _malformed(path, number) from None
        _check_new(name, poses, path)
        poses[name] = (camera, values[:4], values[4:7])
    return poses


def _check_new(name: str, poses: dict[str, Any], path: Path) -> None:
    if name in poses:
        raise UserError(f"'{path}' has the image '{name}' twice; export the model again.")


def _are_keypoints(line: str) -> bool:
    """Whether a line lists x, y and the number of a 3-D point, any number of times."""
    words = line.split()
    if len(words) % 3:
        return False
    try:
        np.array([words[:3], words[-3:]], dtype=np.float64)
    except ValueError:  # the last word of an image's line is its name
        return False
    return True


# --- binary, little-endian


class _Reader:
    def __init__(self, path: Path):
        self.path, self.at = path, 0
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise UserError(f"'{path}' cannot be read ({error.strerror}); mend its permissions.") from error

    def take(self, layout: str) -> tuple:
        size = struct.calcsize("<" + layout)
        if self.at + size > len(self.data):
            raise self.cut_off()
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += size
        return values

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.cut_off()
        name = self.data[self.at : end].decode("utf-8", errors="surrogateescape")
        self.at = end + 1
        return name

    def skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self.data):
            raise self.cut_off()

    def cut_off(self) -> UserError:
        return UserError(f"'{self.path}' ends before it should; copy or export the model again.")


def _read_cameras_bin(path: Path) -> dict[int, tuple[str, int, int, np.ndarray]]:
    names = {number: (name, count) for name, (number, count) in _MODELS.items()}
    reader, cameras = _Reader(path), {}
    for _ in range(reader.take("Q")[0]):
        index, model, width, height = reader.take("iiQQ")
        if model not in names:
            _check_model(_OTHER_MODELS.get(model, f"number {model}"), path)
        name, count = names[model]
        cameras[index] = (name, width, height, np.array(reader.take(f"{count}d")))
    return cameras


def _read_images_bin(path: Path) -> dict[str, tuple[int, np.ndarray, np.ndarray]]:
    reader, poses = _Reader(path), {}
    for _ in range(reader.take("Q")[0]):
        _, *values, camera = reader.take("i7di")
        name = reader.name()
        reader.skip(24 * reader.take("Q")[0])  # keypoints: x, y, id of the 3-D point
        _check_new(name, poses, path)
        poses[name] = (camera, np.array(values[:4]), np.array(values[4:]))
    return poses
