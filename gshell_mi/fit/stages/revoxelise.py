"""Revoxelise: fields are made anew from a template whose vertices have moved, and what nobody sees goes.

Sides of thin sheets that a template can do without are left out on the way.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import mitsuba as mi
import numpy as np

from ...fields import LatticeFields
from ...lattice import Lattice
from ...template.msdf import clean_opacity
from ...template.revoxelise import revoxelise
from ...template.thin_sheets import Cut, collapsed_sheets
from ...topology import topology
from ...triangles import positive_part
from ..judge import Verdict
from ..runner import Steps
from ..stage import Fit
from ..surface import Moved, Seen, Surface
from ..template import Template, template_of
from ..unseen import without_unseen_parts


class Revoxelise:
    """Takes the best of what stages have moved the template to that comes out whole, with its boundary loops
    or better without one of them."""

    name = "revoxelise"

    def run(self, fit: Fit, surface: Surface, steps: Steps) -> Surface:
        """The surface where it has been moved to; without any movement, what was grown for being thin shrinks
        back."""
        surface = surface.on_grid(fit.lattices.late.grid)
        with steps.task():
            found, taken = best_moved(fit, surface, steps)
            steps.fact("refinement_kept", taken not in ("start", ""))
            if taken == "folds":
                steps.fact("folds_kept", True)
            return found


def best_moved(fit: Fit, surface: Surface, steps: Steps) -> tuple[Surface, str]:
    """The surface where its template has been moved to, and the stage that has; see ``Revoxelise``."""
    template = template_of(fit.scene.subject, surface)
    radiance = template.mesh.interpolate(mi.Float(surface.sight.radiance.ravel()), 3).numpy().T
    still = Moved("start", template.start, radiance)
    found, taken = _taken(fit, template, (*surface.moved, still), surface, steps)
    return without_unseen_parts(fit, replace(found, hull=None, moved=())), taken


def _taken(
    fit: Fit, template: Template, moved: Iterable[Moved], surface: Surface, steps: Steps
) -> tuple[Surface, str]:
    """The first movement, of the best first, of which fields with all boundary loops can be made, cut as well
    as can be, and its stage; the surface as it is and an empty name if there is none.

    Of a better one the lattice may have closed a loop, a slit of less than a cell: then unseen views decide.
    """
    whole, closed_up = (surface, ""), None
    for found, stage, has_loops in _made(fit, template, moved, surface):
        if has_loops:
            whole = found, stage
            break
        closed_up = closed_up or (found, stage)
    if closed_up is None:
        return whole
    verdict = compared(fit, whole[0], closed_up[0])
    steps.fact("closed_loops_verdict", verdict.facts())
    return closed_up if verdict.accepted[0] else whole


def compared(fit: Fit, before: Surface, after: Surface) -> Verdict:
    """How much better one surface explains unseen views than another."""
    return fit.judge.decide(fit.mesh(before), fit.mesh(after))


def _made(
    fit: Fit, template: Template, moved: Iterable[Moved], surface: Surface
) -> Iterator[tuple[Surface, str, bool]]:
    """The surfaces that come out whole, the best first: with the stage that moved them, and whether they have
    all boundary loops."""
    for candidate in moved:
        if (candidate.positions == template.vertices).all():
            continue
        cuts = _cuts(fit, template, candidate.positions, fit.cell(surface))
        # Each is made when it is asked for: mostly the first is whole.
        made = (one for cut in cuts if (one := _revoxelised(fit, template, candidate, cut, surface)))
        if cuts[0].topology.components > cuts[-1].topology.components:
            # What falls apart may be islands, which sides too many have held together.
            both = list(made)
            if len(both) > 1 and compared(fit, both[0][0], both[1][0]).accepted[0]:
                both.reverse()
            yield from both
        else:
            yield from made


def _revoxelised(
    fit: Fit, template: Template, candidate: Moved, cut: Cut, surface: Surface
) -> tuple[Surface, str, bool] | None:
    """As of ``_made``, with one cut; None if it comes out torn."""
    lattice = surface.lattice
    assert isinstance(lattice, Lattice), "blocks come with the joint stage"
    made = revoxelise(
        fit.scene.subject,
        lattice,
        template.vertices,
        cut.positions,
        template.faces,
        cut.logits,
        candidate.radiance,
        fit.config.topology.min_area,
        cut.topology,
        cut.fewest_loops,
    )
    if made is None:
        return None
    fields = made.fields
    closed = LatticeFields.closed(fields["sdf"], lattice.grid)
    seen = Seen(fields["radiance"], fields["known"], surface.sight.light)
    return Surface(replace(closed, msdf=fields["msdf"]), seen=seen), candidate.stage, made.has_loops


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
