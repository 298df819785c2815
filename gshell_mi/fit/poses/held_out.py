"""Held-out views, laid on the surface as the others were."""

from __future__ import annotations

from dataclasses import replace

from ...scene import View
from ...views import PinholeViews
from ..stage import Fit
from ..surface import Surface
from .corrections import Corrections
from .laying import Laying


def held_out_views(fit: Fit, surface: Surface) -> list[View]:
    """The held-out views with cameras that are corrected by six numbers each; none if the others' were not.

    Where poses are a pixel off, scores of views that keep theirs tell of poses more than of the surface
    (Wang et al. 2021, "NeRF--", which scores so). Nothing but the cameras is fitted to them.

    Args:
        fit: what all views tell is part of it.
        surface: the result.
    """
    held_out, count = fit.scene.held_out, len(fit.scene.sensors)
    if surface.poses is None or not held_out:
        return []
    sensors = [view.sensor for view in held_out]
    views = PinholeViews.from_sensors([*fit.scene.sensors, *sensors])
    targets = [*fit.scene.targets, *(view.target for view in held_out)]
    mesh, config = fit.scene.subject.surface_of(surface.fields).to_numpy()[:2], fit.config.cameras
    laying = Laying(mesh, views, targets, config, cell=fit.cell(surface), seed=fit.config.seed)
    for level in range(config.levels):
        laying.level(level)
    found = Corrections.from_array(laying.alignment.found.to_array()[count:])
    return [
        replace(view, sensor=sensor) for view, sensor in zip(held_out, found.sensors(sensors), strict=True)
    ]
