import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from topology import assert_manifold, boundary_edges, component_count, euler_characteristic, loop_count

from gshell_mi import UserError
from gshell_mi.extraction import extract
from gshell_mi.lattice import GRIDS, TetLattice, array_type, make_lattice

SPECIAL = [0.0, -0.0, 1.0, -1.0, 1e-30, -1e-30, 1e-7, -1e-7, 1e-45, -1e-45, 3e38, -3e38, 0.25, -0.75]
DENORMAL = 2.0**-126  # numbers below may count as 0
VALUES = st.one_of(
    st.sampled_from(SPECIAL),
    st.floats(-1, 1, width=32),
    st.floats(width=32, allow_nan=False, allow_infinity=False),
)


@pytest.fixture(params=GRIDS)
def grid(request) -> str:
    return request.param


def _mesh(lattice, sdf, msdf=None, deform=None, weights=None, **kwargs):
    fields = (sdf, msdf, deform, weights)
    fields = [None if f is None else mi.Float(np.asarray(f, np.float32)) for f in fields]
    return extract(lattice, *fields[:3], weights=fields[3], **kwargs)


def _assert_guarantee(mesh, lattice, sdf, msdf):
    """The promises of ``extract`` for the open surface and its template."""
    vertices, faces, values = mesh.to_numpy()
    assert_manifold(vertices, faces)
    assert (values >= -DENORMAL).all() and np.isfinite(values).all()
    whole, whole_faces, whole_values = mesh.template.to_numpy()
    assert_manifold(whole, whole_faces)
    # The template ends nowhere but at the border of the lattice.
    if _positive_border(lattice, sdf):
        assert len(boundary_edges(whole_faces)) == 0
    kept = mesh.kept_vertex_count
    np.testing.assert_array_equal(vertices[:kept], whole[:kept])
    np.testing.assert_allclose(values[:kept], whole_values[:kept], rtol=0, atol=DENORMAL)
    assert (whole_values[kept:] < DENORMAL).all()
    if msdf is None or (np.asarray(msdf) >= 0).all():
        np.testing.assert_array_equal(vertices, whole)
        np.testing.assert_array_equal(faces, whole_faces)


def _positive_border(lattice, sdf) -> bool:
    if lattice.grid == "flexicubes":
        return True  # what is negative there counts as positive
    return bool((np.asarray(sdf).ravel()[lattice.on_border()] >= 0).all())


@st.composite
def _fields(draw):
    lattice = make_lattice(draw(st.sampled_from(GRIDS)), draw(st.integers(1, 3)))
    n = lattice.vertex_count
    sdf = draw(arrays(np.float32, n, elements=VALUES, fill=st.nothing()))
    if draw(st.booleans()):
        sdf[lattice.on_border()] = 1
    msdf = draw(st.none() | arrays(np.float32, n, elements=VALUES, fill=st.nothing()))
    deform = draw(
        st.none() | arrays(np.float32, 3 * n, elements=st.sampled_from([-2.0, -1.0, 0.0, 0.5, 1.0]))
    )
    weights = None
    if lattice.weight_count:
        weights = draw(st.none() | arrays(np.float32, lattice.weight_count, elements=VALUES))
    return lattice, sdf, msdf, deform, weights


@settings(max_examples=300, deadline=None)
@given(_fields())
def test_guarantee_on_any_finite_fields(fields):
    lattice, sdf, msdf, deform, weights = fields
    mesh = _mesh(lattice, sdf, msdf, deform, weights, template=True)
    _assert_guarantee(mesh, lattice, sdf, msdf)


