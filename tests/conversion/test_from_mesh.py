from collections.abc import Callable

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from topology import assert_manifold, boundary_edges, component_count, euler_characteristic, loop_count

from gshell_mi import UserError
from gshell_mi.conversion import from_mesh
from gshell_mi.conversion.loaded_mesh import without_pinches
from gshell_mi.extraction import extract
from gshell_mi.lattice import GRIDS, TetLattice, make_lattice

LATTICE = TetLattice(32)


def _grid(point: Callable, wrap: bool, rows=24, columns=48) -> trimesh.Trimesh:
    """A parametric surface over [0, 1]^2, closed in its first parameter if ``wrap``."""
    u = np.linspace(0, 1, columns, endpoint=not wrap)
    v = np.linspace(0, 1, rows)
    vertices = np.stack(point(*np.meshgrid(u, v)), axis=-1).reshape(-1, 3)
    index = np.arange(rows * columns).reshape(rows, columns)
    if wrap:
        index = np.concatenate([index, index[:, :1]], axis=1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces)


def _bowl(depth):
    """A spherical cap that opens upwards."""

    def point(u, v):
        polar = np.pi - 0.02 - v * depth
        return (
            0.7 * np.sin(polar) * np.cos(2 * np.pi * u),
            0.7 * np.sin(polar) * np.sin(2 * np.pi * u),
            0.7 * np.cos(polar),
        )

    bowl = _grid(point, wrap=True)
    bottom = trimesh.Trimesh(
        np.vstack([bowl.vertices[:48], [0, 0, -0.7]]), [[48, (i + 1) % 48, i] for i in range(48)]
    )
    bowl = trimesh.util.concatenate([bowl, bottom])
    bowl.merge_vertices()
    return bowl


SURFACES = {
    # name: mesh, loops, Euler characteristic
    "sphere": (trimesh.creation.icosphere(subdivisions=3, radius=0.7), 0, 2),
    "torus": (trimesh.creation.torus(0.6, 0.2), 0, 0),
    "deep bowl": (_bowl(2.0), 1, 1),
    "shallow bowl": (_bowl(0.9), 1, 1),
    "tube": (
        _grid(lambda u, v: (0.5 * np.cos(6.2831853 * u), 0.5 * np.sin(6.2831853 * u), 1.2 * v - 0.6), True),
        2,
        0,
    ),
    "sheet": (_grid(lambda u, v: (u - 0.5, v - 0.5, 0.1 * np.sin(5 * u)), False), 1, 1),
}


def _distances(a: trimesh.Trimesh, b: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    p, q = (trimesh.sample.sample_surface(m, 20_000, seed=0)[0] for m in (a, b))
    return cKDTree(p).query(q)[0], cKDTree(q).query(p)[0]


@pytest.mark.parametrize("name", SURFACES)
def test_surface_is_reproduced(name):
    mesh, loops, chi = SURFACES[name]
    assert (loop_count(mesh.faces), mesh.euler_number) == (loops, chi)
    fields = from_mesh(mesh, LATTICE)
    surface = extract(LATTICE, mi.Float(fields.sdf), mi.Float(fields.msdf), template=True)
    vertices, faces, _ = surface.to_numpy()
    assert_manifold(vertices, faces)
    assert (loop_count(faces), component_count(faces), euler_characteristic(faces)) == (loops, 1, chi)
    assert surface.template.to_trimesh().is_watertight
    for distance in _distances(mesh, surface.to_trimesh()):
        assert distance.max() < 1.2 * LATTICE.spacing and distance.mean() < 0.2 * LATTICE.spacing
    # Orientation is kept: normals agree with those of the nearest face.
    nearest = cKDTree(mesh.triangles_center).query(surface.to_trimesh().triangles_center)[1]
    agreement = np.einsum("ij,ij->i", mesh.face_normals[nearest], surface.to_trimesh().face_normals)
    assert np.mean(agreement > 0) > 0.98


def _fold(gap):
    """Two parallel sheets with a gap between them, joined along one side by a half cylinder."""

    def point(u, v):
        along = (u - 0.5) * (1.6 + np.pi * gap / 2)
        straight, angle = np.clip(np.abs(along) - np.pi * gap / 4, 0, None), along / (gap / 2)
        angle = np.clip(angle, -np.pi / 2, np.pi / 2)
        return straight - 0.4 - gap / 2 * np.cos(angle), gap / 2 * np.sin(angle) + 0.01, v - 0.5

    return _grid(point, False, rows=24, columns=400)


@pytest.mark.parametrize("gap", [0.6, 1.5])
@pytest.mark.parametrize("grid", GRIDS)
def test_layers_closer_than_a_cell_stay_apart(grid, gap):
    lattice = make_lattice(grid, LATTICE.resolution)
    mesh = _fold(gap * lattice.spacing)
    assert (loop_count(mesh.faces), mesh.euler_number) == (1, 1)
    for turned in (False, True):  # the gap is outside, or inside
        if turned:
            mesh.invert()
        fields = from_mesh(mesh, lattice)
        _, faces, _ = extract(lattice, mi.Float(fields.sdf), mi.Float(fields.msdf)).to_numpy()
        assert (loop_count(faces), component_count(faces), euler_characteristic(faces)) == (1, 1, 1)


@pytest.mark.parametrize("gap", [0.7, 1.1])
@pytest.mark.parametrize("axis", [(1, 1, 1), (1, -1, 1), (1, 2, 3)])
@pytest.mark.parametrize("grid", ["cube", "flexicubes"])
def test_oblique_layers_in_cubes_stay_apart(grid, axis, gap):
    lattice = make_lattice(grid, LATTICE.resolution)
    for angle in (-0.785, 0.4):
        mesh = _fold(gap * lattice.spacing)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(angle, axis))
        mesh.apply_scale(0.8 / np.abs(mesh.vertices).max())
        fields = from_mesh(mesh, lattice)
        _, faces, _ = extract(lattice, mi.Float(fields.sdf), mi.Float(fields.msdf)).to_numpy()
        assert (loop_count(faces), component_count(faces), euler_characteristic(faces)) == (1, 1, 1)


