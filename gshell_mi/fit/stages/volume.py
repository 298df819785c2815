"""Volume: another start than the hull, from a radiance volume; unseen views judge, place by place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import mitsuba as mi
import numpy as np

from ...bounds import Between
from ...fields.visual_hull import visual_hull
from ...radiance.config import TrainingConfig
from ...radiance.volume import RadianceVolume, sides_of_levels
from ..runner import Steps
from ..stage import Fit
from ..surface import Surface
from ..unseen import without_unseen_parts
from ..volume.merging import merged
from ..volume.volume_surface import volume_surface

#: From coarse to fine: what all views can tell of first.
_LEVELS = 3


@dataclass(frozen=True)
class VolumeConfig(TrainingConfig):
    """Radiance volume: another start, for what no hull shows."""

    iterations: int = 700
    """Steps of the radiance volume; the joint stage starts from what of its surface explains unseen views
    better. 0 leaves it out."""
    side: Annotated[int, Between(4)] = 256
    """Voxels per side of its last level, rounded up to whole bricks of the first."""
    resolution: Annotated[int, Between(4)] = 128
    """Cells per side of the lattice, at least, if the fit starts from it and --resolution does not say."""
    detail_resolution: Annotated[int, Between(4)] = 128
    """Cells per side, at least, that the detail stage ends on then, in blocks around the surface."""


class Volume:
    """Takes what a radiance volume shows of the surface where that explains unseen views better."""

    name = "volume"

    def __init__(self, config: VolumeConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface, or one with places of the volume's, on a lattice of its own. Lattices whose vertices
        make no cube have none."""
        lattice = fit.lattices.volume
        if lattice.vertex_count != lattice.stride**3:
            return surface
        steps.fact("volume_kept", False)
        volume = self._volume(fit, fit.mesh(surface), steps.kept)
        steps.run(volume, self.config.iterations, volume.optimizers, volume.arrays)
        with steps.task("depth", len(fit.views)) as advance:
            other = volume_surface(volume, fit.scene, fit.masks, lattice, surface.sight.light, advance)
        if other is None:
            return surface
        with steps.task("verdict"):
            found = merged(fit, surface, other)
        steps.fact("volume", found.facts())
        steps.fact("volume_kept", found.surface is not None)
        return surface if found.surface is None else without_unseen_parts(fit, found.surface)

    def _volume(
        self, fit: Fit, surface: tuple[np.ndarray, np.ndarray], kept: Mapping[str, np.ndarray]
    ) -> RadianceVolume:
        """A radiance volume inside the visual hull, or the one that was begun."""
        sides, subject = sides_of_levels(self.config.side, _LEVELS), fit.scene.subject
        side = sides[0]
        centre = (np.arange(side, dtype=np.float32) + 0.5) * (2 / side) - 1
        z, y, x = (axis.ravel() for axis in np.meshgrid(centre, centre, centre, indexing="ij"))
        points = mi.Transform4f(subject.to_world) @ mi.Point3f(x, y, z)
        hull = visual_hull(points, fit.masks)
        hull = np.clip(hull.numpy() / subject.length_scale, -1, 1).reshape((side,) * 3)
        return RadianceVolume(
            hull,
            subject.to_world,
            fit.views,
            fit.pixels,
            self.config,
            sides,
            surface,
            kept,
            seed=fit.config.seed,
        )