@settings(max_examples=60, deadline=None)
@given(
    grid=st.sampled_from(GRIDS),
    seed=st.integers(0, 2**32 - 1),
    resolution=st.integers(4, 12),
    levels=st.sampled_from([None, 1, 2, 50]),
    deformed=st.booleans(),
)
def test_guarantee_on_random_lattices(grid, seed, resolution, levels, deformed):
    """Random fields without limit, or rounded to few levels so that many values are exactly 0."""
    lattice = make_lattice(grid, resolution)
    rng = np.random.default_rng(seed)
    sdf, msdf = rng.uniform(-1.5, 1.5, (2, lattice.vertex_count))
    if levels:
        sdf, msdf = np.round(sdf * levels) / levels, np.round(msdf * levels) / levels
    deform = rng.choice([-1.0, 1.0], 3 * lattice.vertex_count) if deformed else None
    weights = rng.choice([-9.0, 0.0, 0.3, 9.0], lattice.weight_count) if lattice.weight_count else None
    mesh = _mesh(lattice, sdf, msdf, deform, weights, template=True)
    _assert_guarantee(mesh, lattice, sdf, msdf)


@pytest.mark.slow
def test_guarantee_on_a_thousand_random_lattices(grid):
    for seed in range(1000):
        rng = np.random.default_rng(seed)
        lattice = make_lattice(grid, int(rng.integers(1, 6)))
        levels = rng.choice([1, 2, 50, 1000])
        sdf, msdf = np.round(rng.uniform(-1.5, 1.5, (2, lattice.vertex_count)) * levels) / levels
        deform = rng.choice([-1.0, 0.0, 1.0], 3 * lattice.vertex_count)
        weights = rng.choice([-9.0, 0.0, 9.0], lattice.weight_count) if lattice.weight_count else None
        _assert_guarantee(_mesh(lattice, sdf, msdf, deform, weights, template=True), lattice, sdf, msdf)


def test_no_degenerate_faces_at_high_resolution(grid):
    lattice = make_lattice(grid, 32)
    sdf, msdf = np.random.default_rng(0).integers(-1, 2, (2, lattice.vertex_count))
    _assert_guarantee(_mesh(lattice, sdf, msdf, template=True), lattice, sdf, msdf)


@pytest.mark.parametrize("value", [1.0, 0.0, -1.0])
def test_no_sign_change_gives_an_empty_mesh(grid, value):
    lattice = make_lattice(grid, 3)
    if grid == "flexicubes" and value < 0:
        return  # its border counts as outside
    count = lattice.vertex_count
    mesh = _mesh(lattice, np.full(count, value), np.ones(count), template=True)
    assert mesh.is_empty and mesh.template.is_empty and mesh.vertex_count == 0
    assert dr.width(mesh.interpolate(dr.zeros(mi.Float, count))) == 0
    assert len(mesh.to_trimesh().faces) == 0


def test_everything_cut_away(grid):
    lattice = make_lattice(grid, 8)
    mesh = extract(lattice, _ball(lattice), dr.full(mi.Float, -1, lattice.vertex_count), template=True)
    assert mesh.is_empty and mesh.template.face_count > 0 and mesh.template.kept_vertex_count == 0


@pytest.mark.parametrize("corner", range(8))
def test_single_cell_with_one_corner_inside(corner):
    sdf = np.ones(8)
    sdf[corner] = -1
    vertices, faces, _ = _mesh(TetLattice(1), sdf).to_numpy()
    assert_manifold(vertices, faces)
    # The corner's edges: 7 at both ends of the diagonal of the Kuhn split, elsewhere 4.
    assert len(vertices) == (7 if corner in (0, 7) else 4)
    assert (euler_characteristic(faces), loop_count(faces)) == (1, 1)


def _ball(lattice, radius=0.6):
    return dr.norm(lattice.points(mi.Float)) - radius


def test_sphere(grid):
    """Genus, area and volume; the error falls with the square of the resolution."""
    errors = []
    for resolution in (16, 32, 64):
        mesh = extract((lattice := make_lattice(grid, resolution)), _ball(lattice))
        solid = mesh.to_trimesh()
        assert_manifold(solid.vertices, solid.faces)
        assert solid.is_watertight and solid.euler_number == 2
        errors.append((1 - solid.volume / (4 / 3 * np.pi * 0.6**3), 1 - solid.area / (4 * np.pi * 0.6**2)))
    errors = np.array(errors)
    assert (errors > 0).all() and (errors[-1] < 3e-3).all()
    assert np.log2(errors[:-1] / errors[1:]) == pytest.approx(2, abs=0.25)


