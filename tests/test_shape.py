import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from topology import assert_manifold

from gshell_mi import UserError
from gshell_mi.fields import LatticeFields, sphere
from gshell_mi.lattice import GRIDS, TetLattice, make_lattice


def _scene(**subject):
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "light": {"type": "constant"},
            "subject": {"type": "gshell", "resolution": 16, **subject},
            "sensor": {
                "type": "perspective",
                "fov": 60,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, -4], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgba"},
            },
        }
    )


def _subject(scene):
    return next(shape for shape in scene.shapes() if shape.id() == "subject")


def _depth(scene, x=0.013, y=0.021):
    """Distance to the subject along z from z = -4."""
    return scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, -4), mi.Vector3f(0, 0, 1))).t


def test_defaults():
    scene = mi.load_dict({"type": "scene", "subject": {"type": "gshell"}})
    subject = _subject(scene)
    assert subject.lattice == TetLattice(64)
    assert _depth(scene)[0] == pytest.approx(3.5, abs=2e-3)
    assert "subject.sdf" in mi.traverse(scene)
    assert "GShell[resolution=64" in str(subject)


def test_from_xml():
    scene = mi.load_string(
        """<scene version="3.0.0">
             <shape type="gshell" id="subject">
               <integer name="resolution" value="12"/>
               <transform name="to_world"><scale value="2"/><translate z="1"/></transform>
               <bsdf type="principled"><rgb name="base_color" value="0.2, 0.4, 0.6"/></bsdf>
             </shape>
           </scene>"""
    )
    assert _depth(scene)[0] == pytest.approx(4, abs=0.03)
    assert "subject.bsdf.base_color.value" in mi.traverse(scene)


def test_update_replaces_the_mesh_in_the_scene():
    scene = _scene(to_world=mi.ScalarTransform4f().scale(2))
    params = mi.traverse(scene)
    lattice = _subject(scene).lattice
    assert _depth(scene)[0] == pytest.approx(3, abs=0.01)
    before = mi.render(scene, spp=16).numpy()[..., 3].mean()

    params["subject.sdf"] = dr.norm(lattice.points(mi.Float)) - 0.7
    params.update()
    assert _depth(scene)[0] == pytest.approx(2.6, abs=0.01)
    after = mi.render(scene, spp=16).numpy()[..., 3].mean()
    # Coverage of the discs, whose radii are 1 and 1.4 at distance 4: sin(angle) = r / 4.
    assert after / before == pytest.approx(1.4**2 / (16 - 1.4**2) * 15, rel=0.04)

    params["subject.msdf"] = lattice.points(mi.Float).z  # cut the near half away: see the far inside
    params.update()
    assert _depth(scene)[0] == pytest.approx(5.4, abs=0.01)

    params["subject.deform"] = dr.full(mi.Float, 1, 3 * lattice.vertex_count)
    params.update()
    assert _depth(scene)[0] == pytest.approx(5.4 + 2 * lattice.max_offset, abs=0.03)
    assert_manifold(*_subject(scene).surface.to_numpy()[:2])


def test_padding_is_degenerate_and_inside():
    scene = _scene()
    subject = _subject(scene)
    surface = subject.surface
    vertices = subject.vertex_positions_buffer().numpy().reshape(-1, 3)
    faces = subject.faces_buffer().numpy().reshape(-1, 3)
    assert len(vertices) > surface.vertex_count and len(faces) > surface.face_count
    np.testing.assert_array_equal(vertices[: surface.vertex_count], surface.to_numpy()[0])
    np.testing.assert_array_equal(faces[: surface.face_count], surface.to_numpy()[1])
    assert (faces[surface.face_count :] == 0).all()
    assert (vertices[surface.vertex_count :] == vertices[0]).all()
    assert subject.surface_area()[0] == pytest.approx(surface.to_trimesh().area, rel=1e-4)
    assert np.isfinite(subject.vertex_normals_buffer().numpy()).all()


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 1000, 123457])
def test_padded_sizes(count):
    from gshell_mi.shape import _Padding

    size = _Padding(count).size
    assert count <= size <= max(count * 1.25 + 16, 16) and size > 0


def test_ladder_is_geometric():
    from gshell_mi.shape import _Padding

    assert len({_Padding(n).size for n in range(1, 100_000)}) < 60


def test_smooth_and_face_normals():
    smooth, flat = _scene(), _scene(face_normals=True)
    ray = mi.Ray3f(mi.Point3f(0.2, 0.1, -4), mi.Vector3f(0, 0, 1))
    for scene, accuracy in ((smooth, 0.999), (flat, 0.9)):
        si = scene.ray_intersect(ray)
        radial = dr.dot(si.sh_frame.n, dr.normalize(mi.Vector3f(si.p)))[0]
        assert accuracy < radial <= 1 + 1e-5
    assert not _subject(flat).has_vertex_normals()
    si = flat.ray_intersect(ray)
    assert dr.dot(si.sh_frame.n, si.n)[0] == pytest.approx(1)


