"""Scores of one image against another."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from skimage.metrics import structural_similarity

from ..compat import colour_science
from ..errors import UserError, first_line
from ..float_images import image_size
from ..images import over_white, psnr
from ..targets import Target, load_target

#: The names of the scores, whether greater is better, and what they are.
IMAGE_SCORES = {
    "psnr": (True, "dB, sRGB over white, peak 1"),
    "psnr_inside": (True, "the same where both have alpha > 1/2; None where no pixel has"),
    "ssim": (True, "structural similarity, sRGB over white"),
    "flip": (False, "mean FLIP (LDR), sRGB over white"),
    "relative_mse": (False, "mean of (a - b)^2 / (b^2 + 0.01), linear"),
    "delta_e": (False, "mean CIE Delta E 2000 over white, where either shows the object"),
    "mask_iou": (True, "intersection over union of alpha > 1/2"),
}

#: Those that a fit gives its own views.
VIEW_SCORES = ("psnr", "psnr_inside", "ssim", "flip", "mask_iou")

#: Scores by name; None for one that there is not.
Scores = Mapping[str, float | None]

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
        raise UserError(
            f"Image '{path}' cannot be read ({first_line(error)}); write it again as OpenEXR."
        ) from error
    return load_target(path, *size).rgba


def image_scores(
    image: np.ndarray, reference: np.ndarray, known: np.ndarray | None = None
) -> tuple[Scores, np.ndarray]:
    """The scores ``IMAGE_SCORES`` of two (h, w, 4) linear premultiplied images, and the FLIP map: (h, w, 3)
    in the colours of magma. Where the (h, w) reference is not ``known``, nothing is held against the image.

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
        raise UserError(
            f"The images are {_size(image)} and {_size(reference)} pixels; only images of one "
            f"size can be compared."
        )
    if min(image.shape[:2]) < _SSIM_WINDOW:
        raise UserError(f"The images are {_size(image)} pixels; SSIM needs {_SSIM_WINDOW} at least per side.")
    reference, counted = _as_known(image, reference, known)
    left, right = over_white(image), over_white(reference)
    first, second = (image[..., 3] > 0.5) & counted, (reference[..., 3] > 0.5) & counted
    scores, flip_map = _scores(left, right, first, second)
    union, squared = first | second, (image[..., :3] - reference[..., :3]) ** 2
    scores["relative_mse"] = float((squared / (reference[..., :3] ** 2 + _RELATIVE_FLOOR)).mean())
    scores["delta_e"] = float(_delta_e(left[union], right[union]).mean()) if union.any() else 0.0
    return scores, flip_map


def mean_scores(views: Iterable[Scores]) -> Scores:
    """The mean of each score over the views that have it; None if none has.

    >>> mean_scores([{"psnr": 20.0, "psnr_inside": None}, {"psnr": 30.0, "psnr_inside": 18.0}])
    {'psnr': 25.0, 'psnr_inside': 18.0}
    """
    given: dict[str, list[float]] = {}
    for scores in views:
        for name, score in scores.items():
            given.setdefault(name, []).extend([] if score is None else [score])
    return {name: float(np.mean(found)) if found else None for name, found in given.items()}


def view_scores(image: np.ndarray, target: Target) -> Scores:
    """The scores ``VIEW_SCORES`` of a rendered view, (h, w, 4) linear premultiplied, and its target.

    Where the target is not known, nothing is held against the image. ``mask_iou`` is None if the target came
    without alpha, and ``ssim`` of images below 7 pixels.
    """
    reference, counted = _as_known(image, target.rgba, np.asarray(target.known))
    first, second = (image[..., 3] > 0.5) & counted, (reference[..., 3] > 0.5) & counted
    scores, _ = _scores(over_white(image), over_white(reference), first, second)
    return scores if target.has_alpha else scores | {"mask_iou": None}


def _as_known(
    image: np.ndarray, reference: np.ndarray, known: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """A reference that is the image where it is unknown, and (h, w) which pixels of masks count."""
    if known is None:
        return reference, np.ones(reference.shape[:2], bool)
    share = known[..., None]
    return share * reference + (1 - share) * image, known > 0.5


def _scores(
    left: np.ndarray, right: np.ndarray, first: np.ndarray, second: np.ndarray
) -> tuple[dict[str, float | None], np.ndarray]:
    """``VIEW_SCORES`` of (h, w, 3) sRGB images and their (h, w) masks; and the FLIP map."""
    import flip_evaluator

    flip_map, flip, _ = flip_evaluator.evaluate(
        right.astype(np.float32), left.astype(np.float32), "LDR", applyMagma=True
    )
    both, union = first & second, np.count_nonzero(first | second)
    similarity: Any = None
    if min(left.shape[:2]) >= _SSIM_WINDOW:
        similarity = structural_similarity(left, right, channel_axis=2, data_range=1.0)
    return {
        "psnr": psnr(left, right),
        "psnr_inside": psnr(left[both], right[both]) if both.any() else None,
        "ssim": None if similarity is None else float(similarity),
        "flip": float(flip),
        "mask_iou": np.count_nonzero(both) / union if union else 1.0,
    }, np.asarray(flip_map)


def _lab(srgb: np.ndarray) -> np.ndarray:
    colour = colour_science()
    return colour.XYZ_to_Lab(colour.sRGB_to_XYZ(srgb))


def _delta_e(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return colour_science().delta_E(_lab(first), _lab(second), method="CIE 2000")


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"
