"""The views of a fit on its page: pictures of them, and their scores with the worst first."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..errors import UserError
from ..evaluation import Scores
from ..export.views import HELD_OUT, MASKS, TRAINING
from ..integer_images import open_image
from .data_urls import image_url

#: Most held-out views whose pictures are shown, and most overlays of masks: a page has to stay small.
_HELD_OUT_SHOWN, _MASKS_SHOWN = 24, 8

#: Pixels of the longer side of a picture of these.
_SIDE = 320

#: Columns of a table: score, its heading and digits.
_COLUMNS = (
    ("psnr", "PSNR, dB", 2),
    ("psnr_inside", "inside the mask, dB", 2),
    ("ssim", "SSIM", 4),
    ("flip", "FLIP", 4),
    ("mask_iou", "IoU of the masks", 4),
)

#: Columns of the table of corrections: heading and digits.
_CORRECTIONS = (("pixels", "pixels", 2), ("degrees", "degrees", 3), ("stops", "stops", 3))

CORRECTION_HEADINGS = [heading for _, heading, _ in _CORRECTIONS]

HEADINGS = [heading for _, heading, _ in _COLUMNS]


def score_rows(scored: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Rows of a table of an entry of ``metrics.json``: the mean, then the views by PSNR, the worst first."""
    views = sorted(scored["views"].items(), key=lambda view: view[1]["psnr"])
    return [
        (name, [_shown(scores.get(score), digits) for score, _, digits in _COLUMNS])
        for name, scores in [("mean", scored["mean"]), *views]
    ]


def correction_rows(metrics: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Rows of a table of how views were corrected: by how much in the image, about which angle, and how much
    brighter than the others they were exposed; the largest first. None if they are as given."""
    poses, stops = metrics.get("poses", {}).get("views", {}), metrics.get("exposures", {}).get("stops", {})
    views = {
        name: poses.get(name, {}) | ({"stops": stops[name]} if name in stops else {})
        for name in poses | stops
    }
    size = {name: (told.get("pixels", 0), abs(told.get("stops", 0))) for name, told in views.items()}
    return [
        (name, [_shown(views[name].get(column), digits) for column, _, digits in _CORRECTIONS])
        for name in sorted(views, key=lambda name: size[name], reverse=True)
    ]


def training_pictures(folder: Path, count: int, metrics: dict) -> list[dict]:
    """Target, fit and error of up to ``count`` training views, spread evenly, as data URLs."""
    paths = sorted((folder / TRAINING).glob("*.png"))
    spread = np.linspace(0, max(len(paths) - 1, 0), min(count, len(paths)))
    chosen = np.unique(spread.round().astype(int))
    shown = []
    for path in (paths[i] for i in chosen):
        target, fit, error = map(image_url, np.split(_triptych(path), 3, axis=1))
        shown.append(
            {
                "name": path.stem,
                "target": target,
                "fit": fit,
                "error": error,
                "psnr": metrics["training"]["views"].get(path.stem, {}).get("psnr"),
            }
        )
    return shown


def held_out_pictures(folder: Path, metrics: dict) -> list[dict]:
    """Triptychs of the held-out views, the worst first, as data URLs."""
    views = metrics.get("held_out", {}).get("views", {})
    paths = _worst((folder / HELD_OUT).glob("*.png"), views, "psnr")[:_HELD_OUT_SHOWN]
    return [
        {
            "name": path.stem,
            "psnr": views[path.stem]["psnr"],
            "picture": image_url(_shrunk(_triptych(path), 3 * _SIDE)),
        }
        for path in paths
    ]


def mask_pictures(folder: Path, metrics: dict) -> list[dict]:
    """Overlays of the views whose masks agree worst, cut to what they show, as data URLs."""
    held_out = metrics.get("held_out", {}).get("views", {})
    views = metrics["training"]["views"] | held_out
    paths = _worst((folder / MASKS).glob("*.png"), views, "mask_iou")[:_MASKS_SHOWN]
    return [
        {
            "name": path.stem,
            "held_out": path.stem in held_out,
            "iou": views[path.stem]["mask_iou"],
            "picture": image_url(_shrunk(_cropped(_pixels(path)), _SIDE), lossless=True),
        }
        for path in paths
    ]


def _worst(paths: Iterable[Path], views: Mapping[str, Scores], score: str) -> list[Path]:
    """Those whose view has the score, the lowest first."""
    scored = {
        path: found for path in sorted(paths) if (found := views.get(path.stem, {}).get(score)) is not None
    }
    return sorted(scored, key=lambda path: scored[path])


def _triptych(path: Path) -> np.ndarray:
    pixels = _pixels(path)
    if pixels.shape[1] < 3:
        raise UserError(
            f"'{path}' is too narrow for three pictures side by side; remove it, or run the fit again."
        )
    return pixels[:, : pixels.shape[1] // 3 * 3]


def _pixels(path: Path) -> np.ndarray:
    try:
        return np.asarray(open_image(path).convert("RGB"))
    except (OSError, SyntaxError, ValueError) as error:
        raise UserError(f"'{path}' cannot be read as an image; remove it, or run the fit again.") from error


def _cropped(pixels: np.ndarray) -> np.ndarray:
    """The part that is not white, with a margin; all if everything is."""
    rows, columns = (np.flatnonzero((pixels < 255).any(axis=(2, axis))) for axis in (1, 0))
    if len(rows) == 0:
        return pixels
    margin = max(2, len(pixels) // 50)
    return pixels[
        max(rows[0] - margin, 0) : rows[-1] + margin + 1,
        max(columns[0] - margin, 0) : columns[-1] + margin + 1,
    ]


def _shrunk(pixels: np.ndarray, side: int) -> np.ndarray:
    """An image no longer than ``side`` pixels."""
    height, width = pixels.shape[:2]
    factor = side / max(height, width)
    if factor >= 1:
        return pixels
    size = max(round(factor * width), 1), max(round(factor * height), 1)
    return np.asarray(Image.fromarray(np.ascontiguousarray(pixels)).resize(size, Image.Resampling.BOX))


def _shown(score: float | None, digits: int) -> str:
    return "–" if score is None else f"{score:.{digits}f}"
