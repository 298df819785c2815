"""How a fit looks in its views, those that it was made from and those held out: pictures and scores."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from ..evaluation import Scores, mean_scores, view_scores
from ..images import mask_overlay, triptych, write_png
from ..scene_files import load_scene
from ..wording import counted
from .stock_scene import MAX_DEPTH

if TYPE_CHECKING:
    from ..scene import View

#: Folders of a fit's pictures: triptychs of training views and of those held out, and masks of both.
TRAINING, HELD_OUT, MASKS = "views", "held_out", "masks"

_SPP = 32


def view_files(training: Iterable[str], held_out: Iterable[str]) -> list[str]:
    """The files that ``write_views`` may write for views of these ids.

    >>> view_files(["a"], ["b"])
    ['views/a.png', 'masks/a.png', 'held_out/b.png', 'masks/b.png']
    """
    views = [(TRAINING, name) for name in training] + [(HELD_OUT, name) for name in held_out]
    return [f"{folder}/{name}.png" for place, name in views for folder in (place, MASKS)]


def write_views(
    output: Path,
    folder: str | None,
    views: Sequence[View],
    lights: Sequence[mi.Transform4f],
    gains: Sequence[np.ndarray] | np.ndarray = (),
) -> dict:
    """Scores renders of the exported scene; writes triptychs, and masks of views whose targets have alpha.

    Args:
        output: the fit's folder, with ``scene.xml``.
        folder: in it, for the triptychs; None writes no pictures.
        views: one or more.
        lights: per view ``to_world`` of the light, if it turns with the camera.
        gains: per view what its three channels are multiplied by, as its target was exposed so; none if all
            were exposed alike.

    Returns:
        ``views``, the scores by view, and ``mean``, rounded: an entry of ``metrics.json``.
    """
    if folder:
        (output / folder).mkdir(exist_ok=True)
    scene = load_scene(output / "scene.xml")
    integrator = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH, "hide_emitters": True})
    scores, parameters = dict[str, Scores](), mi.traverse(scene)
    for index, view in enumerate(views):
        if lights:
            parameters["light.to_world"] = lights[index]
            parameters.update()
        image = np.array(mi.render(scene, sensor=view.sensor, integrator=integrator, spp=_SPP))
        if len(gains):
            image[..., :3] *= gains[index]
        name, target = view.sensor.id(), view.target
        scores[name] = view_scores(image, target)
        if folder:
            write_png(output / folder / f"{name}.png", triptych(target.rgba, image))
        if folder and target.has_alpha:
            (output / MASKS).mkdir(exist_ok=True)
            overlay = mask_overlay(target.rgba[..., 3], image[..., 3], np.asarray(target.known) > 0.5)
            write_png(output / MASKS / f"{name}.png", overlay)
    return {
        "views": {name: _rounded(found) for name, found in scores.items()},
        "mean": _rounded(mean_scores(scores.values())),
    }


def scores_line(scores: dict) -> str:
    """What ``write_views`` returned, for people.

    >>> view = {"psnr": 27.08, "psnr_inside": 24.5, "ssim": 0.95, "flip": 0.04, "mask_iou": None}
    >>> scores_line({"views": {"a": view}, "mean": view})
    '27.08 dB (24.50 dB inside the mask), SSIM 0.950, FLIP 0.040 over 1 view; worst: a, 27.08 dB'
    """
    mean, views = scores["mean"], scores["views"]
    inside = "" if mean["psnr_inside"] is None else f" ({mean['psnr_inside']:.2f} dB inside the mask)"
    parts = [f"{mean['psnr']:.2f} dB{inside}"]
    parts += [
        f"{label} {mean[name]:.3f}"
        for name, label in (("ssim", "SSIM"), ("flip", "FLIP"), ("mask_iou", "IoU"))
        if mean[name] is not None
    ]
    worst = min(views, key=lambda name: views[name]["psnr"])
    return (
        f"{', '.join(parts)} over {counted(len(views), 'view')}; "
        f"worst: {worst}, {views[worst]['psnr']:.2f} dB"
    )


def _rounded(scores: Scores) -> Scores:
    return {name: None if score is None else round(score, 4) for name, score in scores.items()}
