"""Loose parts that are sheets are solid on one side only."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..template.msdf import rewritten
from ..template.small_sheets import loose_sheets
from .stage import Fit
from .surface import Surface

#: Size of the new mSDF, in cells.
SURE = 0.5


def with_open_sheets(fit: Fit, surface: Surface) -> Surface:
    """The surface with one side open of each small part that has closed on the way, such as an island of
    lace; as it is where nothing shall open, or both sides of sheets shall stay."""
    if fit.config.watertight or not fit.config.topology.sheet_thickness:
        return surface
    fields, lattice = surface.fields, surface.lattice
    template = fit.scene.subject.surface_of(fields, template=True)
    vertices, faces, _ = template.to_numpy()
    msdf = mi.Float(fields.msdf)
    opened = template.interpolate(msdf).numpy() <= 0
    normals = template.vertex_normals().numpy().T
    side, sheets = loose_sheets(vertices, normals, faces, opened, fit.cell(surface))
    if not side.any():
        return surface
    # Both sides hang on the same vertices of the lattice: without the other, it would open, too.
    values = np.where(side, -SURE, SURE) * lattice.spacing
    return surface.with_fields(msdf=rewritten(msdf, values, sheets, template, lattice).numpy())
