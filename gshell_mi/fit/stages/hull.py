"""The visual hull: what all masks together leave of the box. It is closed wherever the object is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import mitsuba as mi
import numpy as np

from ...bounds import Between
from ...errors import UserError
from ...fields import LatticeFields
from ...fields.interpolation import Interpolation
from ...fields.lattice_fields import closed_at_border
from ...fields.mask_distances import MaskDistances
from ...fields.thin_parts import thickened, thin_part_refinement
from ...fields.visual_hull import doubting_hulls
from ...lattice import CubeLattice, Lattice
from ...scene import FitScene
from ..lattices import Lattices
from ..runner import Steps
from ..stage import Fit
from ..surface import TYPICAL_REFLECTANCE, Seen, Surface

if TYPE_CHECKING:
    from ..config import FitConfig


#: Cells outside of the hull up to which it matters how far: nothing grows by more.
_REACH = 4.0


@dataclass(frozen=True)
class HullConfig:
    """The visual hull."""

    daylight_votes: Annotated[float, Between(0, 1)] = 0.15
    """Fraction of the views that must see daylight at a point before an enclosed hole of the masks is
    carved."""


class Hull:
    """Starts from the visual hull, whatever it is given."""

    name = "hull"

    def __init__(self, config: HullConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The hull on the early lattice, with what is too thin for that grown.

        Raises:
            UserError: the masks have nothing in common.
        """
        with steps.task():
            (hull,) = hulls_of(fit, fit.masks)
        if not (hull.fields.sdf < 0).any():
            raise UserError(
                f"The masks of the targets have no common volume in the box of '{fit.scene.path}'; check "
                f"the cameras, the alpha of the targets and the gshell shape's to_world."
            )
        return hull


def hulls_of(fit: Fit, masks: MaskDistances, disbelieved: Sequence[int] = (0,)) -> list[Surface]:
    """Visual hulls of some masks on the early lattice, with what is too thin for that grown.

    Args:
        fit: the lattice and the settings.
        masks, disbelieved: as of ``doubting_hulls``.
    """
    subject, lattice = fit.scene.subject, fit.lattices.early
    finer = thin_part_refinement(lattice.resolution)
    samples = CubeLattice(finer * lattice.resolution)
    points = mi.Transform4f(subject.to_world) @ mi.Point3f(samples.points(mi.Float))
    cell, vertices = lattice.spacing, lattice.points(mi.Float)
    found = []
    for world in doubting_hulls(
        points,
        masks,
        disbelieved,
        daylight_votes=fit.config.hull.daylight_votes,
        reach=_REACH * cell * subject.length_scale,
    ):
        solid = np.clip(world.numpy() / subject.length_scale, -1, 1) / cell
        grown = thickened(solid.reshape((samples.stride,) * 3), finer)
        sdf, hull = (
            closed_at_border(
                Interpolation(mi.Float(cell * field.ravel()), samples)(vertices).numpy(), lattice
            )
            for field in (grown, solid)
        )
        found.append(Surface(LatticeFields.closed(sdf, lattice.grid), hull=hull))
    return found


class Given:
    """Starts from the fields that the scene gives its gshell shape."""

    name = "given"

    @classmethod
    def is_closed(cls, scene: FitScene, lattices: Lattices, config: FitConfig) -> bool:
        """Whether they are closed, or shall be, so that openings are still to find."""
        return config.watertight or bool((cls._on(lattices.early, scene.subject.fields()).msdf > 0).all())

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """These fields on the early lattice."""
        lattice = fit.lattices.early
        fields = self._on(lattice, surface.fields)
        if self.is_closed(fit.scene, fit.lattices, fit.config):
            return Surface(LatticeFields.closed(fields.sdf, lattice.grid), hull=fields.sdf)
        count, light = len(fields.sdf), np.float32(fit.pixels.mean_radiance() / TYPICAL_REFLECTANCE)
        return Surface(fields, seen=Seen(np.zeros((count, 3), np.float32), np.zeros(count, bool), light))

    @staticmethod
    def _on(lattice: Lattice, fields: LatticeFields) -> LatticeFields:
        return fields.whole().to_lattice(lattice.resolution, lattice.grid)
