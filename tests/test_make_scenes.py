"""The builder of the scenes: modelling, draping, lights, files, command."""

import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh

REPOSITORY = Path(__file__).parents[1]
sys.path.insert(0, str(REPOSITORY / "pipelines"))

from scene_builder import cloth, files, lights, modelling  # noqa: E402
from scene_builder.objects import bowl, chair, lace, leaf, mug, skirt, vase  # noqa: E402


def ball(p):
    return np.linalg.norm(p, axis=1) - 0.7


@pytest.fixture(scope="module")
def sphere():
    return modelling.isosurface(ball, [-1, -1, -1], [1, 1, 1], 0.1)


def test_isosurface_of_a_ball(sphere):
    assert sphere.is_watertight and sphere.euler_number == 2
    assert sphere.volume == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=0.02), "positive: faces turned outwards"


def test_cut_leaves_a_cap(sphere):
    nu = np.asarray(sphere.vertices)[:, 1] - 0.3
    cap = modelling.cut(sphere, nu)
    rim = modelling.boundary_vertices(cap)
    assert cap.is_winding_consistent and cap.euler_number == 1
    assert cap.area == pytest.approx(2 * np.pi * 0.7 * 0.4, rel=0.02)
    assert np.asarray(cap.vertices)[rim, 1] == pytest.approx(0.3)
    assert np.asarray(cap.vertices)[~rim, 1].min() > 0.3


def test_cut_through_vertices_leaves_no_slivers():
    mesh = trimesh.creation.icosphere(2)
    y = np.round(np.asarray(mesh.vertices)[:, 1], 9)
    assert (y == 0).any()
    cap = modelling.cut(mesh, y)
    assert cap.euler_number == 1
    assert cap.area_faces.min() > 1e-4


def test_cut_that_keeps_all_or_splits(sphere):
    assert len(modelling.cut(sphere, np.ones(len(sphere.vertices))).faces) == len(sphere.faces)
    y = np.asarray(sphere.vertices)[:, 1]
    larger = modelling.cut(sphere, np.maximum(y - 0.2, -0.4 - y))
    assert larger.body_count == 1 and larger.vertices[:, 1].min() > 0.19
    both = modelling.cut(sphere, np.maximum(y - 0.2, -0.4 - y), islands=True)
    assert both.body_count == 2 and both.euler_number == 2


def test_relax_evens_triangles_and_stays_on_the_surface(sphere):
    def nu(p):
        return p[:, 1] - 0.3

    before = modelling.cut(sphere, nu(np.asarray(sphere.vertices)))
    after = modelling.relax(before, ball, nu)
    rim = modelling.boundary_vertices(after)
    assert np.abs(ball(after.vertices)).max() < 1e-3
    assert np.abs(nu(after.vertices[rim])).max() < 1e-4
    assert after.area_faces.min() > 3 * before.area_faces.min()
    assert np.median(np.ptp(after.face_angles, axis=1)) < np.median(np.ptp(before.face_angles, axis=1))


def test_revolved_half_circle_is_a_cap():
    angle = np.linspace(0, 0.6 * np.pi, 9)
    profile = modelling.even_profile(np.stack([np.sin(angle), -np.cos(angle)], 1), 60)
    steps = np.linalg.norm(np.diff(profile, axis=0), axis=1)
    assert np.ptp(steps) < 0.01 * steps.mean()
    cap = modelling.revolve(profile, 100)
    assert cap.is_winding_consistent and cap.euler_number == 1
    assert cap.area == pytest.approx(2 * np.pi * (1 - np.cos(0.6 * np.pi)), rel=0.005)
    outwards = (cap.face_normals * cap.triangles_center).sum(1)
    assert outwards.min() > 0.99


