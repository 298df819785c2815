"""Cavities: what the hull bridges. Behind openings walls are tried; elsewhere a fog tells what is empty.

Two ways lead there. An opening may be the mouth of something solid, such as a mug: then a wall behind it
explains unseen views much better than a sheet (``carving/vessels.py``). And a fold is empty though it lies
inside the hull: a fog of density and radiance shows it, and a minimum cut carves it (``carving/carving.py``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ..bounds import Between
from ..carving.carving import carve
from ..carving.density_grid import DensityGrid
from ..carving.vessels import hollowed_vessels
from ..runner import Steps
from ..stage import Fit
from ..surface import Surface
from ..template import closed_template


@dataclass(frozen=True)
class CavitiesConfig:
    """Folds and hollows that the hull bridges."""

    iterations: int = 1000
    """Steps of the fog; 0 carves nothing. Walls behind openings are tried all the same."""
    batch: Annotated[int, Between(1)] = 65536
    """Pixels per step over all views, of which those far from the masks are left out."""
    lr: float = 0.6
    """Adam's step for the density's logits; halves over the coarse steps, then falls tenfold."""
    radiance_lr: float = 0.05
    """Adam's step for the radiance, as a fraction of the targets' mean."""


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
            _, vertices, faces = closed_template(fit.scene.subject, surface.hull, lattice)
            volume = DensityGrid(
                surface.hull.reshape((lattice.stride,) * 3),
                vertices,
                faces,
                fit.scene.subject.to_world,
                fit.views,
                fit.training,
                self.config,
                steps.done,
                seed=fit.config.seed,
            )
            steps.run(volume, count, volume.optimizers, surface=surface)
            with steps.task("cut"):
                carved = carve(fit, surface, volume)
        steps.fact("carved", carved is not None)
        return carved or surface
