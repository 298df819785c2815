"""What a fit says of its own result: diagnostics and the error against depth maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import mitsuba as mi

from ..diagnostics import diagnose
from ..scene import FitScene
from ..views import PinholeViews
from .joint.depth import depth_error


def findings(fit: FitScene, views: PinholeViews, scene: mi.Scene, warn: Callable[[str], None]) -> dict:
    """Entries of ``metrics.json``: ``diagnostics``, ``warnings`` and, with depth maps, ``depth_error``.

    Args:
        fit: its subject is the result.
        views: the training views.
        scene: a scene of the subject.
        warn: called with every warning, to show it.
    """
    subject = fit.subject
    arrays = [mesh.to_numpy()[:2] for mesh in (subject.surface, subject.template())]
    found = diagnose(*arrays, views, subject.cell_size)
    warnings = found.warnings()
    for warning in warnings:
        warn(warning)
    metrics = {"diagnostics": dataclasses.asdict(found), "warnings": warnings}
    error = depth_error(fit, views, scene)
    return metrics if error is None else metrics | {"depth_error": error}
