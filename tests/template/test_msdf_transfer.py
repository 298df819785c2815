"""Openings on a finer lattice are those of the coarse one, narrow ones included."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.fields import sphere
from gshell_mi.lattice import make_lattice
from gshell_mi.template.msdf_transfer import transfer_msdf
from gshell_mi.topology import topology

COARSE, FINE = 20, 40


def found(subject, fields):
    subject.set_fields(fields)
    return topology(*subject.surface.to_numpy()[:2])


@pytest.fixture
def slit_ball():
    """A shape, and a ball with a slit from x = -0.45 to 0.45 along diagonals of the tetrahedra, as narrow as
    there are. Its mSDF is positive in the middle of every square that the slit crosses."""
    lattice = make_lattice("tet", COARSE)
    subject = mi.load_dict({"type": "gshell", "resolution": COARSE, "grid": "tet"})
    x, y, z = lattice.vertex_positions().T
    slit = (np.abs(x - y) < 1e-3) & (np.abs(x) < 0.46) & (z > 0)
    msdf = np.where(slit, -0.5, 1) * lattice.spacing
    return subject, replace(sphere(lattice, 0.6), msdf=msdf.astype(np.float32))


@pytest.mark.parametrize("blocks", [False, True], ids=["whole lattice", "blocks"])
def test_a_slit_stays_whole(slit_ball, blocks):
    subject, coarse = slit_ball
    before = found(subject, coarse)
    assert (before.boundary_loops, before.pinholes, before.components) == (1, 0, 1)
    fine = (coarse.in_blocks if blocks else coarse.to_lattice)(FINE)
    assert found(subject, fine).boundary_loops > 5, "interpolation alone cuts it up"
    fields = transfer_msdf(subject, coarse, fine)
    after = found(subject, fields)
    assert (after.boundary_loops, after.pinholes, after.components) == (1, 0, 1)
    assert after.boundary_length == pytest.approx(before.boundary_length, rel=0.02)
    # Where nothing was to be mended nothing is.
    below = fields.lattice.points(mi.Float).z.numpy() < 0
    np.testing.assert_array_equal(fields.msdf[below], fine.msdf[below])
    np.testing.assert_array_equal(fields.sdf, fine.sdf)


def test_what_is_closed_stays_as_it_is(slit_ball):
    subject, coarse = slit_ball
    closed = replace(coarse, msdf=np.ones_like(coarse.msdf))
    fine = closed.to_lattice(FINE)
    assert transfer_msdf(subject, closed, fine) is fine