def _pinched_tube():
    """A tube whose lower rim is drawn in to the shape of an eight, so that it touches itself in a point."""

    def point(u, v):
        x, z = np.cos(2 * np.pi * u), np.sin(2 * np.pi * u)
        return 0.6 * x, 0.5 - v, 0.6 * z * (1 - v + v * np.abs(x))

    return _grid(point, True)


def test_a_rim_that_touches_itself_stays_one():
    mesh = _pinched_tube()
    mesh.merge_vertices()
    uses = np.bincount(np.ravel(boundary_edges(mesh.faces)))
    assert (uses == 4).sum() == 1, "two vertices of the rim have become one"
    split = without_pinches(mesh)
    assert (len(split.vertices), len(split.faces)) == (len(mesh.vertices) + 1, len(mesh.faces))
    np.testing.assert_array_equal(split.triangles, mesh.triangles)
    assert np.bincount(np.ravel(boundary_edges(split.faces))).max() == 2
    assert loop_count(split.faces) == 2
    fields = from_mesh(mesh, LATTICE)
    vertices, faces, _ = extract(LATTICE, mi.Float(fields.sdf), mi.Float(fields.msdf)).to_numpy()
    assert_manifold(vertices, faces)
    assert (loop_count(faces), component_count(faces)) == (2, 1)


@pytest.mark.parametrize("grid", GRIDS)
def test_every_grid(grid):
    lattice = make_lattice(grid, 32)
    mesh, loops, chi = SURFACES["deep bowl"]
    fields = from_mesh(mesh, lattice)
    assert fields.grid == grid
    _, faces, _ = extract(lattice, mi.Float(fields.sdf), mi.Float(fields.msdf)).to_numpy()
    assert (loop_count(faces), euler_characteristic(faces)) == (loops, chi)


def test_inside_out_solid_is_turned():
    ball = trimesh.creation.icosphere(radius=0.6)
    ball.invert()
    assert from_mesh(ball, TetLattice(8)).sdf[9**3 // 2] == pytest.approx(-0.6, abs=0.03)


def test_distances_are_exact_near_the_mesh():
    box = trimesh.creation.box(extents=[1.0, 1.0, 1.0])
    p = LATTICE.vertex_positions()
    outside = np.maximum(np.abs(p) - 0.5, 0)
    expected = np.linalg.norm(outside, axis=1) + np.minimum((np.abs(p) - 0.5).max(axis=1), 0)
    near = np.abs(expected) < 2.5 * LATTICE.spacing
    np.testing.assert_allclose(from_mesh(box, LATTICE).sdf[near], expected[near], atol=1e-5)


def test_to_world(tmp_path):
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(radius=3.0).apply_translation([10, 0, 0]).export(path)
    to_world = np.diag([5.0, 5.0, 5.0, 1.0])
    to_world[:3, 3] = [10, 0, 0]
    fields = from_mesh(path, TetLattice(16), to_world=to_world)
    assert fields.sdf[17**3 // 2] == pytest.approx(-0.6, abs=0.02)
    with pytest.raises(UserError, match=r"ball.ply: reaches to 13 of the lattice's cube .* enlarge to_world"):
        from_mesh(path, TetLattice(16))


def test_the_shape_starts_from_a_mesh(tmp_path):
    path = tmp_path / "ball.obj"
    trimesh.creation.icosphere(radius=0.6).export(path)
    scene = mi.load_dict({"type": "scene", "a": {"type": "gshell", "resolution": 16, "filename": str(path)}})
    assert scene.shapes()[0].surface.to_trimesh().volume == pytest.approx(4 / 3 * np.pi * 0.216, rel=0.1)


def test_unreadable_files(tmp_path):
    (tmp_path / "a.ply").write_text("nonsense")
    with pytest.raises(UserError, match=r"a.ply: cannot be read as a triangle mesh"):
        from_mesh(tmp_path / "a.ply", TetLattice(8))
    with pytest.raises(UserError, match=r"missing.obj: cannot be read"):
        from_mesh(tmp_path / "missing.obj", TetLattice(8))
    trimesh.PointCloud(np.zeros((4, 3))).export(tmp_path / "points.ply")
    with pytest.raises(UserError, match=r"points.ply: holds no triangles"):
        from_mesh(tmp_path / "points.ply", TetLattice(8))
