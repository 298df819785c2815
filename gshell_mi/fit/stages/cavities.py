"""Cavities: what the hull bridges. Behind openings walls are tried; elsewhere a fog tells what is empty.

Two ways lead there. An opening may be the mouth of something solid, such as a mug: then a wall behind it
explains unseen views much better than a sheet (``carving/vessels.py``). And a fold is empty though it lies
inside the hull: a fog of density and radiance shows it, and a minimum cut carves it (``carving/carving.py``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...radiance.config import TrainingConfig
from ...radiance.volume import RadianceVolume, sides_of_levels
from ..carving.carving import carve
from ..carving.vessels import hollowed_vessels
from ..runner import Steps
from ..stage import Fit
from ..surface import Surface
from ..template import closed_template

#: A level twice as coarse as these has voxels thicker than a wall; what is opaque there hardly thins out.
_LEVELS = 2


@dataclass(frozen=True)
class CavitiesConfig(TrainingConfig):
    """Folds and hollows that the hull bridges, by a radiance volume as fine as the lattice."""

    iterations: int = 1000
    """Steps of the volume; 0 carves nothing. Walls behind openings are tried all the same."""
    direction_lr: float = 0.0
    """Adam's step for what depends on the direction; 0: nothing does, or the fog of a bridge could show every
    view what it wants to see, and stay."""


class Cavities:
    """Hollows the surface out."""

    name = "cavities"

    def __init__(self, config: CavitiesConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface without what is empty in it. Lattices whose vertices make no cube stay as they are."""
        lattice, count = surface.lattice, self.config.iterations
        carved = None
        cubes = lattice.vertex_count == lattice.stride**3
        if cubes and not steps.done:
            with steps.task("walls"):
                hollowed = hollowed_vessels(fit, surface)
            steps.fact("vessel", hollowed is not None)
            surface = hollowed or surface
        if cubes and count:
            volume = volume_inside(surface, fit, self.config, steps.kept)
            steps.run(volume, count, volume.optimizers, volume.arrays, surface=surface)
            with steps.task("cut"):
                carved = carve(fit, surface, volume)
        steps.fact("carved", carved is not None)
        return carved or surface


def volume_inside(
    surface: Surface, fit: Fit, config: TrainingConfig, kept: Mapping[str, np.ndarray]
) -> RadianceVolume:
    """A radiance volume inside a surface's hull, as fine as its lattice.

    Args:
        surface: with its hull, on a lattice whose vertices make a cube.
        fit: the views.
        config: how it is trained.
        kept: ``RadianceVolume.arrays`` of one to go on with, or nothing.
    """
    subject, lattice = fit.scene.subject, surface.lattice
    sides = sides_of_levels(lattice.stride - 1, _LEVELS)
    # From vertices to the centres of voxels.
    step = (lattice.stride - 1) / sides[0]
    hull = ndimage.affine_transform(
        surface.hull_distance.reshape((lattice.stride,) * 3),
        step * np.eye(3),
        0.5 * step,
        (sides[0],) * 3,
        order=1,
        mode="nearest",
    )
    _, vertices, faces = closed_template(subject, surface.hull_distance, lattice)
    return RadianceVolume(
        hull,
        subject.to_world,
        fit.views,
        fit.pixels,
        config,
        sides,
        (vertices, faces),
        kept,
        seed=fit.config.seed,
    )
