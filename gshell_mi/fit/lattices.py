"""The lattices that the stages of a fit work on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mitsuba as mi

from ..lattice import Lattice, make_lattice

if TYPE_CHECKING:
    from .config import FitConfig
    from .surface import Surface

#: The kind of lattice where neither scene nor settings name one. Of equally many cells FlexiCubes come out
#: nearest to the truth, with the smoothest rims and a third of the vertices of tetrahedra (docs/grids.md).
_GRID = "flexicubes"

#: Openings and hollows are found on tetrahedra, whose templates have vertices enough for that.
_EARLY_GRIDS = {"tet": "tet", "cube": "tet", "flexicubes": "tet", "bcc": "bcc"}


@dataclass(frozen=True)
class Lattices:
    """The lattices of a fit.

    Attributes:
        early: that openings and hollows are found on.
        late: the same vertices, but joined as in the end.
        last: that the fit ends on if it starts from the hull.
        volume: of a radiance volume's surface.
        fine: that the fit ends on if it starts from that.
    """

    early: Lattice
    late: Lattice
    last: Lattice
    volume: Lattice
    fine: Lattice

    @classmethod
    def of(cls, subject: mi.Shape, config: FitConfig) -> Lattices:
        """The lattices of a fit of the gshell shape ``subject``."""
        last = last_lattice(subject, config)
        # Given fields may have detail that no coarser lattice holds.
        coarse = last.resolution
        if not subject.filename:
            coarse = min(coarse, config.lattice.start_resolution)
        volume = config.resolution or max(last.resolution, config.volume.resolution)
        fine = config.resolution or max(volume, config.volume.detail_resolution)
        return cls(
            make_lattice(_EARLY_GRIDS[last.grid], coarse),
            make_lattice(last.grid, coarse),
            last,
            make_lattice(last.grid, volume),
            make_lattice(last.grid, fine),
        )

    def end_of(self, surface: Surface) -> Lattice:
        """What a fit ends on, told by the lattice that its first joint stage was on."""
        return self.fine if surface.lattice.resolution > self.late.resolution else self.last


def last_lattice(subject: mi.Shape, config: FitConfig) -> Lattice:
    """What the settings or else the gshell shape ``subject`` name."""
    given = subject.lattice
    grid = config.grid or (given.grid if subject.grid_is_given else _GRID)
    return make_lattice(grid, config.resolution or given.resolution)