def test_pattern_of_the_skirt_is_a_ring_of_even_triangles():
    ring = skirt.cut_pattern(0.06)
    assert ring.euler_number == 0 and ring.body_count == 1
    assert ring.face_normals[:, 1].min() > 0.999, "upper side up"
    assert np.degrees(ring.face_angles.min()) > 35
    assert ring.area == pytest.approx(np.pi * (skirt.HEM**2 - skirt.WAIST**2), rel=0.01)


def test_chair_has_one_seat_layer_and_closed_legs():
    mesh = chair.build().mesh
    seat = (np.abs(mesh.triangles_center) < [0.3, 0.2, 0.3]).all(1)
    assert seat.any() and mesh.face_normals[seat, 1].min() > 0.8, "no underside"
    low = mesh.vertices[:, 1] < -0.5
    assert not modelling.boundary_vertices(mesh)[low].any(), "the legs' feet are closed"


def test_distance_functions():
    p = np.array([[2.0, 0, 0], [0, 0.5, 0], [0, 0, -3]])
    tube = modelling.capsule(p, [0, -1, 0], [0, 1, 0], 0.5)
    assert tube == pytest.approx([1.5, -0.5, 2.5])
    ring = modelling.torus(p, [0, 0, 0], [0, 1, 0], 1, 0.25)
    assert ring == pytest.approx([0.75, np.hypot(1, 0.5) - 0.25, 1.75])
    assert modelling.ellipsoid(p, [0, 0, 0], [1, 1, 1]) == pytest.approx([1, -0.5, 2])
    assert modelling.smooth_union(np.array([0.0, 5]), np.array([0.0, 1]), 0.4) == pytest.approx([-0.1, 1])


def test_drape_rests_on_the_body_and_hardly_stretches():
    n = 21
    u, v = np.meshgrid(*2 * [np.linspace(-0.8, 0.8, n)], indexing="ij")
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1], i[1:, :-1], i[:-1, 1:], i[1:, 1:]
    faces = np.concatenate([np.stack(q, -1).reshape(-1, 3) for q in ((a, c, b), (b, c, d))])
    sheet = trimesh.Trimesh(np.stack([u, 0 * u + 0.75, v], -1).reshape(-1, 3), faces, process=False)

    x = cloth.drape(sheet, lambda p, t: ball(p), seconds=1.5, friction=0.5)
    assert np.isfinite(x).all()
    assert ball(x).min() > -0.01, "outside the body"
    assert x[:, 1].max() > 0.65, "the middle lies on top"
    corners = x[[0, n - 1, -n, -1], 1]
    assert corners.max() < 0.3, "the corners hang"
    e = sheet.edges_unique
    length = np.linalg.norm(x[e[:, 0]] - x[e[:, 1]], axis=1)
    assert np.median(np.abs(length / sheet.edges_unique_length - 1)) < 0.03
    assert np.array_equal(x, cloth.drape(sheet, lambda p, t: ball(p), seconds=1.5, friction=0.5))


def test_solid_angles_and_lobes_integrate():
    weight = lights.solid_angle()[:, None, None]
    assert (2 * lights.HEIGHT * lights.solid_angle()).sum() == pytest.approx(4 * np.pi)
    d = lights.directions()
    assert np.linalg.norm(d, axis=-1) == pytest.approx(1)
    assert (d * weight).sum((0, 1)) == pytest.approx([0, 0, 0], abs=1e-9)
    lobe = lights.lobe(lights.direction(30, 40), 8)
    mean = (d * lobe[..., None] * weight).sum((0, 1))
    assert mean / np.linalg.norm(mean) == pytest.approx(lights.direction(30, 40), abs=1e-3)


def test_sky_lights_a_white_floor_as_told():
    sky = lights.sunny_sky(20, 50, exposure=0.8)
    up = np.clip(lights.directions()[..., 1:2], 0, None)
    irradiance = (sky * up * lights.solid_angle()[:, None, None]).sum((0, 1)).mean()
    # The blend at the horizon takes a little.
    assert irradiance == pytest.approx(0.8 * np.pi, rel=0.03)
    brightest = lights.directions().reshape(-1, 3)[sky.sum(-1).argmax()]
    assert brightest @ lights.direction(20, 50) > np.cos(np.radians(4))


