"""Environment maps from files, checked before anything is lit by them."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

from .errors import UserError, last_line
from .float_images import first_not_finite, read_float_image


def read_environment_map(path: Path, name: str) -> np.ndarray:
    """(height, width, 3) linear radiance of a latitude-longitude map; alpha is left out, grey repeated, and
    negative values, which filters leave beside a sun, are 0.

    Args:
        path: an OpenEXR file, or another image that Mitsuba reads.
        name: what the map is called in messages, such as ``--light``.

    Raises:
        UserError: it is missing, no image, or holds NaN or infinity.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{name} '{path}' does not exist; check the path.")
    try:
        pixels, channels = read_float_image(path)
    except Exception as error:
        raise UserError(
            f"{name} '{path}' cannot be read as an image ({last_line(error)}); give a latitude-longitude "
            f"environment map such as an OpenEXR file."
        ) from error
    if bad := first_not_finite(pixels):
        raise UserError(
            f"{name} '{path}' holds NaN or infinity (first at column {bad[0]}, row {bad[1]}); "
            f"mend those pixels, or clamp a sun beyond what half floats hold."
        )
    color = pixels[..., :3] if channels.startswith("RGB") else np.repeat(pixels[..., :1], 3, axis=-1)
    return np.maximum(color, 0)


def environment_emitter(path: Path, name: str) -> mi.Emitter:
    """An ``envmap`` emitter with the id ``light`` of a file; raises what ``read_environment_map`` does."""
    radiance = read_environment_map(path, name)
    try:
        return mi.load_dict({"type": "envmap", "id": "light", "bitmap": mi.Bitmap(radiance)})
    except Exception as error:
        raise UserError(
            f"{name} '{path}' is no environment map ({last_line(error)}); give a latitude-longitude image "
            f"in OpenEXR."
        ) from error
