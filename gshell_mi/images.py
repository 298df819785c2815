"""Images for people: sRGB, over white, side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from .files import replacing


def srgb(linear: np.ndarray) -> np.ndarray:
    """Linear Rec.709 to sRGB (IEC 61966-2-1), clipped to [0, 1].

    >>> float(srgb(np.array(0.5)).round(4))
    0.7354
    """
    linear = np.clip(linear, 0.0, 1.0)
    curve = 1.055 * np.maximum(linear, 1e-8) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curve)


def over_white(rgba: np.ndarray) -> np.ndarray:
    """(h, w, 4) linear premultiplied to (h, w, 3) sRGB in front of white."""
    return srgb(rgba[..., :3] + (1 - rgba[..., 3:]))


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of arrays with peak 1; 120 dB if they are equal.

    >>> round(psnr(np.zeros(4), np.full(4, 0.1)), 2)
    20.0
    """
    return decibels(float(np.mean((image - reference) ** 2)))


def decibels(squared_error: float) -> float:
    """PSNR of a mean squared error of arrays with peak 1; 120 dB if that is 0."""
    return float(-10 * np.log10(squared_error + 1e-12))


def triptych(target: np.ndarray, fit: np.ndarray) -> np.ndarray:
    """Target, fit and 4 x their absolute difference side by side, sRGB; inputs linear RGBA."""
    left, middle = over_white(target), over_white(fit)
    return np.concatenate([left, middle, np.clip(4 * np.abs(left - middle), 0, 1)], axis=1)


#: Colours of ``mask_overlay``, sRGB, which the colour-blind tell apart.
BOTH, UNKNOWN = (0.78, 0.78, 0.78), (0.94, 0.92, 0.80)
MASK_ONLY, FIT_ONLY = (0.0, 0.45, 0.70), (0.90, 0.45, 0.0)


def mask_overlay(target: np.ndarray, fit: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Where two masks differ: (h, w, 3) sRGB, white where neither is.

    Args:
        target, fit: (h, w) coverage, which counts from 1/2 on.
        known: (h, w) booleans, where the target's means anything.
    """
    target, fit = target > 0.5, fit > 0.5
    overlay = np.ones((*target.shape, 3))
    for chosen, color in (
        (target & fit, BOTH),
        (target & ~fit, MASK_ONLY),
        (fit & ~target, FIT_ONLY),
        (~known, UNKNOWN),
    ):
        overlay[chosen] = color
    return overlay


def write_png(path: Path, image: np.ndarray, *, comment: str = "") -> None:
    """Writes (h, w, 3) sRGB values in [0, 1].

    Args:
        comment: a word in the file, such as who wrote it.
    """
    text = PngInfo()
    if comment:
        text.add_text("Software", comment)
    with replacing(path) as partial:
        Image.fromarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)).save(partial, pnginfo=text)