def test_directions_are_those_of_mitsubas_envmap():
    image = lights.studio([(40, 35, 12, [3, 2, 1])]).astype(np.float32)
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(image)})
    si = mi.SurfaceInteraction3f()
    si.wi = -mi.Vector3f(np.ascontiguousarray(lights.directions().reshape(-1, 3).T, dtype=np.float32))
    assert np.array(emitter.eval(si)).T.reshape(image.shape) == pytest.approx(image, abs=1e-3)


def test_fibonacci_sphere_is_even():
    d = files.fibonacci_sphere(48)
    assert np.linalg.norm(d, axis=1) == pytest.approx(1)
    assert np.linalg.norm(d.mean(0)) < 0.02
    above = files.fibonacci_sphere(200, lowest=0.25)
    assert above[:, 1].min() == pytest.approx(0.25, abs=0.005)
    assert above.mean(0) == pytest.approx([0, 0.625, 0], abs=0.02), "even in solid angle"
    gap = 2 - 2 * (d @ d.T) + 4 * np.eye(48)
    assert np.sqrt(gap.min()) > 0.7 * np.sqrt(4 * np.pi / 48)


def test_written_scene_comes_back(tmp_path):
    mesh = trimesh.creation.box((2, 1, 0.5)).subdivide()
    color = np.linspace(0, 1, 3 * len(mesh.vertices)).reshape(-1, 3)
    light = lights.studio([(0, 45, 10, [1, 1, 1])])
    (tmp_path / "box").mkdir()
    (tmp_path / "box" / "view_000.exr").touch()
    files.write_scene("box", files.SceneObject(mesh, color, light, roughness=0.3, views=5), tmp_path)
    assert not (tmp_path / "box" / "view_000.exr").exists(), "a target of an earlier truth"
    scene = mi.load_file(str(tmp_path / "box" / "reference.xml"))
    params = mi.traverse(scene)
    positions = np.array(params["subject.vertex_positions"]).reshape(-1, 3)
    assert np.abs(positions).max(0) == pytest.approx([0.9, 0.45, 0.225])
    assert np.array(params["subject.vertex_color"]) == pytest.approx(color.ravel())
    assert np.array(params["subject.faces"]).reshape(-1, 3).tolist() == mesh.faces.tolist()
    assert [s.id() for s in scene.sensors()] == [f"view_{i:03}" for i in range(5)]
    assert scene.sensors()[0].sampler().sample_count() == 256
    written = np.array(mi.Bitmap(str(tmp_path / "box" / "light.exr")))
    assert written.dtype == np.float16
    assert written.astype(float) == pytest.approx(light, rel=1e-3)


@pytest.mark.parametrize("module", [bowl, lace, leaf, mug, vase])
def test_committed_truth_is_what_the_code_builds(module):
    item = module.build()
    name = module.__name__.split(".")[-1]
    committed = trimesh.load(REPOSITORY / "scenes" / name / "truth.ply", process=False)
    assert np.array_equal(committed.faces, item.mesh.faces)
    assert np.asarray(committed.vertices) == pytest.approx(files.centred(item.mesh), abs=1e-6)


def test_command(tmp_path):
    command = [sys.executable, str(REPOSITORY / "pipelines" / "make_scenes.py")]
    result = subprocess.run([*command, "leaf", "-o", str(tmp_path)], capture_output=True, text=True)
    assert result.returncode == 0 and result.stdout.startswith("leaf: ")
    assert {p.name for p in tmp_path.rglob("*") if p.is_file()} == {
        "leaf.xml",
        "sensors.xml",
        "test.xml",
        "reference.xml",
        "truth.ply",
        "light.exr",
    }
    result = subprocess.run([*command, "teapot"], capture_output=True, text=True)
    assert result.returncode == 2 and "no such object: teapot; there are basket" in result.stderr