def test_mirrored_transform_keeps_the_outside_out():
    scene = _scene(to_world=mi.ScalarTransform4f().scale([1, -1, 1]))
    assert _subject(scene).surface.to_trimesh().volume > 0.4


def test_empty_surface_is_harmless():
    scene = _scene()
    params = mi.traverse(scene)
    n = _subject(scene).lattice.vertex_count
    params["subject.sdf"] = dr.full(mi.Float, 1, n)
    params.update()
    assert _subject(scene).surface.is_empty and not scene.ray_test(mi.Ray3f([0, 0, -4], [0, 0, 1]))[0]
    image = mi.render(scene, spp=4).numpy()
    assert np.isfinite(image).all() and image[..., :3].min() == pytest.approx(1)
    params["subject.sdf"] = mi.Float(sphere(TetLattice(16)).sdf)
    params.update()
    assert _depth(scene)[0] == pytest.approx(3.5, abs=0.01)


def test_gradients_reach_the_fields():
    scene = _scene(to_world=mi.ScalarTransform4f().scale(2))
    params = mi.traverse(scene)
    radius = mi.Float(0.6)
    dr.enable_grad(radius)
    sdf = dr.norm(_subject(scene).lattice.points(mi.Float)) - radius
    params["subject.sdf"] = sdf
    params.update()
    dr.backward(_depth(scene))
    assert dr.grad(radius)[0] == pytest.approx(-2, rel=0.02)

    leaf = mi.Float(sphere(TetLattice(16)).sdf)
    dr.enable_grad(leaf)
    params["subject.sdf"] = leaf
    params.update()
    dr.backward(dr.sum(_subject(scene).surface.vertices.z * _subject(scene).vertex_normals_buffer()[0]))
    assert (dr.grad(params["subject.sdf"]).numpy() != 0).any()


def test_gradients_pass_through_shading_normals():
    scene = _scene()
    params = mi.traverse(scene)
    shift = mi.Float(0)
    dr.enable_grad(shift)
    p = _subject(scene).lattice.points(mi.Float)
    params["subject.sdf"] = dr.norm(p + mi.Vector3f(shift, 0, 0)) - 0.5  # the centre moves to -x
    params.update()
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.013, 0.021, -4), mi.Vector3f(0, 0, 1)))
    dr.backward(si.sh_frame.n.x)
    # n = (x - c) / r, c_x = -shift: dn_x / dshift = 1 / r.
    assert dr.grad(shift)[0] == pytest.approx(2, rel=0.1)


def test_attributes_follow_the_fields():
    scene = _scene(
        bsdf={
            "type": "principled",
            "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
            "roughness": {"type": "mesh_attribute", "name": "vertex_roughness"},
        }
    )
    subject = _subject(scene)
    position = subject.lattice.points(mi.Float)
    subject.attach_attribute("vertex_color", dr.ravel(position))
    subject.attach_attribute("vertex_roughness", 0.5 + 0.25 * position.x)
    params = mi.traverse(scene)
    for radius in (0.5, 0.7):
        params["subject.sdf"] = dr.norm(position) - radius
        params.update()
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.2, 0.1, -4), mi.Vector3f(0, 0, 1)))
        color = subject.eval_attribute_3("vertex_color", si)
        np.testing.assert_allclose(np.array(color).ravel(), np.array(si.p).ravel(), atol=1e-5)
        assert subject.eval_attribute_1("vertex_roughness", si)[0] == pytest.approx(0.55, abs=1e-4)

    field = mi.Float(params["subject.lattice_vertex_roughness"])
    dr.enable_grad(field)
    positions = subject.vertex_positions_buffer().index
    params["subject.lattice_vertex_roughness"] = field
    params.update()
    # The mesh is not written anew: rays would need another BVH.
    assert subject.vertex_positions_buffer().index == positions
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.2, 0.1, -4), mi.Vector3f(0, 0, 1)))
    dr.backward(subject.eval_attribute_1("vertex_roughness", si))
    assert dr.sum(dr.grad(field))[0] == pytest.approx(1, abs=1e-4)


def test_attribute_errors():
    subject = _subject(_scene())
    with pytest.raises(UserError, match="starts with 'vertex_', unlike 'color'"):
        subject.attach_attribute("color", dr.zeros(mi.Float, 17**3))
    with pytest.raises(UserError, match="'vertex_color' has 12 values, but the lattice needs 4913"):
        subject.attach_attribute("vertex_color", dr.zeros(mi.Float, 12))