def test_torus(grid):
    lattice = make_lattice(grid, 32)
    p = lattice.points(mi.Float)
    torus = dr.norm(mi.Vector2f(dr.norm(mi.Vector2f(p.x, p.y)) - 0.6, p.z)) - 0.25
    _, faces, _ = extract(lattice, torus).to_numpy()
    assert (euler_characteristic(faces), component_count(faces)) == (0, 1)


def test_half_sphere(grid):
    lattice = make_lattice(grid, 64)
    z = lattice.points(mi.Float).z
    mesh = extract(lattice, _ball(lattice), 0.1234 - z)
    vertices, faces, values = mesh.to_numpy()
    assert_manifold(vertices, faces)
    assert (loop_count(faces), component_count(faces), euler_characteristic(faces)) == (1, 1, 1)
    rim = np.unique(boundary_edges(faces))
    assert (rim >= mesh.kept_vertex_count).all() and len(rim) == len(vertices) - mesh.kept_vertex_count
    np.testing.assert_allclose(vertices[rim, 2], 0.1234, atol=2e-4)
    assert (values[rim] == 0).all()
    area = mesh.to_trimesh().area
    assert area == pytest.approx(2 * np.pi * 0.6 * (0.6 + 0.1234), rel=2e-3)


@pytest.mark.parametrize(("holes", "chi"), [(1, 1), (2, 0), (6, -4)])
def test_sphere_with_holes(grid, holes, chi):
    lattice = make_lattice(grid, 32)
    p = lattice.points(mi.Float)
    axes = [p.x, -p.x, p.y, -p.y, p.z, -p.z][:holes]
    msdf = axes[0] * -1 + 0.5
    for axis in axes[1:]:
        msdf = dr.minimum(msdf, 0.5 - axis)
    _, faces, _ = extract(lattice, _ball(lattice), msdf).to_numpy()
    assert (loop_count(faces), euler_characteristic(faces)) == (holes, chi)


def test_positive_msdf_gives_the_template(grid):
    lattice = make_lattice(grid, 20)
    sdf = _ball(lattice)
    ones = dr.full(mi.Float, 0.3, lattice.vertex_count)
    for mesh in (extract(lattice, sdf, ones, template=True), extract(lattice, sdf, template=True)):
        for a, b in zip(mesh.to_numpy()[:2], mesh.template.to_numpy()[:2], strict=True):
            np.testing.assert_array_equal(a, b)
        assert mesh.to_trimesh().is_watertight


