"""What is likely wrong with a capture, in sentences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..images import srgb
from .camera import Camera
from .region import MASK_SIZE, Silhouette, agreement, find_box, likely_misreading
from .resample import shrink

#: Fewer views leave a visual hull of few, large facets.
ENOUGH_VIEWS = 20
#: Spread of encoded colour below which an image shows nothing that could be matched between views.
_ONE_COLOR = 0.012
#: Share of the object that may be clipped unnoticed.
_CLIPPED = 0.02


@dataclass(frozen=True)
class Thumbnail:
    """A small copy of one view, enough to judge it.

    Attributes:
        name: the sensor's id, and the photograph's file if known.
        camera: of the small image.
        rgba: (height, width, 4) linear, premultiplied.
        clipped: share of the object's pixels that the photograph clipped, as far as known.
        known: (height, width) share of each pixel of which coverage is known; None is everything.
    """

    name: str
    camera: Camera
    rgba: np.ndarray
    clipped: float = 0.0
    known: np.ndarray | None = None

    @classmethod
    def of(
        cls,
        name: str,
        rgba: np.ndarray,
        camera: Camera,
        clipped: float = 0.0,
        known: np.ndarray | None = None,
    ) -> Thumbnail:
        small, small_camera = shrink(rgba, camera, MASK_SIZE)
        known = None if known is None else shrink(known[..., None], camera, MASK_SIZE)[0][..., 0]
        return cls(name, small_camera, small, clipped, known)

    @property
    def silhouette(self) -> Silhouette:
        return Silhouette(self.camera, self.rgba[..., 3], self.known)


def find_trouble(
    thumbnails: list[Thumbnail], box: np.ndarray, to_scene: np.ndarray, *, has_alpha: bool = True
) -> list[str]:
    """Sentences that name what is likely wrong with training views and the box (2, 3); often none.

    Args:
        to_scene: (4, 4) how an import turned the world after it had read the cameras.
        has_alpha: False if the targets came without coverage, which cannot be judged then.
    """
    found = []
    if len(thumbnails) < ENOUGH_VIEWS:
        found.append(
            f"There are only {len(thumbnails)} training views; take {ENOUGH_VIEWS} or more, from "
            f"all around the object."
        )
    found += _colors(thumbnails)
    if not has_alpha:
        return [*found, "Some targets have no alpha, so neither masks nor cameras can be judged."]
    empty = [t for t in thumbnails if t.silhouette.is_empty]
    seen = [t for t in thumbnails if not t.silhouette.is_empty]
    if empty:
        found.append(f"The masks of {_names(empty)} are empty: those views say that the object is not there.")
    inverted = [t for t in seen if _is_inverted(t.rgba[..., 3])]
    if inverted:
        found.append(
            f"The masks of {_names(inverted)} seem inverted: they cover the border, not the middle; "
            f"coverage is 1 (white) on the object; --invert-masks reads them the other way round."
        )
    full = [t for t in seen if t.rgba[..., 3].min() >= 0.5]
    if full:
        found.append(
            f"The masks of {_names(full)} cover the whole image, so they say nothing of the outline."
        )
    if seen:
        found += _geometry(seen, box, to_scene)
    return found


def _names(thumbnails: list[Thumbnail]) -> str:
    names = ", ".join(t.name for t in thumbnails[:3])
    return names + (f" and {len(thumbnails) - 3} more views" if len(thumbnails) > 3 else "")


def _is_inverted(alpha: np.ndarray) -> bool:
    border = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    height, width = alpha.shape
    middle = alpha[height // 4 : height - height // 4, width // 4 : width - width // 4]
    return bool(border.mean() > 0.7 and middle.mean() < border.mean() - 0.2)


def _colors(thumbnails: list[Thumbnail]) -> list[str]:
    found = []
    flat = [t for t in thumbnails if _is_flat(t.rgba)]
    if flat:
        found.append(
            f"The images {_names(flat)} are nearly all one colour on the object; nothing in them "
            f"can be matched with other views."
        )
    clipped = sorted((t for t in thumbnails if t.clipped > _CLIPPED), key=lambda t: -t.clipped)
    if clipped:
        found.append(
            f"Highlights are clipped in {_names(clipped)} (up to {100 * clipped[0].clipped:.0f} % "
            f"of the object): the light will come out too dim; expose less, or shoot raw or HDR."
        )
    return found


def _is_flat(rgba: np.ndarray) -> bool:
    rgb = rgba[rgba[..., 3] > 0.99][:, :3]
    return len(rgb) > 0 and bool(srgb(rgb / max(rgb.max(), 1e-6)).std(axis=0).max() < _ONE_COLOR)


def _geometry(seen: list[Thumbnail], box: np.ndarray, to_scene: np.ndarray) -> list[str]:
    found = []
    silhouettes = [t.silhouette for t in seen]
    missed = np.array([_share_outside(s, box) for s in silhouettes])
    if missed.mean() > 0.01 and (own := find_box(silhouettes)) is not None:
        agreeing = agreement(silhouettes, own)
    else:
        own, agreeing = None, agreement(silhouettes, box)
    if agreeing.mean() < 0.9:
        found.append(_disagreement(seen, agreeing, to_scene))
    elif own is not None:
        worst = int(missed.argmax())
        low, high = (" ".join(f"{value:.3g}" for value in corner) for corner in own)
        found.append(
            f"The box misses the object: {100 * missed.mean():.0f} % of the masks lie beside it "
            f"({100 * missed[worst]:.0f} % in {seen[worst].name}); --box {low} {high} would hold "
            "it."
        )
    directions = np.stack([s.camera.center - box.mean(axis=0) for s in silhouettes])
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    if np.linalg.norm(directions.mean(axis=0)) > 0.8:
        found.append("All views look from one side; what they do not see is not reconstructed.")
    return found


def _disagreement(seen: list[Thumbnail], agreeing: np.ndarray, to_scene: np.ndarray) -> str:
    misreading = likely_misreading([t.silhouette for t in seen], to_scene)
    if misreading:
        return f"The cameras look misread: the masks agree only if {misreading}."
    bad = [t for t, share in zip(seen, agreeing, strict=True) if share < 0.7]
    return (
        f"The masks do not agree on a common volume ({100 * agreeing.mean():.0f} % of their pixels do)"
        f"{': worst are ' + _names(bad) if bad else ''}; check the cameras' convention, the masks and "
        f"the order of the images."
    )


def _share_outside(silhouette: Silhouette, box: np.ndarray) -> float:
    """Share of the mask whose lines of sight do not meet the box."""
    rows, columns = np.nonzero(silhouette.alpha >= 0.5)
    if len(rows) == 0:
        return 0.0
    ray = silhouette.direction(np.stack([columns, rows], axis=-1) + 0.5)
    ray = np.where(np.abs(ray) < 1e-12, 1e-12, ray)
    planes = (box[:, None] - silhouette.camera.center) / ray
    enter, leave = planes.min(axis=0).max(axis=1), planes.max(axis=0).min(axis=1)
    return float((leave < np.maximum(enter, 0)).mean())