def test_template():
    scene = _scene()
    params = mi.traverse(scene)
    subject = _subject(scene)
    params["subject.msdf"] = subject.lattice.points(mi.Float).x
    params.update()
    assert subject.template().to_trimesh().is_watertight
    assert not subject.surface.to_trimesh().is_watertight


def test_set_fields_changes_the_resolution():
    scene = _scene()
    subject = _subject(scene)
    subject.attach_attribute("vertex_color", dr.zeros(mi.Float, 3 * subject.lattice.vertex_count))
    subject.set_fields(sphere(TetLattice(24), 0.8))
    scene.parameters_changed()
    assert _depth(scene)[0] == pytest.approx(3.2, abs=0.01)
    params = mi.traverse(scene)
    assert dr.width(params["subject.sdf"]) == 25**3
    assert not any("vertex_color" in key for key in params.keys())


def test_fields_from_a_file(tmp_path):
    path = tmp_path / "fields.npz"
    ball = sphere(TetLattice(10), 0.8)
    ball.save(path)
    subject = _subject(mi.load_dict({"type": "scene", "subject": {"type": "gshell", "filename": str(path)}}))
    assert subject.lattice == TetLattice(10)
    np.testing.assert_array_equal(subject.sdf.numpy(), ball.sdf)
    with pytest.raises(RuntimeError, match="holds fields of resolution 10, but the shape asks for 16"):
        _scene(filename=str(path))


def test_unknown_grids_are_refused():
    with pytest.raises(RuntimeError, match="grid 'hexagons' is not available; choose one of tet, cube"):
        _scene(grid="hexagons")


@pytest.mark.parametrize("grid", GRIDS)
def test_every_grid_makes_a_mesh(grid):
    scene = _scene(grid=grid)
    subject = _subject(scene)
    assert subject.lattice == make_lattice(grid, 16) and subject.fields().grid == grid
    assert _depth(scene)[0] == pytest.approx(3.5, abs=0.02)
    assert_manifold(*subject.surface.to_numpy()[:2])
    subject.set_fields(sphere(make_lattice(grid, 12), 0.7))
    assert subject.lattice == make_lattice(grid, 12)


def test_bad_resolution():
    with pytest.raises(RuntimeError, match="between 1 and 800 cells per side, not 0"):
        _scene(resolution=0)


def test_missing_file():
    with pytest.raises(RuntimeError, match=r"nowhere.npz: cannot be read as an .npz archive"):
        _scene(filename="nowhere.npz")


def test_nan_names_the_field():
    scene = _scene()
    params = mi.traverse(scene)
    n = _subject(scene).lattice.vertex_count
    params["subject.msdf"] = dr.full(mi.Float, dr.nan, n)
    with pytest.raises(UserError, match="msdf holds NaN"):
        params.update()


def test_saved_fields_round_trip(tmp_path):
    fields = LatticeFields(np.ones(8, "f"), np.zeros(8, "f"), np.full(24, 0.5, "f"))
    fields.save(tmp_path / "a.npz")
    loaded = LatticeFields.load(tmp_path / "a.npz")
    for name in ("sdf", "msdf", "deform"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(fields, name))


def _iteration(scene, params, radius):
    """Render and differentiate one shape of a changing family."""
    subject = _subject(scene)
    p = subject.lattice.points(mi.Float)
    dr.make_opaque(p)
    value = dr.opaque(mi.Float, radius)
    dr.enable_grad(value)
    params["subject.sdf"] = dr.norm(p) - value
    params["subject.msdf"] = 0.3 - p.y
    params.update()
    image = mi.render(scene, spp=2)
    origin = mi.Point3f(dr.linspace(mi.Float, -0.2, 0.2, 64), 0, -4)
    si = scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(0, 0, 1)))
    dr.backward(dr.sum(dr.select(si.is_valid(), si.t + si.sh_frame.n.x, 0)))
    dr.eval(image, dr.grad(value))
    return subject.surface.vertex_count


def test_kernels_come_from_the_cache():
    scene = _scene()
    params = mi.traverse(scene)
    for radius in np.linspace(0.45, 0.66, 25):  # every size of the ladder that follows, once
        _iteration(scene, params, float(radius))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        counts = {_iteration(scene, params, float(r)) for r in np.linspace(0.4533, 0.6511, 30)}
        kernels = dr.kernel_history([dr.KernelType.JIT])
    assert len(counts) > 20 and len(kernels) > 500
    assert [k["size"] for k in kernels if not k["cache_hit"] or k["cache_disk"]] == []


