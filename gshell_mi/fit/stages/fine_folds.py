"""Fine folds: details once more where a radiance volume has brought a finer lattice.

The folds before were of a coarse lattice, and what the volume shows of a narrow one is bridged by what its
cells hold. On the finer template the same movement goes on where that has ended.
"""

from __future__ import annotations

from ..runner import Steps
from ..stage import Fit
from ..surface import Surface
from .refinement import FoldsConfig, Refinement
from .revoxelise import best_moved, compared


class FineFolds:
    """Moves the vertices of a finer template, as the stage *folds* does; the same judges decide."""

    name = "fine_folds"

    def __init__(self, config: FoldsConfig):
        self.config = config

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface where it has been moved to; one on the lattice of the hull stays as it is.

        New fields may lose what is thin, such as leaves, so they are judged as they come out, too.
        """
        if surface.lattice.resolution <= fit.lattices.late.resolution:
            return surface
        whole = surface.whole()
        moved = Refinement(self.name, self.config, first=True).run(fit, whole, steps)
        if not moved.moved:
            return surface
        with steps.task("fields"):
            found, taken = best_moved(fit, moved, steps)
            kept = taken == self.name and bool(compared(fit, surface, found).accepted[0])
        steps.fact(f"{self.name}_kept", kept)
        return found if kept else surface
