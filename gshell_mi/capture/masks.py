"""Where the object is in each photograph: from alpha, from mask images or from a background colour."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from PIL import ImageColor

from ..errors import UserError
from .decoding import SUFFIXES, images_in, read_pixels
from .file_names import Copies, existing
from .frames import Capture, Frame
from .reduced import match_frame, read_reduced_grey

#: Folders that data sets keep masks in, beside the images' folder or in the capture's.
_FOLDERS = ("masks", "mask")

_SUPPLY = (
    "supply images with alpha, a folder of masks (white on the object) as 'masks' beside the images "
    "or with --masks, or the colour behind the object with --background"
)


@dataclass(frozen=True)
class Background:
    """A known, even colour behind the object.

    Attributes:
        color: encoded RGB as in the images, in [0, 1].
        tolerance: distance, in units of the encoded range, at which a pixel is wholly the object's;
            coverage rises linearly up to there.
    """

    color: tuple[float, float, float]
    tolerance: float = 0.1

    @classmethod
    def parse(cls, text: str, tolerance: float = 0.1) -> Background:
        """From "white", "#00ff00" or any other colour name of CSS.

        Raises:
            UserError: it is none, or the tolerance is not positive.

        >>> Background.parse("#00ff00").color
        (0.0, 1.0, 0.0)
        """
        try:
            red, green, blue = ImageColor.getrgb(text)[:3]
        except ValueError:
            raise UserError(
                f"--background '{text}' is neither a colour nor a file that exists; give a colour as white, "
                f"black or '#00ff00', or a photograph of the place without the object."
            ) from None
        if not tolerance > 0:
            raise UserError(f"--background-tolerance must be positive, and is {tolerance:g}.")
        return cls((red / 255, green / 255, blue / 255), tolerance)

    def coverage(self, encoded: np.ndarray) -> np.ndarray:
        """(h, w) from (h, w, 3) encoded values in [0, 1]."""
        return np.clip(np.abs(encoded - np.array(self.color)).max(axis=-1) / self.tolerance, 0.0, 1.0)


def assign_masks(capture: Capture, folder: Path | None) -> Capture:
    """Finds the mask file of each frame.

    Masks are matched to images by name (``IMG_1.png`` or ``IMG_1.jpg.png`` for ``IMG_1.jpg``), in the same
    sub-folders where several images have one name, or all by their order if no name matches and there are as
    many.

    Args:
        folder: where they are; default: ``masks`` or ``mask`` if there is one, unless the format names
            each frame's.

    Raises:
        UserError: the folder does not exist, or it lacks the mask of an image.
    """
    if folder is None:
        if any(frame.mask for frame in capture.frames):
            missing = next((frame for frame in capture.frames if not frame.mask), None)
            if missing:
                raise UserError(
                    f"The capture names masks, but none for '{missing.image}'; add it, or give "
                    f"a folder of masks with --masks."
                )
            lost = next(
                (frame.mask for frame in capture.frames if frame.mask and not frame.mask.is_file()), None
            )
            if lost:
                raise UserError(
                    f"Mask '{lost}' is missing, with or without a suffix such as .png; put it "
                    f"there, or give a folder of masks with --masks."
                )
            return capture
        folder = _beside(capture)
        if folder is None:
            return capture
    elif not folder.is_dir():
        raise UserError(f"Mask folder '{folder}' does not exist; correct --masks.")
    copies = Copies(frame.image.as_posix() for frame in capture.frames)
    found = [copies.find(folder, frame.image.as_posix(), mask_of(frame.image)) for frame in capture.frames]
    if not any(found):
        images = {frame.image.resolve() for frame in capture.frames}
        inside = [file for file in images_in(folder) if file.resolve() not in images]
        if len(inside) != len(capture.frames):
            raise UserError(
                f"The masks in '{folder}' have neither the images' names nor their number "
                f"({len(inside)} masks, {len(capture.frames)} images); name each as its image."
            )
        found = inside
    for mask, frame in zip(found, capture.frames, strict=True):
        if mask is None:
            raise UserError(
                f"Image '{frame.image}' has no mask in '{folder}'; add '{frame.image.stem}.png' there."
            )
    frames = tuple(replace(frame, mask=mask) for frame, mask in zip(capture.frames, found, strict=True))
    return replace(capture, frames=frames)


def _beside(capture: Capture) -> Path | None:
    root = capture.source if capture.source.is_dir() else capture.source.parent
    image = capture.frames[0].image
    for parent in (image.parent.parent, root):
        for name in _FOLDERS:
            if (parent / name).is_dir():
                return parent / name
    return None


def mask_of(image: Path) -> Callable[[Path], Path | None]:
    """Finds the mask of an image by the place that the image would have among the masks.

    Masks may lie beside their images: the image itself is none.
    """

    def find(place: Path) -> Path | None:
        names = (place.name, place.name + ".png", *(place.stem + suffix for suffix in SUFFIXES))
        exact = (place.with_name(name) for name in names)
        spelled = (existing(named) for named in (place.with_name(place.stem), place))
        files = (file for file in chain(exact, spelled) if file is not None and file.is_file())
        return next((file for file in files if not file.samefile(image)), None)

    return find


def coverage_of(
    frame: Frame,
    pixels: np.ndarray,
    background: Background | None = None,
    *,
    inverted: bool = False,
    reduction: int = 1,
    white: float = 1.0,
) -> np.ndarray:
    """(h, w) coverage in [0, 1] of a frame with the given stored pixels.

    A given background colour comes first, then the frame's mask, then alpha.

    Args:
        inverted: mask files are black on the object.
        reduction: of the pixels, see ``read_reduced``.
        white: the value that counts as 1 in mask files and in the alpha of integer files, see ``white_of``.

    Raises:
        UserError: there is none of them, or the mask has another aspect than the image.
    """
    if background is not None:
        return background.coverage(_unit(pixels[..., :3])).astype(np.float32)
    size = (frame.camera.width, frame.camera.height)
    if frame.mask is not None:
        coverage = None if frame.turned else read_reduced_grey(frame.mask, size, reduction)
        if coverage is None:
            mask = mask_values(frame.mask)
            coverage = match_frame(mask, frame, pixels.shape[:2], reduction)
            if coverage is None:
                raise UserError(
                    f"Mask '{frame.mask}' is {mask.shape[1]} x {mask.shape[0]} pixels, but its "
                    f"image is {size[0]} x {size[1]}; resize it."
                )
        coverage = stretched(coverage, white)
        return 1 - coverage if inverted else coverage
    if pixels.shape[2] < 4:
        raise UserError(f"Image '{frame.image}' has no alpha, and there is no mask for it; {_SUPPLY}.")
    if not has_alpha(pixels):
        raise UserError(
            f"Image '{frame.image}' has an alpha of 1 everywhere, and there is no mask for it; {_SUPPLY}."
        )
    alpha = np.clip(_unit(pixels[..., 3]), 0, 1)
    return alpha if alpha_values(pixels) is None else stretched(alpha, white)


def mask_values(path: Path) -> np.ndarray:
    """(h, w) float32 of a mask file, in [0, 1].

    Raises:
        UserError: it cannot be read.
    """
    mask = read_pixels(path)
    # Some tools put the mask into alpha and leave the colour empty or as it was.
    values = mask[..., 3] if has_alpha(mask) else mask[..., :3].mean(axis=-1, dtype=np.float32)
    values = _unit(values, mask.dtype)
    if mask.dtype.kind == "f" and (top := float(values.max(initial=0))) >= 2:
        values = values / (255 if top <= 255 else 65535)  # what integers held
    return np.clip(values, 0, 1)


def has_alpha(pixels: np.ndarray) -> bool:
    """Whether stored pixels have an alpha that says anything: one of 1 everywhere does not."""
    return pixels.shape[2] == 4 and bool(_unit(pixels[..., 3]).min() < 1)


def alpha_values(pixels: np.ndarray) -> np.ndarray | None:
    """(h, w) float32 alpha of the stored pixels of an integer file; None if they have none."""
    return _unit(pixels[..., 3]) if pixels.shape[2] == 4 and pixels.dtype.kind == "u" else None


def stretched(values: np.ndarray, white: float) -> np.ndarray:
    """Values in [0, 1] of which ``white`` is to be 1."""
    return values if white == 1 else np.clip(values / np.float32(white), 0, 1)


def _unit(values: np.ndarray, stored: np.dtype | None = None) -> np.ndarray:
    """Values of integer files scaled to [0, 1]; float32.

    Args:
        stored: type of the file's values, if ``values`` have been computed from them.
    """
    stored = stored or values.dtype
    scale = np.iinfo(stored).max if stored.kind == "u" else 1
    return values.astype(np.float32) / np.float32(scale)
