"""Held-out views, laid on the surface as the others were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...calibration.corrections import Corrections
from ...scene import View
from ...views import PinholeViews
from ..stage import Fit
from ..surface import Surface
from .laying import Laying


def held_out_views(fit: Fit, surface: Surface) -> list[View]:
    """The held-out views with cameras that are laid on the surface; none if the others were not.

    Where poses are a pixel off, scores of views that keep theirs tell of poses more than of the surface
    (Wang et al. 2021, "NeRF--", which scores so). Nothing but six numbers per camera is fitted to them, the
    other cameras stay, and so do those of the held-out ones that are hardly wrong.

    Args:
        fit: corrected by what the surface tells of views.
        surface: the result.

    Returns:
        The views in their order, with the same targets.
    """
    held_out, count = fit.scene.held_out, len(fit.scene.sensors)
    mesh, config = fit.mesh(surface), fit.config.cameras
    if surface.poses is None or not held_out or not len(mesh[1]):
        return []
    sensors = [view.sensor for view in held_out]
    views = PinholeViews.from_sensors([*fit.scene.sensors, *sensors])
    targets = [*fit.scene.targets, *(view.target for view in held_out)]
    moving, cell = np.arange(len(views)) >= count, fit.cell(surface)
    laying = Laying(mesh, views, targets, config, cell=cell, seed=fit.config.seed, moving=moving)
    for level in range(config.levels):
        laying.level(level)
    found = Corrections.from_array(laying.alignment.found.to_array()[count:])
    return [
        replace(view, sensor=sensor) for view, sensor in zip(held_out, found.sensors(sensors), strict=True)
    ]
