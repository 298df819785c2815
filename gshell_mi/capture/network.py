"""A network's opinion of where the object is: ``rembg``, an extra."""

from __future__ import annotations

from functools import cache

import numpy as np
from PIL import Image

from ..errors import UserError, first_line


def object_probability(image: np.ndarray) -> np.ndarray:
    """(height, width) in [0, 1] of an (height, width, 3) uint8 image.

    Raises:
        UserError: ``rembg`` is missing, or its model is neither on this machine nor to be had.
    """
    rembg, session = _session()
    mask = rembg.remove(Image.fromarray(image), session=session, only_mask=True)
    return np.asarray(mask.convert("L"), np.float32) / 255


@cache
def _session() -> tuple:
    try:
        import rembg  # pyright: ignore[reportMissingImports]  # an extra
    except (ImportError, SystemExit):  # it ends the process where it finds no onnxruntime
        raise UserError(
            "--make-masks rembg needs the package: install it with `pip install "
            "'gshell_mi[rembg]'`, or choose grabcut."
        ) from None
    try:
        return rembg, rembg.new_session("u2net")
    except Exception as error:  # a download that fails, by whatever library does it
        raise UserError(
            f"rembg's model cannot be had ({first_line(error)}); connect to the internet once, put the "
            f"model where rembg looks for it, or choose --make-masks grabcut."
        ) from error
