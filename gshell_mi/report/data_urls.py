"""Pictures and other data as part of a page."""

from __future__ import annotations

import base64
import io

import numpy as np
from PIL import Image


def image_url(pixels: np.ndarray, *, lossless: bool = False) -> str:
    """An image, (h, w, 3) in 8 bits, as WebP."""
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "WEBP", quality=90, lossless=lossless)
    return data_url("image/webp", stream.getvalue())


def data_url(kind: str, data: bytes) -> str:
    """Bytes of a MIME type.

    >>> data_url("text/plain", b"abc")
    'data:text/plain;base64,YWJj'
    """
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
