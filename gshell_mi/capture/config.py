"""The choices that a capture leaves to the user; also the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from ..errors import UserError
from ..lattice import MOST_CELLS

#: What --up may name beside "auto", "cameras" and "keep".
AXES = {
    sign + name: tuple((-1.0 if sign else 1.0) * (axis == index) for index in range(3))
    for sign in ("", "-")
    for axis, name in enumerate("xyz")
}


@dataclass(frozen=True)
class CaptureConfig:
    """How photographs become targets. "Scene" is the world of the XML file that is written: y is up."""

    format: str | None = None
    """nerf, idr, colmap, llff or mitsuba; default: the first of these that fits."""
    images: Path | None = None
    """Folder of the images, where the format does not say or another copy is wanted."""
    opencv_axes: bool = False
    """For nerf: the camera's axes are right, down, forward instead of right, up, backward."""
    masks: Path | None = None
    """Folder of masks, white on the object, named like the images; default: "masks" or "mask" if there is
    one, else alpha."""
    invert_masks: bool = False
    """The mask images are black on the object instead of white."""
    ignore: Path | None = None
    """Folder of ignore masks, white where a photograph tells nothing, named like the images; default:
    "ignore" beside the images if there is one."""
    make_masks: str = "grabcut"
    """How masks are made where there are none: grabcut (extra "masks"), rembg (a network, extra "rembg") or
    off."""
    frames: int = 80
    """Frames to take from a video."""
    background: str | None = None
    """Colour behind the object that makes the masks (white, black, '#00ff00' ...), or a photograph of the
    place without the object, by the same unmoved camera."""
    background_tolerance: float = 0.1
    """Distance from --background, of the encoded range 0 to 1, from which on a pixel is the object's."""
    color_space: str = "sRGB"
    """RGB colour space of the images, by its name in colour-science: sRGB, Display P3, ACEScg ..."""
    transfer: str | None = None
    """Transfer function, by its name in colour-science, or linear; default: the colour space's for integer
    files, linear for OpenEXR and other floating point files."""
    exposures: Path | None = None
    """JSON object of exposures in stops by file name; default: from EXIF data if all photographs have
    them."""
    no_exif: bool = False
    """Ignore the exposures in EXIF data."""
    max_size: int = 400
    """Longest side of a target in pixels, shrunk by area; 0 keeps the images' size."""
    hold_out: int = 0
    """Hold out each n-th view for measuring; 0 holds out only what the format does."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Corners x0 y0 z0 x1 y1 z1 of the box that holds the object, in the scene's units; it grows to a cube.
    Default: around the volume that the masks have in common."""
    up: str = "auto"
    """Which way of the capture is up: x, y, z, -x, -y, -z; cameras: the mean of theirs; keep: do not move the
    world; auto: what the format says, else cameras."""
    resolution: int = 64
    """Cells per side of the lattice."""
    light: Path | None = None
    """Environment map to start from, latitude-longitude, y up in the scene; default: an even light."""

    def __post_init__(self) -> None:
        if self.box is not None:
            if not all(map(math.isfinite, self.box)):
                raise UserError("--box holds NaN or infinity; give six numbers.")
            if any(low >= high for low, high in zip(self.box[:3], self.box[3:], strict=True)):
                raise UserError(
                    f"--box {' '.join(f'{value:g}' for value in self.box)} is empty: each of x0 "
                    f"y0 z0 must be below x1 y1 z1."
                )
        if self.max_size < 0:
            raise UserError(f"--max-size must not be negative, and is {self.max_size}.")
        if self.hold_out < 0 or self.hold_out == 1:
            raise UserError(f"--hold-out must be 0 or at least 2, not {self.hold_out}.")
        if not 4 <= self.resolution <= MOST_CELLS:
            raise UserError(f"--resolution must be from 4 to {MOST_CELLS} cells, not {self.resolution}.")
        if not (math.isfinite(self.background_tolerance) and self.background_tolerance >= 0):
            raise UserError(
                f"--background-tolerance must be a number that is not negative, unlike "
                f"{self.background_tolerance:g}."
            )
        if self.up not in (*AXES, "auto", "cameras", "keep"):
            raise UserError(f"--up '{self.up}' is unknown; choose {', '.join(AXES)}, cameras, keep or auto.")
        if self.make_masks not in ("grabcut", "rembg", "off"):
            raise UserError(f"--make-masks '{self.make_masks}' is unknown; choose grabcut, rembg or off.")
        if self.frames < 3:
            raise UserError(f"--frames must be at least 3, not {self.frames}.")
        if self.background is not None and self.masks is not None:
            raise UserError("Both --background and --masks are given; choose one.")
        photograph = self.background is not None and Path(self.background).is_file()
        if photograph and self.make_masks != "grabcut":
            raise UserError(
                f"--background '{self.background}' is a photograph, of which --make-masks grabcut makes "
                f"masks, not {self.make_masks}; leave out one of the two options."
            )
        for option, path in (("--light", self.light), ("--exposures", self.exposures)):
            if path is not None and not path.is_file():
                raise UserError(f"File '{path}' does not exist; correct {option}.")
