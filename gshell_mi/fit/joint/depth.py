"""Depth maps of the training views against the surface."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ...errors import UserError
from ...pixels import COVERED
from ...scene import FitScene
from ...views import PinholeViews


def check_depth(given: FitScene, views: PinholeViews) -> None:
    """Whether the depth maps can be distances to something in the lattice's box.

    Raises:
        UserError: a map has no distance between the nearest and the farthest point of the box.
    """
    to_world = np.array(given.subject.to_world.matrix, dtype=np.float64).reshape(4, 4)
    side = np.array([-1.0, 1.0])
    corners = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    corners = corners @ to_world[:3, :3].T + to_world[:3, 3]
    for target, origin in zip(given.targets, views.origins, strict=True):
        if target.depth is None:
            continue
        local = np.linalg.inv(to_world) @ np.append(origin, 1)
        nearest = to_world @ np.append(np.clip(local[:3], -1, 1), 1)
        low, high = np.linalg.norm(nearest[:3] - origin), np.linalg.norm(corners - origin, axis=1).max()
        known = target.depth[target.depth > 0]
        if not ((known >= low) & (known <= high)).any():
            path = target.path.with_suffix(".depth.exr")
            raise UserError(
                f"Depth map '{path}' has distances from {known.min():.4g} to {known.max():.4g}, "
                f"but the box of '{given.path}' is {low:.4g} to {high:.4g} away from that camera; "
                f"write distances in the scene's unit."
            )


def depth_error(given: FitScene, views: PinholeViews, scene: mi.Scene) -> float | None:
    """Median absolute difference between the maps and the distance to the surface, world units.

    Pixels that see no surface do not count. None without maps.
    """
    errors = []
    for index, target in enumerate(given.targets):
        if target.depth is None:
            continue
        hit = scene.ray_intersect_preliminary(views.pixel_rays(index))
        found = hit.is_valid() & (hit.shape == mi.ShapePtr(given.subject))
        distance = np.where(found.numpy(), hit.t.numpy(), 0)
        known = target.depth.ravel()
        both = (known > 0) & (distance > 0) & (np.asarray(target.known).ravel() > COVERED)
        errors.append(np.abs(distance - known)[both])
    return float(np.median(np.concatenate(errors))) if errors and sum(map(len, errors)) else None
