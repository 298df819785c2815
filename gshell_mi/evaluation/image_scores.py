"""Scores of one image against another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from skimage.metrics import structural_similarity

from ..compat import colour_science
from ..errors import UserError
from ..float_images import image_size
from ..images import over_white, psnr
from ..targets import load_target

#: The names of the scores, whether greater is better, and what they are.
IMAGE_SCORES = {
    "psnr": (True, "dB, sRGB over white, peak 1"),
    "ssim": (True, "structural similarity, sRGB over white"),
    "flip": (False, "mean FLIP (LDR), sRGB over white"),
    "relative_mse": (False, "mean of (a - b)^2 / (b^2 + 0.01), linear"),
    "delta_e": (False, "mean CIE Delta E 2000 over white, where either shows the object"),
    "mask_iou": (True, "intersection over union of alpha > 1/2"),
}

_RELATIVE_FLOOR = 0.01
_SSIM_WINDOW = 7


def read_image(path: Path) -> np.ndarray:
    """An EXR file as (h, w, 4) linear Rec.709, premultiplied by alpha; alpha is 1 if it has none.

    Raises:
        UserError: the file is missing, no image or holds NaN.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"Image '{path}' does not exist; check the path.")
    try:
        size = image_size(path)
    except Exception as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise UserError(f"Image '{path}' cannot be read ({reason}); write it again as OpenEXR.") from error
    return load_target(path, *size).rgba


def image_scores(image: np.ndarray, reference: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
    """The scores ``IMAGE_SCORES`` of two (h, w, 4) linear premultiplied images, and the FLIP map: (h, w, 3)
    in the colours of magma.

    FLIP: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020, at its default
    67 pixels per degree.

    >>> grey = np.full((16, 16, 4), 0.5)
    >>> scores, _ = image_scores(grey, grey)
    >>> scores["psnr"], scores["ssim"], scores["flip"], scores["mask_iou"]
    (120.0, 1.0, 0.0, 1.0)

    Raises:
        UserError: the sizes differ or are below 7 pixels.
    """
    if image.shape != reference.shape:
        raise UserError(f"The images are {_size(image)} and {_size(reference)} pixels; only images of one "
                        f"size can be compared.")
    if min(image.shape[:2]) < _SSIM_WINDOW:
        raise UserError(f"The images are {_size(image)} pixels; SSIM needs {_SSIM_WINDOW} at least per side.")
    import flip_evaluator

    left, right = over_white(image), over_white(reference)
    flip_map, flip, _ = flip_evaluator.evaluate(right.astype(np.float32), left.astype(np.float32), "LDR",
                                                applyMagma=True)
    shown = (image[..., 3] > 0.5, reference[..., 3] > 0.5)
    union, both = shown[0] | shown[1], shown[0] & shown[1]
    similarity: Any = structural_similarity(left, right, channel_axis=2, data_range=1.0)  # one number so
    squared = (image[..., :3] - reference[..., :3]) ** 2
    return {
        "psnr": psnr(left, right),
        "ssim": float(similarity),
        "flip": float(flip),
        "relative_mse": float((squared / (reference[..., :3] ** 2 + _RELATIVE_FLOOR)).mean()),
        "delta_e": float(_delta_e(left[union], right[union]).mean())
        if union.any() else 0.0,
        "mask_iou": float(both.sum() / union.sum()) if union.any() else 1.0,
    }, np.asarray(flip_map)


def _lab(srgb: np.ndarray) -> np.ndarray:
    colour = colour_science()
    return colour.XYZ_to_Lab(colour.sRGB_to_XYZ(srgb))


def _delta_e(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return colour_science().delta_E(_lab(first), _lab(second), method="CIE 2000")


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"
