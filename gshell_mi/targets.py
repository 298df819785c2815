"""Target images (linear Rec.709 RGBA, colour premultiplied by alpha = coverage) and depth maps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .errors import UserError, first_line
from .float_images import first_not_finite, read_float_image

#: Coverage above 1 by more than this is an error; below, rounding of half floats and filter lobes.
_ALPHA_TOLERANCE = 0.05


@dataclass(frozen=True)
class Target:
    """One target image.

    Attributes:
        path: the file it came from.
        rgba: (height, width, 4) float32, linear, premultiplied by alpha.
        has_alpha: False if the file had none and 1 was assumed everywhere.
        depth: (height, width) distances along the rays, world units, 0 where unknown; None without a map.
        known: (height, width) float32 share of each pixel of which the target tells anything, 1 where it is
            all; the rest may be the object or not, and of any colour.
    """

    path: Path
    rgba: np.ndarray
    has_alpha: bool
    depth: np.ndarray | None = None
    known: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.known is None:
            object.__setattr__(self, "known", np.ones(self.rgba.shape[:2], np.float32))

    @property
    def is_known(self) -> bool:
        """Whether all of every pixel is known."""
        return bool((np.asarray(self.known) >= 1).all())

    @property
    def most_alpha(self) -> np.ndarray:
        """(height, width) the largest coverage that what is known allows."""
        return np.maximum(self.rgba[..., 3], 1 - np.asarray(self.known))

    def ignoring(self, pixels: np.ndarray) -> Target:
        """The same with (height, width) some pixels unknown."""
        return replace(self, known=np.where(pixels, np.float32(0), np.asarray(self.known)))

    def divided(self, gain: np.ndarray) -> Target:
        """The same with its channels divided by (3,) gains; alpha stays.

        >>> grey = Target(Path("grey.exr"), np.ones((1, 1, 4), np.float32), True)
        >>> grey.divided(np.array([2.0, 1.0, 0.5])).rgba.ravel().tolist()
        [0.5, 1.0, 2.0, 1.0]
        """
        return replace(self, rgba=self.rgba / np.append(gain, 1).astype(np.float32))


def load_target(path: Path, width: int, height: int) -> Target:
    """Reads one target, with the depth map and the file of what is known of it beside it if there are such,
    and checks that a fit can use it.

    Raises:
        UserError: the file is missing or unreadable, has another size than its sensor's film, holds
            NaN or infinity, has negative or excessive coverage, or no RGB channels.
    """
    if not path.is_file():
        raise UserError(
            f"Target '{path}' is missing; render or copy it there, or name the folder that has it with "
            f"--targets."
        )
    try:
        pixels, channels = read_float_image(path)
    except Exception as error:
        raise UserError(
            f"Target '{path}' cannot be read as an image ({first_line(error)}); write it again "
            f"as an OpenEXR file: a target needs R, G, B and A (or R, G and B)."
        ) from error
    if channels not in ("RGB", "RGBA"):
        raise UserError(
            f"Target '{path}' has the channels '{channels}'; a target needs R, G, B and A (or R, G and B)."
        )
    if pixels.shape[:2] != (height, width):
        found_height, found_width = pixels.shape[:2]
        raise UserError(
            f"Target '{path}' is {found_width} x {found_height} pixels, but its sensor's film is "
            f"{width} x {height}; resize one of them."
        )
    has_alpha = channels == "RGBA"
    if bad := first_not_finite(pixels):
        raise UserError(
            f"Target '{path}' holds NaN or infinity (first at column {bad[0]}, row {bad[1]}); "
            f"mend or mask out those pixels."
        )
    if not has_alpha:
        pixels = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)
    alpha = pixels[..., 3]
    if alpha.min() < -_ALPHA_TOLERANCE or alpha.max() > 1 + _ALPHA_TOLERANCE:
        raise UserError(
            f"Target '{path}' has alpha between {alpha.min():.3g} and {alpha.max():.3g}; "
            f"alpha is coverage and lies between 0 and 1."
        )
    pixels[..., 3] = np.clip(alpha, 0.0, 1.0)
    depth, known = depth_file(path), known_file(path)
    return Target(
        path,
        pixels,
        has_alpha,
        load_depth(depth, width, height) if depth else None,
        load_known(known, width, height) if known else None,
    )


def mean_radiance(targets: list[Target]) -> float:
    """Of what targets cover, over their pixels and channels; a little where all is black."""
    color = sum(float(target.rgba[..., :3].sum(dtype=np.float64)) for target in targets)
    coverage = sum(float(target.rgba[..., 3].sum(dtype=np.float64)) for target in targets)
    return max(color / max(3 * coverage, 1e-6), 1e-6)


def depth_file(path: Path) -> Path | None:
    """The depth map beside a target, if there is one."""
    depth = path.with_suffix(".depth.exr")
    return depth if depth.is_file() else None


def known_file(path: Path) -> Path | None:
    """The file of what is known of a target beside it, if there is one."""
    known = path.with_suffix(".known.exr")
    return known if known.is_file() else None


def load_known(path: Path, width: int, height: int) -> np.ndarray:
    """Reads what is known of a target: per pixel 1 where it tells whether and what it shows of the object, 0
    where it tells nothing, such as behind an occluder, where a mask is in doubt or beyond the photograph's
    frame.

    Returns:
        (height, width) float32 in [0, 1].

    Raises:
        UserError: the file is unreadable, has another size than its sensor's film, more than one channel, or
            values that are no shares.
    """
    known = _one_channel(path, "Known map", "1 where the target is known", width, height)
    if not (np.isfinite(known).all() and known.min() >= 0 and known.max() <= 1):
        raise UserError(
            f"Known map '{path}' has values that are no shares; write 1 where the target is "
            f"known and 0 where it is not."
        )
    return known


def load_depth(path: Path, width: int, height: int) -> np.ndarray:
    """Reads a depth map: per pixel the distance from the camera's centre to the surface, along the ray
    through the pixel's centre, in world units.

    Returns:
        (height, width) float32; 0 where the file has 0, infinity or NaN, which say that nothing was measured.

    Raises:
        UserError: the file is unreadable, has another size than its sensor's film, more than one channel,
            negative distances or none at all.
    """
    distance = _one_channel(path, "Depth map", "the distance along the ray", width, height)
    distance = np.where(np.isfinite(distance), distance, 0.0)
    if distance.min() < 0:
        raise UserError(
            f"Depth map '{path}' has negative distances; write how far the surface is from the "
            f"camera, along the ray."
        )
    if not distance.any():
        raise UserError(f"Depth map '{path}' holds no distance at all; delete it, or write some.")
    return distance


def _one_channel(path: Path, name: str, meaning: str, width: int, height: int) -> np.ndarray:
    """(height, width) of an image that has one channel, or the same in all."""
    try:
        values = read_float_image(path)[0]
    except Exception as error:
        raise UserError(
            f"{name} '{path}' cannot be read as an image ({first_line(error)}); write it again "
            f"as an OpenEXR file."
        ) from error
    if values.shape[2] > 1 and (values != values[..., :1]).any():
        raise UserError(f"{name} '{path}' has {values.shape[2]} different channels; write one, {meaning}.")
    if values.shape[:2] != (height, width):
        raise UserError(
            f"{name} '{path}' is {values.shape[1]} x {values.shape[0]} pixels, but its sensor's "
            f"film is {width} x {height}; resize one of them."
        )
    return values[..., 0]
