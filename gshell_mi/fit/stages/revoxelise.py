"""Revoxelise: fields are made anew from a template whose vertices have moved, and what nobody sees goes.

Sides of thin sheets that a template can do without are left out on the way.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import mitsuba as mi
import numpy as np

from ...fields import LatticeFields
from ...template.msdf import clean_opacity
from ...template.revoxelise import revoxelise
from ...template.thin_sheets import Cut, collapsed_sheets
from ...topology import topology
from ...triangles import positive_part
from ..runner import Steps
from ..stage import Fit
from ..surface import Moved, Seen, Surface
from ..template import Template, template_of
from ..unseen import without_unseen_parts


class Revoxelise:
    """Takes the best of what stages have moved the template to that comes out whole."""

    name = "revoxelise"

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface where it has been moved to; without any movement, what was grown for being thin shrinks
        back."""
        surface = surface.on_grid(fit.lattices.late.grid)
        with steps.task():
            template = template_of(fit.scene.subject, surface)
            radiance = template.mesh.interpolate(mi.Float(surface.seen.radiance.ravel()), 3).numpy().T
            still = Moved("start", template.start, radiance)
            found, taken = _whole(fit, template, (*surface.moved, still), surface)
            steps.fact("refinement_kept", taken not in ("start", ""))
            if taken == "folds":
                steps.fact("folds_kept", True)
            return without_unseen_parts(fit, found or replace(surface, hull=None, moved=()))


def _whole(
    fit: Fit, template: Template, moved: Iterable[Moved], surface: Surface
) -> tuple[Surface | None, str]:
    """The first movement, of the best first, of which fields can be made, cut as well as can be, and its
    stage; None and an empty name if none comes out whole."""
    subject, lattice, min_area = fit.scene.subject, surface.lattice, fit.config.topology.min_area
    for candidate in moved:
        if (candidate.positions == template.vertices).all():
            continue
        for cut in _cuts(fit, template, candidate.positions, fit.cell(surface)):
            fields = revoxelise(
                subject,
                lattice,
                template.vertices,
                cut.positions,
                template.faces,
                cut.logits,
                candidate.radiance,
                min_area,
                cut.topology,
                cut.fewest_loops,
            )
            if fields:
                closed = LatticeFields.closed(fields["sdf"], lattice.grid)
                seen = Seen(fields["radiance"], fields["known"], surface.seen.light)
                return Surface(replace(closed, msdf=fields["msdf"]), seen=seen), candidate.stage
    return None, ""


def _cuts(fit: Fit, template: Template, moved: np.ndarray, cell: float) -> list[Cut]:
    """How to cut a moved template, the best first."""
    config = fit.config
    # What has become too small by moving is noise, and no reason to leave all where it was.
    logits = clean_opacity(template.logits, moved, template.faces, config.topology.min_area)
    found = topology(*positive_part(template.vertices, template.faces, logits))
    as_found = Cut(logits, moved, found, found.boundary_loops)
    if config.watertight or not config.topology.sheet_thickness:
        return [as_found]
    cut = collapsed_sheets(
        as_found,
        template.vertices,
        template.faces,
        cell,
        config.topology.sheet_thickness,
        config.topology.min_area,
    )
    return [cut, as_found] if cut else [as_found]
