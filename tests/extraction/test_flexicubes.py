import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from topology import assert_manifold, boundary_edges, euler_characteristic

from gshell_mi import UserError
from gshell_mi.extraction import extract
from gshell_mi.extraction.cube_tables import EDGES, cube_polygons, twice_visited_face
from gshell_mi.extraction.flexicubes import deviation, positive_weight
from gshell_mi.lattice import CubeLattice, FlexiCubesLattice, TetLattice


def _one_corner(lattice, weights=None):
    """The mesh around a single inside vertex in the middle of 2^3 cubes, and the vertex of cube 0."""
    sdf = np.ones((3, 3, 3), np.float32)
    sdf[1, 1, 1] = -1
    mesh = extract(lattice, mi.Float(sdf.ravel()), weights=weights)
    vertices = mesh.to_numpy()[0]
    return mesh, vertices[np.argmin(vertices.sum(axis=1))]


def test_octant():
    """One vertex in each cube, at the mean of its three crossings, and a quad per crossed edge."""
    mesh, vertex = _one_corner(FlexiCubesLattice(2))
    assert (mesh.vertex_count, mesh.face_count) == (8, 12) and mesh.to_trimesh().is_watertight
    assert mesh.to_trimesh().volume > 0
    np.testing.assert_allclose(vertex, -0.5 / 3, atol=1e-6)


def test_weights_follow_the_formulas():
    """Closed forms of Shen et al. 2023, eqs. 3 and 4, in cube 0, whose corner 7 is inside."""
    lattice = FlexiCubesLattice(2)
    raw = np.random.default_rng(0).normal(size=(8, 21)).astype(np.float32)
    alpha, beta = np.split(1 + 0.9 * np.tanh(raw[0, :20]), [8])
    crossings, weights = [], []
    for axis in range(3):
        corner = 7 ^ 1 << axis
        # s is -1 at corner 7 and 1 at the other: x = (s7 a7 x' - s' a' x7) / (s7 a7 - s' a')
        along = (-alpha[7] * -1.0 - 1.0 * alpha[corner] * 0.0) / (-alpha[7] - alpha[corner])
        crossings.append(np.eye(3)[axis] * along)
        weights.append(beta[EDGES.index((corner, axis))])
    expected = np.average(crossings, axis=0, weights=weights)
    vertex = _one_corner(lattice, mi.Float(raw.ravel()))[1]
    np.testing.assert_allclose(vertex, expected, atol=1e-5)
    expected = 1 + 0.9 * np.tanh(raw[0])
    np.testing.assert_allclose(positive_weight(mi.Float(raw[0])).numpy(), expected, atol=1e-5)


def test_gamma_chooses_the_diagonal():
    lattice = FlexiCubesLattice(2)
    diagonals = []
    for favoured in (0, 1):  # cubes of even parity, or of odd
        raw = np.zeros((8, 21), np.float32)
        parity = np.array([bin(c).count("1") & 1 for c in range(8)])
        raw[parity == favoured, 20] = 1
        vertices, faces, _ = _one_corner(lattice, mi.Float(raw.ravel()))[0].to_numpy()
        cube = ((vertices > 0) @ [1, 2, 4]).astype(int)
        edges = {tuple(sorted(cube[[f[i], f[i - 1]]])) for f in faces for i in range(3)}
        diagonals.append({e for e in edges if bin(e[0] ^ e[1]).count("1") == 2})
        assert all(parity[a] == favoured and parity[b] == favoured for a, b in diagonals[-1])
        assert len(diagonals[-1]) == 6


def test_polygons_that_meet_twice_are_split():
    """Two cubes, mirror images of each other, whose polygons share two sides: with one vertex each, the edge
    between these would have four faces."""
    found = 0
    for signs in (s for s in range(256) if twice_visited_face(s) == 1):
        sdf = np.ones((5, 5, 5), np.float32)
        for corner in (c for c in range(8) if signs >> c & 1):
            x, y, z = corner & 1, corner >> 1 & 1, corner >> 2 & 1
            sdf[z + 1, y + 1, x + 1] = sdf[z + 1, y + 1, 3 - x] = -1
        mesh = extract(FlexiCubesLattice(4), mi.Float(sdf.ravel()))
        vertices, faces, _ = mesh.to_numpy()
        assert_manifold(vertices, faces)
        assert len(boundary_edges(faces)) == 0
        cells = np.floor((vertices + 1) / 0.5)
        in_the_two = ((cells == [1, 1, 1]) | (cells == [2, 1, 1])).all(axis=1)
        assert in_the_two.sum() == 2 * (len(cube_polygons(signs)) + 1)
        found += 1
    assert found == 6


