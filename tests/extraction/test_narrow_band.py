import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi import UserError
from gshell_mi.extraction import NarrowBand, extract
from gshell_mi.lattice import GRIDS, TetLattice, make_lattice


@pytest.fixture(params=GRIDS)
def lattice(request):
    return make_lattice(request.param, 70)


def _assert_equal(a, b):
    for x, y in zip(a.to_numpy(), b.to_numpy(), strict=True):
        np.testing.assert_array_equal(x, y)


def _ball(lattice, radius=0.3, x=0.0, y=0.0):
    p = lattice.points(mi.Float)
    return dr.norm(mi.Vector3f(p.x - x, p.y - y, p.z)) - radius


def test_same_as_without_while_the_surface_moves_through_the_lattice(lattice):
    """Bit by bit, up to where the ball touches the border of the lattice; it is cut and grows."""
    band, z = NarrowBand(rescan=0), lattice.points(mi.Float).z
    for x in np.arange(-0.6, 0.75, 0.09):  # of less than 3.3 cells
        sdf, msdf = _ball(lattice, 0.25 + 0.1 * x, x), 0.1 - z
        mesh = extract(lattice, sdf, msdf, template=True, band=band)
        dense = extract(lattice, sdf, msdf, template=True)
        assert mesh.face_count > 100
        _assert_equal(mesh, dense)
        _assert_equal(mesh.template, dense.template)
        assert band.fraction < 0.5


def test_same_gradients(lattice):
    gradients = []
    for band in (None, NarrowBand(rescan=0)):
        for radius in (0.5, 0.52):
            sdf = _ball(lattice, radius)
            dr.enable_grad(sdf)
            mesh = extract(lattice, sdf, lattice.points(mi.Float).x, band=band)
            dr.backward(dr.sum(dr.squared_norm(mesh.vertices)))
        gradients.append(dr.grad(sdf).numpy())
    np.testing.assert_allclose(*gradients, rtol=1e-5, atol=1e-5)
    assert np.abs(gradients[0]).max() > 0.01


@pytest.mark.parametrize("rescan", [0, 3])
def test_what_appears_elsewhere_is_found_by_the_next_scan(rescan):
    lattice, band = TetLattice(70), NarrowBand(rescan=rescan)
    one = _ball(lattice, 0.15, y=-0.7)
    two = dr.minimum(one, _ball(lattice, 0.15, y=0.7))
    counts = [extract(lattice, sdf, band=band).face_count for sdf in (one, two, two, two, two)]
    assert counts[0] == counts[1] == counts[2]
    assert (np.array(counts[3:]) > 1.9 * counts[0]).all() == bool(rescan)


def test_another_lattice_is_scanned():
    band = NarrowBand(rescan=0)
    for resolution in (40, 70, 70):
        lattice = TetLattice(resolution)
        sdf = _ball(lattice, 0.3 + resolution / 1000)
        _assert_equal(extract(lattice, sdf, band=band), extract(lattice, sdf))


def test_nothing_is_found_in_an_empty_band():
    lattice, band = TetLattice(40), NarrowBand(rescan=0)
    assert band.fraction == 1
    for sdf in (dr.ones(mi.Float, lattice.vertex_count), _ball(lattice), _ball(lattice)):
        assert extract(lattice, sdf, band=band).is_empty
    assert band.fraction == 0


@pytest.mark.parametrize("name", ["sdf", "msdf", "deform"])
def test_non_finite_values_on_the_surface(name):
    lattice, band = TetLattice(40), NarrowBand(rescan=0)
    fields = {"sdf": _ball(lattice), "msdf": lattice.points(mi.Float).z,
              "deform": dr.zeros(mi.Float, 3 * lattice.vertex_count)}
    extract(lattice, **fields, band=band)
    values = fields[name].numpy()
    part = np.repeat(lattice.vertex_positions()[:, 0] > 0.1, len(values) // lattice.vertex_count)
    values[part & (values >= 0)] = np.nan
    fields[name] = mi.Float(values.astype(np.float32))
    with pytest.raises(UserError, match=f"^{name} holds NaN or infinite values"):
        extract(lattice, **fields, band=band)


def test_rescan_is_checked():
    with pytest.raises(UserError, match="rescan counts extractions from one scan to the next, and is -1"):
        NarrowBand(rescan=-1)
