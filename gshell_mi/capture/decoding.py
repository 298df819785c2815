"""Image files to linear Rec.709."""

from __future__ import annotations

import difflib
import io
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from PIL import ExifTags, ImageCms

from .. import float_images
from ..compat import colour_science
from ..errors import UserError, last_line
from ..integer_images import integer_image_size, open_image, read_integer_image
from . import tiff

#: Formats that hold floating point values, linear unless told otherwise, colour premultiplied by alpha.
FLOAT_SUFFIXES = (".exr", ".hdr", ".pfm")
#: In the order in which they are tried for a name without a suffix.
SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff", ".webp", ".bmp", ".tga", ".hdr", ".pfm")
#: Cameras' own formats; of others, a PNG has to be read to its end to find EXIF data.
_EXIF_SUFFIXES = (".jpg", ".jpeg", ".tif", ".tiff", ".webp")

_REC709 = "ITU-R BT.709"


def is_image(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def images_in(folder: Path) -> list[Path]:
    """The image files in a folder by name; without those in its sub-folders."""
    return sorted(path for path in folder.iterdir() if is_image(path)) if folder.is_dir() else []


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file.

    Raises:
        UserError: it is missing or cannot be read.
    """
    if not path.is_file():
        raise UserError(f"Image '{path}' is missing; the capture names it, so put it there.")
    try:
        if path.suffix.lower() in FLOAT_SUFFIXES:
            return float_images.image_size(path)
        if path.suffix.lower() in tiff.SUFFIXES:
            return tiff.tiff_size(path)
        return integer_image_size(path)
    except Exception as error:
        raise _unreadable(path, error) from error


def read_pixels(path: Path) -> np.ndarray:
    """The pixels as the file stores them: (height, width, 3 or 4) of uint8, uint16 or float32.

    Grey is repeated to RGB; palettes are resolved.

    Raises:
        UserError: the file is missing, cut off or of an unknown kind, or holds NaN or infinity.
    """
    if not path.is_file():
        raise UserError(f"Image '{path}' is missing; the capture names it, so put it there.")
    try:
        pixels = _read(path)
    except Exception as error:
        raise _unreadable(path, error) from error
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[2] > 4 or pixels.dtype.kind not in "uf":
        raise UserError(
            f"Image '{path}' has the layout {pixels.shape} of {pixels.dtype}; write it as a "
            f"grey, RGB or RGBA image of 8, 16 or floating point bits."
        )
    if pixels.dtype.kind == "f" and (bad := float_images.first_not_finite(pixels)):
        raise UserError(
            f"Image '{path}' holds NaN or infinity (first at column {bad[0]}, row {bad[1]}); "
            f"mend those pixels."
        )
    grey, alpha = pixels[..., :1], pixels[..., 1:]
    if pixels.shape[2] <= 2:
        pixels = np.concatenate([grey, grey, grey, alpha], axis=-1)
    return pixels


def _read(path: Path) -> np.ndarray:
    suffix = path.suffix.lower()
    if suffix in FLOAT_SUFFIXES:
        return float_images.read_float_image(path)[0]
    if suffix in tiff.SUFFIXES:
        return tiff.read_tiff(path)
    return read_integer_image(path)


def _unreadable(path: Path, error: Exception) -> UserError:
    return UserError(f"Image '{path}' cannot be read ({last_line(error)}); copy or export it again.")


@dataclass(frozen=True)
class ColorDecoding:
    """How pixel values become linear Rec.709.

    Attributes:
        color_space: an RGB colour space that colour-science knows: "sRGB", "Display P3", "ACEScg" ...
            Its primaries and, for integer files, its transfer function count.
        transfer: transfer function by its name in colour-science ("ITU-R BT.709", "Gamma 2.2", "S-Log3"
            ...) or "linear"; default: that of the colour space for integer files, linear for
            floating point files.

    Raises:
        UserError: a name is unknown.

    >>> ColorDecoding().linear(np.full((1, 1, 3), 188, np.uint8))[0, 0].round(3)
    array([0.503, 0.503, 0.503], dtype=float32)
    """

    color_space: str = "sRGB"
    transfer: str | None = None

    def __post_init__(self) -> None:
        colour = colour_science()
        _known(self.color_space, colour.RGB_COLOURSPACES, "--color-space", "colour space")
        if self.transfer not in (None, "linear"):
            _known(self.transfer, colour.CCTF_DECODINGS, "--transfer", "transfer function")

    def linear(self, rgb: np.ndarray) -> np.ndarray:
        """(h, w, 3) of uint8, uint16 or float to float32 >= 0; integers reach 1 at their largest value."""
        if rgb.dtype.kind == "u":
            # A table has as many entries as there are values, so that slow functions cost nothing.
            levels = np.linspace(0.0, 1.0, np.iinfo(rgb.dtype).max + 1)
            linear = self._decode(levels, integer=True).astype(np.float32)[rgb]
        else:
            linear = self._decode(rgb, integer=False).astype(np.float32)
        if self._to_rec709 is not None:
            linear = linear @ self._to_rec709
        return np.maximum(linear, 0.0, out=linear)

    def _decode(self, values: np.ndarray, *, integer: bool) -> np.ndarray:
        colour = colour_science()
        if self.transfer == "linear" or (self.transfer is None and not integer):
            return values
        if self.transfer is None:
            return colour.RGB_COLOURSPACES[self.color_space].cctf_decoding(values)
        return colour.cctf_decoding(values, self.transfer)

    @cached_property
    def _to_rec709(self) -> np.ndarray | None:
        """Of row vectors."""
        colour = colour_science()
        matrix = colour.matrix_RGB_to_RGB(
            colour.RGB_COLOURSPACES[self.color_space], colour.RGB_COLOURSPACES[_REC709]
        )
        return None if np.allclose(matrix, np.eye(3), atol=1e-3) else matrix.T.astype(np.float32)


def _known(name: str, names: Collection[str], option: str, what: str) -> None:
    if name not in names:
        near = difflib.get_close_matches(name, list(names), n=1, cutoff=0.3) or sorted(names)[:1]
        raise UserError(
            f"{option} '{name}' is no {what} that colour-science knows; the nearest that it "
            f"knows is '{near[0]}'."
        )


def color_profile(path: Path) -> str | None:
    """The name of the colour profile (ICC) in an integer file; None if it has none."""
    if path.suffix.lower() in FLOAT_SUFFIXES:
        return None
    try:
        with open_image(path) as image:
            profile = image.info.get("icc_profile")
        return ImageCms.getProfileDescription(io.BytesIO(profile)).strip() if profile else None
    except (OSError, SyntaxError, ValueError, ImageCms.PyCMSError):
        return None


def exif_orientation(path: Path) -> int:
    """How a photograph is to be turned for people, 1 to 8 as in EXIF; 1, as stored, if it does not tell."""
    if path.suffix.lower() not in _EXIF_SUFFIXES:
        return 1
    try:
        with open_image(path) as image:
            return int(image.getexif().get(ExifTags.Base.Orientation, 1))
    except (OSError, SyntaxError, TypeError, ValueError):
        return 1


def exif_exposure(path: Path) -> float | None:
    """Exposure of a photograph in stops above 1 s at f/1 and ISO 100; None if its EXIF data do not tell."""
    if path.suffix.lower() not in _EXIF_SUFFIXES:
        return None
    try:
        with open_image(path) as image:
            tags = image.getexif().get_ifd(ExifTags.IFD.Exif)
        seconds = float(tags[ExifTags.Base.ExposureTime])
        aperture = float(tags[ExifTags.Base.FNumber])
        sensitivity = tags[ExifTags.Base.ISOSpeedRatings]
        iso = float(sensitivity[0] if isinstance(sensitivity, tuple) else sensitivity)
        exposure = float(np.log2(seconds * iso / 100 / aperture**2))
    except (KeyError, OSError, SyntaxError, TypeError, ValueError, ZeroDivisionError):
        return None  # reading the pixels will complain of a broken file
    return exposure if np.isfinite(exposure) else None
