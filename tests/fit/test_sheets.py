"""Small loose parts that are sheets open on one side, unless nothing shall."""

from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.fields import LatticeFields
from gshell_mi.fit import FitConfig
from gshell_mi.fit.sheets import with_open_sheets
from gshell_mi.fit.surface import Surface

RESOLUTION = 40
CELL = 2 / RESOLUTION


@pytest.mark.parametrize(
    ("changes", "opens"),
    [({}, True), ({"watertight": True}, False), ({"topology.sheet_thickness": 0.0}, False)],
)
def test_only_one_side_of_a_loose_plate_stays_where_that_may_open(changes, opens):
    subject = mi.load_dict({"type": "gshell", "resolution": RESOLUTION})
    x, y, z = subject.lattice.points(mi.Float).numpy()
    bowl = np.sqrt((x + 0.35) ** 2 + y**2 + z**2) - 0.4
    plate = np.maximum(np.hypot(x - 0.5, y) - 0.12, np.abs(z) - 0.4 * CELL)
    fields = LatticeFields.closed(np.minimum(bowl, plate).astype(np.float32), "tet")
    msdf = np.where((bowl < plate) & (z > 0.1), -CELL, CELL).astype(np.float32)
    surface = Surface(replace(fields, msdf=msdf))
    fit = SimpleNamespace(
        config=FitConfig().changed(changes),
        scene=SimpleNamespace(subject=subject),
        cell=lambda surface: surface.lattice.spacing * subject.length_scale,
    )
    found = with_open_sheets(fit, surface)
    at_plate = plate < 2 * CELL
    assert (found.fields.msdf[at_plate] <= 0).any() == opens
    assert opens or found is surface