def test_import_forces_no_variant():
    import subprocess
    import sys

    code = "import gshell_mi, gshell_mi.fields, mitsuba as mi; assert mi.variant() is None"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_change_of_variant():
    """The class is made anew for the variant in use, and again on the way back."""
    import subprocess
    import sys

    code = """
import mitsuba as mi, gshell_mi
for variant in ("llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_mono"):
    mi.set_variant(variant)
    scene = mi.load_dict({"type": "scene", "a": {"type": "gshell", "resolution": 8}})
    hit = scene.ray_intersect(mi.Ray3f([0, 0, -4], [0, 0, 1]))
    assert abs(hit.t[0] - 3.5) < 0.1 and isinstance(scene.shapes()[0], mi.Mesh)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_weights_are_a_parameter_of_flexicubes_alone():
    assert "subject.weights" not in mi.traverse(_scene(grid="cube"))
    scene = _scene(grid="flexicubes", resolution=8)
    params, subject = mi.traverse(scene), _subject(scene)
    before = subject.surface.to_numpy()[0]
    weights = np.random.default_rng(0).normal(size=21 * 8**3).astype(np.float32)
    params["subject.weights"] = mi.Float(weights)
    params.update()
    moved = np.abs(subject.surface.to_numpy()[0] - before).max()
    assert 0.01 < moved < subject.lattice.spacing
    np.testing.assert_array_equal(subject.fields().weights, weights)
    assert subject.template().vertex_count == subject.surface.vertex_count


def test_band_gives_the_same_mesh_and_follows():
    scenes = [_scene(resolution=70, grid="tet", band=band) for band in (False, True)]
    whole, stored = (_subject(scene) for scene in scenes)
    assert stored.lattice.vertex_count < 0.6 * whole.lattice.vertex_count
    for a, b in zip(whole.surface.to_numpy(), stored.surface.to_numpy(), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-6)  # the sphere's values are not computed alike
    params = mi.traverse(scenes[1])
    stored.attach_attribute("vertex_color", stored.lattice.points(mi.Float).x)
    assert stored.follow() is None and whole.follow() is None
    before = stored.lattice
    params["subject.sdf"] = params["subject.sdf"] - 2.5 * before.spacing
    params.update()
    carried = stored.follow()
    assert carried.before is before and carried.after is stored.lattice
    assert stored.lattice.vertex_count > before.vertex_count
    # The parameters of the earlier traversal still work, with the new sizes.
    assert dr.width(params["subject.sdf"]) == stored.lattice.vertex_count
    params["subject.sdf"] = params["subject.sdf"] - 2.5 * before.spacing
    params.update()
    assert _depth(scenes[1])[0] == pytest.approx(3.5 - 5 * before.spacing, abs=5e-3)
    color = stored.surface.interpolate(stored._attributes["vertex_color"][0]).numpy()
    np.testing.assert_allclose(color, stored.surface.to_numpy()[0][:, 0], atol=0.5 * before.spacing)
    assert stored.follow(rescan=True) is not None and stored.follow(rescan=True) is None
    assert _depth(scenes[1])[0] == pytest.approx(3.5 - 5 * before.spacing, abs=5e-3)


@pytest.mark.parametrize("grid", [grid for grid in GRIDS if make_lattice(grid, 1).fits_in_blocks])
def test_fields_in_blocks_from_a_file(tmp_path, grid):
    given = sphere(make_lattice(grid, 40), 0.4).in_blocks()
    given.save(tmp_path / "ball.npz")
    subject = _subject(_scene(filename=str(tmp_path / "ball.npz"), grid=grid, resolution=40))
    assert subject.surface.to_trimesh().is_watertight
    again = subject.fields()
    for name in ("sdf", "msdf", "deform", "blocks"):
        np.testing.assert_array_equal(getattr(again, name), getattr(given, name))


@pytest.mark.parametrize("other", ["ply", "gshell"])
def test_a_neighbour_of_equal_material_does_not_swallow_it(other, tmp_path):
    """Mitsuba makes one plain mesh of those that have equal materials."""
    trimesh.creation.icosphere(1).export(tmp_path / "ball.ply")
    bsdf = {"type": "diffuse"}
    neighbour = {"type": other, "bsdf": bsdf} | (
        {"filename": str(tmp_path / "ball.ply")} if other == "ply" else {"resolution": 8}
    )
    scene = mi.load_dict(
        {"type": "scene", "other": neighbour, "subject": {"type": "gshell", "resolution": 16, "bsdf": bsdf}}
    )
    assert len(scene.shapes()) == 2
    params = mi.traverse(scene)
    assert "subject.sdf" in params and not any("unmerged" in key for key in params.keys())
    params["subject.sdf"] = params["subject.sdf"] - 0.25
    params.update()
    radii = np.linalg.norm(_subject(scene).surface.to_trimesh().vertices, axis=1)
    np.testing.assert_allclose(radii, 0.75, atol=0.01)