@pytest.mark.parametrize("grid", ["tet", "cube"])
def test_surface_ends_at_the_border_of_the_lattice(grid):
    lattice = make_lattice(grid, 10)
    vertices, faces, _ = extract(lattice, lattice.points(mi.Float).z - 0.05).to_numpy()
    assert_manifold(vertices, faces)
    assert (loop_count(faces), euler_characteristic(faces)) == (1, 1)
    rim = vertices[np.unique(boundary_edges(faces))]
    np.testing.assert_allclose(np.abs(rim[:, :2]).max(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(vertices[:, 2], 0.05, atol=1e-6)
    p = vertices[faces]
    assert (np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, 2] > 0).all(), "outwards is upwards"


def test_offsets_are_clipped_and_scaled(grid):
    lattice = make_lattice(grid, 4)
    n = lattice.vertex_count
    sdf = lattice.points(mi.Float).z - 0.25
    plain = extract(lattice, sdf)
    for value, shift in ((0.5, 0.5), (1, 1), (7, 1), (-3, -1)):
        moved = extract(lattice, sdf, None, dr.full(array_type(mi.Float, "Array3f"), value, n))
        expected = np.array(plain.vertices) + shift * lattice.max_offset
        np.testing.assert_allclose(np.array(moved.vertices), expected, atol=1e-6)


def test_deform_layouts_agree():
    lattice = TetLattice(5)
    deform = np.random.default_rng(1).uniform(-1, 1, (lattice.vertex_count, 3)).astype(np.float32)
    sdf = _ball(lattice)
    flat = extract(lattice, sdf, None, mi.Float(deform.ravel()))
    tensor = extract(lattice, mi.TensorXf(sdf, (6, 6, 6)), None, mi.TensorXf(deform))
    nested = extract(lattice, sdf, None, array_type(mi.Float, "Array3f")(deform.T))
    for other in (tensor, nested):
        np.testing.assert_array_equal(np.array(flat.vertices), np.array(other.vertices))


def test_interpolate_reproduces_positions(grid):
    """Linear fields are interpolated exactly, scalar and vector, on cut vertices too."""
    lattice = make_lattice(grid, 12)
    p = lattice.points(mi.Float)
    mesh = extract(lattice, _ball(lattice), p.x + 0.3 * p.y, template=True)
    assert mesh.vertex_count > mesh.kept_vertex_count > 0
    for surface in (mesh, mesh.template):
        np.testing.assert_allclose(surface.interpolate(p).numpy(), surface.vertices.numpy(), atol=1e-6)
        np.testing.assert_allclose(
            surface.interpolate(2 * p.y).numpy(), 2 * surface.vertices.y.numpy(), atol=1e-6
        )


def test_entries_are_the_interpolation(grid):
    lattice = make_lattice(grid, 8)
    p = lattice.points(mi.Float)
    mesh = extract(lattice, _ball(lattice), p.x + 0.3 * p.y)
    field = np.random.default_rng(0).normal(size=lattice.vertex_count)
    values = np.zeros(mesh.vertex_count)
    for vertex, source, weight in mesh.stencil.entries():
        np.add.at(values, vertex.numpy(), weight.numpy() * field[source.numpy()])
    np.testing.assert_allclose(mesh.interpolate(mi.Float(field)).numpy(), values, atol=1e-5)


def test_interpolate_needs_one_value_per_lattice_vertex():
    lattice = TetLattice(4)
    with pytest.raises(UserError, match="8 values, but the lattice needs 125"):
        extract(lattice, _ball(lattice)).interpolate(dr.zeros(mi.Float, 8))


def test_types_follow_the_input():
    import drjit.llvm as llvm

    lattice = TetLattice(6)
    mesh = extract(lattice, dr.norm(lattice.points(llvm.Float)) - 0.5)
    assert type(mesh.vertices) is llvm.Array3f and type(mesh.faces) is llvm.Array3u


@pytest.mark.parametrize("name", ["sdf", "msdf", "deform"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_non_finite_field(name, value):
    lattice = TetLattice(3)
    fields = {"sdf": np.ones(64), "msdf": np.ones(64), "deform": np.zeros(192)}
    fields[name][17] = value
    with pytest.raises(UserError, match=f"^{name} holds NaN or infinite values"):
        _mesh(lattice, **fields)


def test_huge_finite_fields_are_no_error():
    lattice = TetLattice(4)
    sdf = np.full(125, 3e38)
    sdf[62] = -3e38
    assert _mesh(lattice, sdf).to_trimesh().is_watertight


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ((63, 64, 192), "sdf has 63 values, but the lattice needs 64"),
        ((64, 1, 192), "msdf has 1 values, but the lattice needs 64"),
        ((64, 64, 64), "deform has 64 values, but the lattice needs 192"),
    ],
)
def test_wrong_sizes(sizes, message):
    with pytest.raises(UserError, match=message):
        _mesh(TetLattice(3), *(np.ones(n) for n in sizes))


def test_too_many_vertices(monkeypatch):
    from gshell_mi.extraction import grid_extraction

    monkeypatch.setattr(grid_extraction, "_MAX_VERTICES", 100)
    lattice = TetLattice(8)
    with pytest.raises(UserError, match="more than the 100 supported; sdf should be smoother"):
        extract(lattice, _ball(lattice))
