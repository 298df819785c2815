"""From one photograph to one target: linear, masked, shrunk, undistorted."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import UserError
from ..json_files import read_json_object
from .camera import Camera
from .decoding import FLOAT_SUFFIXES, ColorDecoding, exif_exposure
from .evidence import read_ignored, wide_grey
from .frames import Capture, Frame
from .masks import Background, coverage_of
from .reduced import read_reduced, reduced_camera
from .resample import framed, rectify, shrink

#: A JPEG is decoded at no less than so many times the size of its target, so that most of the averaging is
#: of linear values.
_DECODED = 2
#: Half floats end at 65504; a target there is far beyond what a photograph holds.
_BRIGHTEST = 6e4
#: Exposures of one set are no farther apart.
_MOST_STOPS = 30
#: Shares above this are 1, but for the rounding of means over many pixels.
_WHOLE = 1 - 1e-3


@dataclass(frozen=True)
class Prepared:
    """A target and what became of its photograph.

    Attributes:
        rgba: (height, width, 4) float32, linear Rec.709, premultiplied by alpha = coverage.
        camera: the one with square pixels and without distortion that sees it.
        clipped: share of the object's pixels at the largest value of an integer file.
        covered: the largest coverage of any pixel of the photograph.
        known: (height, width) share of each pixel of which the photograph tells whether it is the object's;
            None if that is all of every pixel.
    """

    rgba: np.ndarray
    camera: Camera
    clipped: float
    covered: float
    known: np.ndarray | None = None


@dataclass(frozen=True)
class Preparation:
    """What is done to every photograph.

    Attributes:
        decoding: from stored values to linear Rec.709.
        background: the colour behind the object, if that is to make the masks.
        inverted_masks: mask files are black on the object.
        max_size: longest side of a target in pixels; 0 keeps the images' size.
        gains: factor on a file's linear values that evens out its exposure; 1 where not named.
        white, ignored_white: the values of masks on the object and of ignore masks, see ``white_of``.
    """

    decoding: ColorDecoding = field(default_factory=ColorDecoding)
    background: Background | None = None
    inverted_masks: bool = False
    max_size: int = 0
    gains: dict[Path, float] = field(default_factory=dict)
    white: float = 1.0
    ignored_white: float = 1.0

    def target(self, frame: Frame) -> Prepared:
        """The target of a frame.

        Raises:
            UserError: the image or its mask cannot be used.
        """
        pixels, reduction = read_reduced(frame.image, _DECODED * self.max_size)
        coverage = coverage_of(
            frame,
            pixels,
            self.background,
            inverted=self.inverted_masks,
            reduction=reduction,
            white=self.white,
        )[..., None]
        rgb = self.decoding.linear(pixels[..., :3])
        # In place, for a photograph of 24 megapixels takes 300 MB by now.
        if self.background is not None:
            rgb -= (1 - coverage) * self.decoding.linear(self._encoded(self.background.color, pixels.dtype))
        else:
            _cut_out(rgb, coverage, frame, pixels)
        rgb *= np.float32(self.gains.get(frame.image, 1.0))
        np.clip(rgb, 0.0, _BRIGHTEST, out=rgb)
        known = self._known(frame, coverage, reduction)
        image = np.concatenate([rgb, coverage, known], axis=-1)
        # The lens formula is in units of the focal length, so it holds for the small image, at less cost.
        small, camera = shrink(image, reduced_camera(frame.camera, reduction), self.max_size)
        inside = framed(camera)
        image, camera = rectify(small, camera)
        known = image[..., 4] * inside
        return Prepared(
            image[..., :4],
            camera,
            _clipped(pixels, coverage),
            float(coverage.max()),
            None if (known > _WHOLE).all() else known,
        )

    def _known(self, frame: Frame, coverage: np.ndarray, reduction: int) -> np.ndarray:
        """(h, w, 1) the share of each pixel of which something is known."""
        known = np.ones_like(coverage)
        if self.background is None and frame.mask is not None:
            known[wide_grey(coverage[..., 0])] = 0
        if frame.ignored is not None:
            known[..., 0] *= 1 - read_ignored(frame, coverage.shape[:2], reduction, self.ignored_white)
        return known

    @staticmethod
    def _encoded(color: tuple[float, float, float], dtype: np.dtype) -> np.ndarray:
        value = np.array(color).reshape(1, 1, 3)
        return np.round(value * np.iinfo(dtype).max).astype(dtype) if dtype.kind == "u" else value


def _clipped(pixels: np.ndarray, coverage: np.ndarray) -> float:
    covered = coverage[..., 0] > 0.99
    if pixels.dtype.kind != "u" or not covered.any():
        return 0.0
    return float((pixels[covered][:, :3] == np.iinfo(pixels.dtype).max).any(axis=1).mean())


def _cut_out(rgb: np.ndarray, coverage: np.ndarray, frame: Frame, pixels: np.ndarray) -> None:
    """Multiplies (h, w, 3) linear colour by the coverage (h, w, 1), in place.

    OpenEXR's is premultiplied by its own alpha, PNG's is not; a mask file cuts out anew.
    """
    if pixels.shape[2] == 4 and frame.image.suffix.lower() in FLOAT_SUFFIXES:
        if frame.mask is None:
            return
        alpha = pixels[..., 3:]
        np.divide(rgb, alpha, out=rgb, where=alpha > 0)
    rgb *= coverage


def exposure_gains(capture: Capture, file: Path | None, *, exif: bool = True) -> dict[Path, float]:
    """Factors that bring all photographs to their mean exposure (in stops).

    Args:
        file: a JSON object of exposures in stops, larger is brighter, by the images' file names.
        exif: without a file, take shutter time, aperture and ISO from EXIF data if all photographs
            have them.

    Raises:
        UserError: the file is malformed, or lacks an image.
    """
    images = [frame.image for frame in capture.frames]
    if file is not None:
        stops = _stops_from_file(file, images)
    elif exif:
        stops = [exif_exposure(image) for image in images]
    else:
        return {}
    known = [value for value in stops if value is not None]
    if len(known) < len(stops) or np.ptp(known) < 1e-3:
        return {}
    mean = float(np.mean(known))
    return {image: 2.0 ** (mean - value) for image, value in zip(images, known, strict=True)}


def _stops_from_file(file: Path, images: list[Path]) -> list[float]:
    try:
        table = {name: float(value) for name, value in read_json_object(file).items()}
    except (OSError, ValueError, TypeError, OverflowError) as error:
        raise UserError(
            f"--exposures '{file}' is no JSON object of stops by file name ({error}); write "
            f'{{"IMG_1.jpg": 0.0, "IMG_2.jpg": -1.5}}.'
        ) from error
    for image in images:
        if not math.isfinite(table.get(image.name, math.nan)):
            raise UserError(f"--exposures '{file}' has no finite exposure for '{image.name}'; add it.")
    stops = [table[image.name] for image in images]
    if (spread := max(stops) - min(stops)) > _MOST_STOPS:
        raise UserError(
            f"--exposures '{file}' has exposures {spread:.3g} stops apart, and {_MOST_STOPS} are beyond any "
            f"camera; give stops (one is twice as bright), not shutter speeds or times."
        )
    return stops
