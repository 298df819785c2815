"""What every importer returns: frames and what the format knows of the world."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import UserError
from .camera import Camera, rigid


@dataclass(frozen=True)
class Frame:
    """One photograph.

    Attributes:
        image: its file.
        camera: with the size of the image file.
        mask: the file of its coverage, if the format names one.
        held_out: kept for measuring; the fit does not see it.
        ignored: the file of its ignore mask, white where nothing is known, if there is one.
        turned: its masks are stored as the image's EXIF orientation shows it, though their sizes do not tell.
    """

    image: Path
    camera: Camera
    mask: Path | None = None
    held_out: bool = False
    ignored: Path | None = None
    turned: bool = False


@dataclass(frozen=True)
class Capture:
    """A set of photographs in one world.

    Attributes:
        format: the format's name for people.
        source: the folder or file it was read from.
        frames: in the format's order.
        up: unit direction that the format says is up; None if it says nothing.
        region: (2, 3) corners of a box that the format says holds the object, or None.
        has_opengl_axes: the format's camera axes are right, up, backward, which exporters get wrong.
        notes: what the user should know of how the files were read, a sentence each.
    """

    format: str
    source: Path
    frames: tuple[Frame, ...]
    up: np.ndarray | None = None
    region: np.ndarray | None = None
    has_opengl_axes: bool = False
    notes: tuple[str, ...] = ()

    @property
    def training(self) -> tuple[Frame, ...]:
        return tuple(frame for frame in self.frames if not frame.held_out)

    def holding_out(self, every: int) -> Capture:
        """With each ``every``-th frame held out, beginning with the first, as LLFF's papers do."""
        frames = tuple(
            replace(frame, held_out=frame.held_out or index % every == 0)
            for index, frame in enumerate(self.frames)
        )
        return replace(self, frames=frames)


def pose_of(matrix: object, owner: str) -> np.ndarray:
    """A 3 x 4 or 4 x 4 matrix from a file as a rigid (4, 4) camera-to-world pose.

    Args:
        matrix: nested lists or an array.
        owner: for the message: whose pose, and which file holds it.

    Raises:
        UserError: it has another shape or other contents, is mirrored or no rotation.
    """
    try:
        array = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError, RecursionError):
        array = np.zeros(0)
    if array.shape == (3, 4):
        array = np.concatenate([array, [[0, 0, 0, 1]]])
    if array.shape != (4, 4):
        raise UserError(f"The pose of {owner} is not a 4 x 4 matrix of numbers; export the capture again.")
    try:
        return rigid(array)
    except ValueError as problem:
        raise UserError(
            f"The pose of {owner} {problem}; export the capture again as rigid camera-to-world matrices."
        ) from None


def camera_for_image(declared: Camera, size: tuple[int, int], image: Path) -> Camera:
    """The declared camera at the (width, height) of the image file, perhaps a copy in another size.

    Raises:
        UserError: their aspect ratios differ, or the declared numbers are of no camera.
    """
    width, height = size
    if not _is_possible(declared):
        raise UserError(
            f"The camera of image '{image}' has impossible intrinsics ({declared.width} x "
            f"{declared.height} pixels, focal lengths {declared.fx:g}, {declared.fy:g}, centre "
            f"{declared.cx:g}, {declared.cy:g}, {declared.distortion}); export it again."
        )
    if (declared.width, declared.height) == size:
        return declared
    if not same_aspect((declared.width, declared.height), size):
        turned = (declared.height, declared.width) == size
        cure = (
            "it seems turned by its EXIF orientation: store it as the calibration saw it"
            if turned
            else "take the images that the cameras were calibrated on"
        )
        raise UserError(
            f"Image '{image}' is {width} x {height} pixels, but its camera is declared for "
            f"{declared.width} x {declared.height}; {cure}."
        )
    return declared.resized(width, height)


def same_aspect(first: tuple[int, int], second: tuple[int, int]) -> bool:
    """Whether two (width, height) are of copies of one image: each side of the smaller one is rounded, up or
    down, to whole pixels.

    >>> same_aspect((6000, 4000), (1600, 1067)), same_aspect((6000, 4000), (1600, 1070))
    (True, False)
    """
    small, large = sorted((first, second))
    return abs(small[0] * large[1] - small[1] * large[0]) <= max(large)


def _is_possible(camera: Camera) -> bool:
    """Whether the numbers are those of any camera; wide of what is sensible, but good to compute with."""
    lens = dataclasses.astuple(camera.distortion)
    if not np.isfinite((camera.fx, camera.fy, camera.cx, camera.cy, *lens)).all():
        return False
    longest = max(camera.width, camera.height)
    focal = sorted((camera.fx, camera.fy))
    return (
        min(camera.width, camera.height) >= 1
        and 1e-3 * longest < focal[0]
        and focal[1] < 1e5 * longest
        and max(abs(camera.cx), abs(camera.cy)) < 100 * longest
        and max(map(abs, lens)) < 1e4
    )
