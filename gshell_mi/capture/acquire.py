"""Whatever the user has, to photographs with cameras and masks: what is missing is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import UserError
from ..files import replacing
from ..integer_images import open_image
from . import video
from .camera import Camera
from .config import CaptureConfig
from .decoding import read_pixels
from .formats import FORMATS, colmap, read_capture
from .frames import Capture
from .masks import has_alpha
from .parallel import in_order
from .segmentation import SIZE, View, cut_out
from .structure_from_motion import photographs_in, place, small_copy
from .subject import Subject, find_subject, sparse_points
from .workspace import Progress, Workspace, fingerprint

#: A pixel that differs by this much of the encoded range from a photograph of the background is the object's.
_DIFFERS = 0.12


@dataclass
class Acquired:
    """A capture, and what was made of it rather than given.

    Attributes:
        capture: photographs and cameras.
        workspace: keeps what was made.
        model: folder of the COLMAP model that the cameras come from, if they do.
        made: what was made, for people: "cameras", "masks".
    """

    capture: Capture
    workspace: Workspace
    model: Path | None = None
    made: list[str] = field(default_factory=list)


def acquire(source: Path, output: Path, config: CaptureConfig, progress: Progress | None = None) -> Acquired:
    """Reads a capture; finds cameras for mere photographs or a video.

    Args:
        source: a capture of any format, a folder of photographs or a video.
        output: the scene to be; what is made is kept in a folder beside it whose name ends in ``.work``.
        config: how.
        progress: called with what is done, steps done and steps in all.

    Raises:
        UserError: of anything that the user can mend.
    """
    workspace = Workspace(output.with_suffix(".work"))
    posed = (
        config.format is not None
        or not source.exists()
        or any(module.find(source) for module in FORMATS.values())
    )
    is_video = video.is_video(source)
    if not is_video and (posed or not source.is_dir() or not photographs_in(config.images or source)):
        capture = read_capture(
            source, format=config.format, images=config.images, opencv_axes=config.opencv_axes
        )
        return Acquired(capture, workspace, colmap.find(source) if capture.format == "COLMAP" else None)
    if is_video:
        photographs = video.cut(source, workspace, config.frames, progress)
    else:
        photographs = photographs_in(config.images or source)
    capture, model = place(photographs, source, workspace, sequential=is_video, progress=progress)
    subject = find_subject([frame.camera for frame in capture.frames], sparse_points(model))
    if subject is not None:
        capture = replace(capture, up=subject.up)
    if is_video:
        capture = replace(capture, notes=(*video.notes(source), *capture.notes))
    return Acquired(capture, workspace, model, ["cameras"])


def lacks_masks(capture: Capture) -> bool:
    """Whether neither mask files nor any image's alpha say where the object is.

    Raises:
        UserError: an image cannot be read.
    """
    return not any(frame.mask or _has_alpha(frame.image) for frame in capture.frames)


def _has_alpha(path: Path) -> bool:
    try:
        with open_image(path) as image:  # most photographs have no such channel, which is quickly seen
            if "A" not in image.mode and "transparency" not in image.info:
                return False
    except (OSError, SyntaxError, ValueError):
        pass  # of floating point, which Pillow does not know
    return has_alpha(read_pixels(path))


def make_masks(
    acquired: Acquired,
    config: CaptureConfig,
    to_scene: Callable[[Capture], np.ndarray],
    progress: Progress | None = None,
) -> None:
    """Gives every frame a mask file, cut out by ``segmentation``.

    Args:
        to_scene: gives the (4, 4) motion to the scene, in which ``config.box`` is told.

    Raises:
        UserError: an extra is missing, or the object cannot be found.
    """
    capture = acquired.capture
    cameras = [frame.camera for frame in capture.frames]
    points = sparse_points(acquired.model) if acquired.model else np.zeros((0, 3))
    subject = find_subject(cameras, points)
    if config.box is not None:
        subject = _boxed(subject, np.array(config.box).reshape(2, 3), to_scene(capture))
    elif capture.region is not None:
        subject = Subject(capture.region, points[:0], core=_core(capture.region))
    if subject is None:
        raise UserError(
            f"The cameras of '{capture.source}' look at no common point, so masks cannot be "
            f"made; supply them with --masks, or give --box."
        )
    job = {
        "photographs": fingerprint([frame.image for frame in capture.frames]),
        "how": config.make_masks,
        "cameras": [_numbers(camera) for camera in cameras],
        "background": fingerprint([Path(config.background)]) if config.background else None,
        "box": subject.box.tolist(),
        "size": SIZE,
    }
    folder = acquired.workspace.step("cut", job)
    files = [folder / f"{index:05}.png" for index in range(len(cameras))]
    if not all(file.is_file() for file in files):
        views = list(in_order(lambda frame: _view(frame.image, frame.camera), capture.frames))
        views = _with_priors(views, config)
        for file, mask in zip(files, cut_out(views, subject, progress), strict=True):
            with replacing(file) as partial:
                Image.fromarray(mask).save(partial)
    acquired.capture = replace(
        capture,
        frames=tuple(replace(frame, mask=file) for frame, file in zip(capture.frames, files, strict=True)),
    )
    acquired.made.append("masks")


def _numbers(camera: Camera) -> list[float]:
    """All that tells a camera from another of the same size."""
    inner = (camera.fx, camera.fy, camera.cx, camera.cy)
    return [*camera.to_world.ravel(), *inner, *astuple(camera.distortion)]


def _view(path: Path, camera: Camera) -> View:
    image = small_copy(path, SIZE)
    return View(np.array(image), camera.resized(*image.size))


def _boxed(subject: Subject | None, box: np.ndarray, to_scene: np.ndarray) -> Subject:
    """The subject in a box that is given in the scene."""
    corners = np.array([[box[corner >> axis & 1, axis] for axis in range(3)] for corner in range(8)])
    corners = (corners - to_scene[:3, 3]) @ to_scene[:3, :3]
    around = np.stack([corners.min(axis=0), corners.max(axis=0)])
    if subject is None:
        return Subject(around, np.zeros((0, 3)), core=_core(around))
    inside = ((subject.points > around[0]) & (subject.points < around[1])).all(axis=1)
    return Subject(around, subject.points[inside], subject.floor, _core(around))


def _core(box: np.ndarray) -> tuple[np.ndarray, float]:
    return box.mean(axis=0), 0.3 * float(np.ptp(box, axis=0).min())


def _with_priors(views: list[View], config: CaptureConfig) -> list[View]:
    if config.make_masks == "rembg":
        from .network import object_probability

        return [replace(view, prior=object_probability(view.image)) for view in views]
    if config.background is not None:
        empty = small_copy(Path(config.background), SIZE)
        for view in views:
            if view.image.shape[1::-1] != empty.size:
                raise UserError(
                    f"--background '{config.background}' has another aspect than the photographs "
                    f"have; give one of the place without the object, by the same camera."
                )
        behind = np.array(empty, np.float32)
        return [
            replace(
                view, prior=np.clip(np.abs(view.image - behind).max(axis=-1) / 255 / (2 * _DIFFERS), 0, 1)
            )
            for view in views
        ]
    return views