@pytest.mark.parametrize("value", [-1.0, 0.5])
def test_template_closes_inside_the_lattice(value):
    """A plane through the lattice, or a solid that fills it."""
    lattice = FlexiCubesLattice(8)
    mesh = extract(lattice, lattice.points(mi.Float).z + value)
    vertices, faces, _ = mesh.to_numpy()
    assert_manifold(vertices, faces)
    assert len(boundary_edges(faces)) == 0 and euler_characteristic(faces) == 2
    assert np.abs(vertices).max() < 1
    expected = (2 - lattice.spacing) ** 2 * (1 - value - lattice.spacing / 2)
    assert mesh.to_trimesh().volume == pytest.approx(expected, rel=0.25)


def test_sphere_is_as_close_as_with_cubes_and_better_shaped():
    sdf = dr.norm(TetLattice(24).points(mi.Float)) - 0.6
    dual, cubes = (extract(kind(24), sdf).to_trimesh() for kind in (FlexiCubesLattice, CubeLattice))
    error = [np.abs(np.linalg.norm(m.vertices, axis=1) - 0.6).mean() for m in (dual, cubes)]
    assert error[0] < 0.1 / 24 and error[1] < 0.1 / 24
    smallest = [np.degrees(m.face_angles.min(axis=1)) for m in (dual, cubes)]
    assert np.percentile(smallest[0], 5) > 2 * np.percentile(smallest[1], 5)


def test_derivatives_with_respect_to_alpha_and_beta():
    lattice = FlexiCubesLattice(6)
    p = lattice.points(mi.Float)
    sdf, msdf = dr.norm(p) - 0.57, 0.1 - p.z + 0.3 * p.x
    rng = np.random.default_rng(1)
    raw = rng.normal(size=lattice.weight_count).astype(np.float32)
    raw.reshape(-1, 21)[:, 20] = 0  # gamma moves nothing, it chooses
    direction = rng.normal(size=raw.shape).astype(np.float32)
    direction.reshape(-1, 21)[:, 20] = 0

    def objective(weights):
        mesh = extract(lattice, sdf, msdf, weights=weights)
        x, y, z = mesh.vertices
        return dr.sum(x + 2 * y * z + dr.sin(3 * z)) + dr.sum(deviation(mesh, lattice)), mesh

    def at(step):
        value, mesh = objective(mi.Float(raw + np.float32(step) * direction))
        return value[0], mesh.faces.numpy()

    weights = mi.Float(raw)
    dr.enable_grad(weights)
    value, mesh = objective(weights)
    assert mesh.vertex_count > mesh.kept_vertex_count > 20
    dr.backward(value)
    step = 2e-3
    (above, faces), (below, others) = at(step), at(-step)
    np.testing.assert_array_equal(faces, others)
    assert dr.grad(weights).numpy() @ direction == pytest.approx((above - below) / (2 * step), rel=2e-2)


def test_deviation():
    """0 where the three crossings are equally far from their mean, and positive for a skewed cube."""
    lattice = FlexiCubesLattice(2)
    mesh, _ = _one_corner(lattice)
    np.testing.assert_allclose(deviation(mesh, lattice).numpy(), 0, atol=1e-6)
    raw = np.zeros((8, 21), np.float32)
    raw[0, 8:20] = np.linspace(-1, 1, 12)
    skewed, vertex = _one_corner(lattice, mi.Float(raw.ravel()))
    distance = np.linalg.norm(-0.5 * np.eye(3) - vertex, axis=1)
    expected = np.abs(distance - distance.mean()).mean()
    assert deviation(skewed, lattice).numpy().max() == pytest.approx(expected, rel=1e-4)
    empty = extract(lattice, dr.ones(mi.Float, 27))
    assert dr.width(deviation(empty, lattice)) == 0


def test_weights_are_checked():
    sdf = dr.ones(mi.Float, 27)
    with pytest.raises(UserError, match="weights has 3 values, but the lattice needs 168"):
        extract(FlexiCubesLattice(2), sdf, weights=mi.Float(1, 2, 3))
    with pytest.raises(UserError, match="weights belong to the grid 'flexicubes', not to 'cube'"):
        extract(CubeLattice(2), sdf, weights=mi.Float(1, 2, 3))
    with pytest.raises(UserError, match="weights holds NaN"):
        extract(FlexiCubesLattice(2), sdf, weights=dr.full(mi.Float, np.nan, 168))
