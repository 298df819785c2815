"""What a fit leaves behind, as other programs read it."""

import json
import shutil
from types import SimpleNamespace
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from bowl import SIZE, VIEWS
from PIL import Image
from topology import loop_count

from gshell_mi import UserError
from gshell_mi.evaluation import VIEW_SCORES
from gshell_mi.export import export_fit, fit_folder, write_metrics
from gshell_mi.export.ply import read_ply, write_ply
from gshell_mi.export.stock_scene import up_axis, write_light, write_scene
from gshell_mi.fields import LatticeFields, sphere
from gshell_mi.fit.config import FitConfig
from gshell_mi.fit.joint.config import RenderConfig
from gshell_mi.fit.joint.joint import JointStage
from gshell_mi.images import BOTH, FIT_ONLY, MASK_ONLY, psnr
from gshell_mi.lattice import TetLattice
from gshell_mi.light import EnvironmentLight, turns_with_camera
from gshell_mi.material import MaterialField
from gshell_mi.own_folder import MARK, OwnFolder
from gshell_mi.scene import View, load_fit_scene

LATTICE = TetLattice(16)

#: Every sixth view, and five of the others, spread evenly.
HELD_OUT = ["view_000", "view_006"]
SHOWN = [f"view_{i:03}" for i in (1, 3, 5, 9, 11)]


@pytest.fixture(scope="module")
def exported(bowl_scene, tmp_path_factory):
    """The folder, the stage and the metrics of a sphere cut open at the top, in many colours."""
    output = tmp_path_factory.mktemp("exported")
    fit = load_fit_scene(bowl_scene, hold_out=6)
    ball = sphere(LATTICE, 0.6)
    position = LATTICE.vertex_positions()
    fit.subject.set_fields(LatticeFields(ball.sdf, 0.3 - position[:, 1], ball.deform))
    material = MaterialField(0.5 + 0.4 * position, roughness=0.3, metallic=0.1)
    radiance = np.random.default_rng(0).uniform(0.2, 2, (8, 16, 3))
    config = FitConfig(render=RenderConfig(spp=1, primal_spp=1))
    joint = JointStage(fit, material, EnvironmentLight(radiance), config)
    joint.finish()
    metrics = export_fit(output, fit, joint.material, joint.light, len(SHOWN))
    metrics = write_metrics(output, metrics, {"hull": 1.5, "joint": 2.0})
    return SimpleNamespace(output=output, fit=fit, joint=joint, metrics=metrics, radiance=radiance)


@pytest.fixture(scope="module")
def mesh(exported) -> trimesh.Trimesh:
    return trimesh.load(exported.output / "mesh.ply", process=False)


def attribute(mesh, name: str, channels: int) -> np.ndarray:
    data = mesh.metadata["_ply_raw"]["vertex"]["data"]
    return np.stack([np.ravel(data[f"{name}_{channel}"]) for channel in range(channels)], axis=1)


def test_mesh_in_trimesh(exported, mesh):
    vertices, faces, _ = exported.fit.subject.surface.to_numpy()
    np.testing.assert_array_equal(np.asarray(mesh.vertices, np.float32), vertices)
    np.testing.assert_array_equal(mesh.faces, faces)
    assert loop_count(mesh.faces) == 1 and not mesh.is_watertight
    np.testing.assert_allclose(attribute(mesh, "color", 3), 0.5 + 0.4 * vertices, atol=1e-2)
    np.testing.assert_allclose(attribute(mesh, "roughness", 1), 0.3, atol=1e-5)
    np.testing.assert_allclose(attribute(mesh, "metallic", 1), 0.1, atol=1e-5)


def test_a_texture_is_on_the_divided_mesh(exported, tmp_path):
    whole, faces, _ = exported.fit.subject.surface.to_numpy()
    middles = len(np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0))
    texture = np.random.default_rng(0).uniform(size=(len(whole) + middles, 3))
    metrics = export_fit(tmp_path, exported.fit, exported.joint.material, exported.joint.light, 1, texture, 1)
    divided = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert len(divided.faces) == 4 * len(faces) == metrics["counts"]["faces"]
    assert loop_count(divided.faces) == metrics["counts"]["boundary_loops"] == 1
    np.testing.assert_allclose(np.asarray(divided.vertices)[: len(whole)], whole, atol=1e-6)
    np.testing.assert_allclose(attribute(divided, "color", 3), texture, atol=1e-6)
    np.testing.assert_allclose(attribute(divided, "roughness", 1), 0.3, atol=1e-5)


def test_normals_are_unit_and_point_outwards(mesh):
    data = mesh.metadata["_ply_raw"]["vertex"]["data"]
    normals = np.stack([np.ravel(data[name]) for name in ("nx", "ny", "nz")], axis=1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    radial = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    assert (normals * radial).sum(1).min() > 0.9


def test_mesh_in_stock_mitsuba(exported, mesh):
    shape = mi.load_dict({"type": "ply", "filename": str(exported.output / "mesh.ply")})
    parameters = mi.traverse(shape)
    assert (shape.vertex_count(), shape.face_count()) == (len(mesh.vertices), len(mesh.faces))
    np.testing.assert_array_equal(np.array(parameters["faces"]).reshape(-1, 3), mesh.faces)
    for name, channels in (("color", 3), ("roughness", 1), ("metallic", 1)):
        values = np.array(parameters[f"vertex_{name}"]).reshape(-1, channels)
        np.testing.assert_array_equal(values, attribute(mesh, name, channels).astype(np.float32))


def test_template_is_closed_and_carries_the_msdf(exported):
    template = trimesh.load(exported.output / "template.ply", process=False)
    assert template.is_watertight and template.volume > 0
    msdf = attribute(template, "msdf", 1)[:, 0]
    np.testing.assert_allclose(msdf, 0.3 - template.vertices[:, 1], atol=1e-5)


def test_light(exported):
    stored = np.array(mi.Bitmap(str(exported.output / "light.exr")))
    np.testing.assert_allclose(stored, exported.radiance, rtol=1e-3)


def test_light_on_a_full_disk(exported, tmp_path):
    """Mitsuba's own error becomes the one that a fit turns into a sentence."""
    resource = pytest.importorskip("resource")
    (tmp_path / "light.exr").write_bytes(b"precious")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            write_light(tmp_path / "light.exr", exported.fit.light, EnvironmentLight(exported.radiance))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [path.name for path in tmp_path.iterdir()] == ["light.exr"]
    assert (tmp_path / "light.exr").read_bytes() == b"precious"


def test_scene_is_the_fitted_one(exported):
    """Stock Mitsuba sees from the first view what the fit's own scene shows there."""
    scene = mi.load_file(str(exported.output / "scene.xml"))
    assert [shape.class_name() for shape in scene.shapes()] == ["PLYMesh"]
    assert [sensor.id() for sensor in scene.sensors()] == [
        name for i in range(VIEWS) if (name := f"view_{i:03}") not in HELD_OUT
    ]
    sensor, first = scene.sensors()[0], exported.fit.sensors[0]
    assert sensor.id() == first.id() == "view_001"
    film = mi.Point2f([0.1, 0.5, 0.9], [0.3, 0.5, 0.8])
    ours, theirs = (s.sample_ray(0, 0.5, film, mi.Point2f(0.5))[0] for s in (sensor, first))
    np.testing.assert_allclose(np.array(ours.o), np.array(theirs.o), atol=1e-5)
    np.testing.assert_allclose(np.array(ours.d), np.array(theirs.d), atol=1e-5)
    integrator = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    here = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=64, seed=1))
    there = np.array(mi.render(exported.joint.scene, sensor=first, integrator=integrator, spp=64, seed=2))
    assert here.shape == there.shape == (SIZE, SIZE, 4)
    np.testing.assert_allclose(here.mean((0, 1)), there.mean((0, 1)), rtol=0.02)
    assert np.abs(here - there).mean() < 0.03


SENSORS = {
    "fov along y": {"type": "perspective", "fov": 50, "fov_axis": "y"},
    "principal point": {
        "type": "perspective",
        "fov": 35,
        "principal_point_offset_x": 0.1,
        "principal_point_offset_y": -0.2,
    },
    "thin lens": {"type": "thinlens", "fov": 35, "aperture_radius": 0.1, "focus_distance": 2.5},
}


@pytest.mark.parametrize("crop", [False, True])
@pytest.mark.parametrize("kind", SENSORS)
def test_any_perspective_sensor_survives(exported, tmp_path, kind, crop):
    film: dict = {"type": "hdrfilm", "width": 64, "height": 48, "rfilter": {"type": "box"}}
    if crop:
        film |= {"crop_width": 20, "crop_height": 12, "crop_offset_x": 30, "crop_offset_y": 9}
    to_world = mi.ScalarTransform4f().look_at([1, 2, 3], [0.1, 0, 0], [0, 1, 0])
    sensor = mi.load_dict(
        SENSORS[kind]
        | {"to_world": to_world, "film": film, "id": 'view "7" & <8>', "near_clip": 2e-6, "far_clip": 3e7}
    )
    for name in ("mesh.ply", "light.exr"):
        (tmp_path / name).write_bytes((exported.output / name).read_bytes())
    write_scene(tmp_path / "scene.xml", exported.fit.light, [sensor])
    (written,) = mi.load_file(str(tmp_path / "scene.xml")).sensors()
    assert written.id() == 'view "7" & <8>'
    assert (written.near_clip(), written.far_clip()) == pytest.approx((2e-6, 3e7))
    assert tuple(written.film().crop_size()) == tuple(sensor.film().crop_size())
    assert written.film().rfilter().class_name() == sensor.film().rfilter().class_name()
    at = mi.Point2f(np.random.default_rng(3).random((2, 50)).astype(np.float32))
    ours, theirs = (s.sample_ray(0, 0.5, at, mi.Point2f(0.1, 0.8))[0] for s in (written, sensor))
    np.testing.assert_allclose(np.array(ours.o), np.array(theirs.o), atol=1e-5)
    np.testing.assert_allclose(np.array(ours.d), np.array(theirs.d), atol=1e-5)


def look(emitter) -> np.ndarray:
    rng = np.random.default_rng(0)
    si = mi.SurfaceInteraction3f()
    direction = rng.normal(size=(3, 200))
    si.wi = -mi.Vector3f((direction / np.linalg.norm(direction, axis=0)).astype(np.float32))
    return np.broadcast_to(np.array(emitter.eval(si)), (3, 200))


@pytest.mark.parametrize(
    "light",
    [
        {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 1.0, 2.0]}},
        {"type": "envmap", "scale": 2.0, "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 70)},
    ],
    ids=["constant", "rotated map"],
)
@pytest.mark.parametrize("optimised", [False, True])
def test_light_survives(exported, tmp_path, light, optimised):
    if light["type"] == "envmap":
        light = light | {"bitmap": mi.Bitmap(exported.radiance.astype(np.float32))}
    emitter = mi.load_dict(light)
    found = EnvironmentLight.from_emitter(emitter, 8) if optimised else None
    if optimised and found is None:
        found = EnvironmentLight(exported.radiance)
        emitter = found.emitter()
    given = mi.load_dict(light)
    write_light(tmp_path / "light.exr", given, found)
    write_scene(tmp_path / "scene.xml", given, exported.fit.sensors)
    (tmp_path / "mesh.ply").write_bytes((exported.output / "mesh.ply").read_bytes())
    written = mi.load_file(str(tmp_path / "scene.xml")).environment()
    np.testing.assert_allclose(look(written), look(emitter), rtol=2e-3)


def test_ids_are_escaped(exported, tmp_path):
    """An id may hold what XML uses itself."""
    name = """<a & "b" 'c'>"""
    sensor = mi.load_dict({"type": "perspective", "id": name})
    for file in ("mesh.ply", "light.exr"):
        (tmp_path / file).write_bytes((exported.output / file).read_bytes())
    write_scene(tmp_path / "scene.xml", exported.fit.light, [sensor])
    assert ElementTree.parse(tmp_path / "scene.xml").find("sensor").get("id") == name
    assert mi.load_file(str(tmp_path / "scene.xml")).sensors()[0].id() == name


def test_the_mark_lists_what_was_written(exported):
    found = OwnFolder(exported.output, "fit")
    there = {
        path.relative_to(exported.output).as_posix() for path in exported.output.rglob("*") if path.is_file()
    }
    assert found.files == there - {MARK} >= {"mesh.ply", "scene.xml", "metrics.json", "views/view_001.png"}


def test_pictures_go_with_the_fit(exported, tmp_path):
    """All are files of the fit's, so another fit that has none of them removes them."""
    shutil.copytree(exported.output, tmp_path / "out")
    (tmp_path / "out" / "held_out" / "mine.txt").write_text("mine")
    OwnFolder(tmp_path / "out", "fit").clear()
    assert sorted(path.name for path in (tmp_path / "out").rglob("*")) == [MARK, "held_out", "mine.txt"]


def test_what_is_in_the_way_of_an_export_stays(exported, tmp_path):
    (tmp_path / "light.exr").write_text("precious")
    with pytest.raises(UserError, match=r"light.exr' is in the way"):
        export_fit(tmp_path, exported.fit, exported.joint.material, exported.joint.light, 1)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"light.exr": "precious"}


def test_views(exported):
    names = {path.name for path in (exported.output / "views").iterdir()}
    assert names == {f"{name}.png" for name in SHOWN}
    assert {path.stem for path in (exported.output / "held_out").iterdir()} == set(HELD_OUT)
    assert {path.stem for path in (exported.output / "masks").iterdir()} == {*SHOWN, *HELD_OUT}
    for name in ("views/view_001.png", "held_out/view_000.png"):
        assert np.array(Image.open(exported.output / name)).shape == (SIZE, 3 * SIZE, 3)


@pytest.mark.parametrize(("entry", "names"), [("training", SHOWN), ("held_out", HELD_OUT)])
def test_scores_are_those_of_the_pictures(exported, entry, names):
    scores = exported.metrics[entry]
    assert list(scores["views"]) == names
    folder = exported.output / ("views" if entry == "training" else entry)
    for name, found in scores["views"].items():
        assert set(found) == set(VIEW_SCORES)
        target, shown, _ = np.split(np.array(Image.open(folder / f"{name}.png")) / 255, 3, axis=1)
        assert found["psnr"] == pytest.approx(psnr(shown, target), abs=0.1)
        overlay = np.array(Image.open(exported.output / "masks" / f"{name}.png")) / 255
        both, *others = (
            np.isclose(overlay, color, atol=1 / 255).all(-1).sum() for color in (BOTH, MASK_ONLY, FIT_ONLY)
        )
        assert found["mask_iou"] == pytest.approx(both / (both + sum(others)), abs=1e-4)
    for score in VIEW_SCORES:
        mean = np.mean([found[score] for found in scores["views"].values()])
        assert scores["mean"][score] == pytest.approx(mean, abs=1e-4)


def test_corrected_cameras_are_scored_without_pictures(exported, tmp_path):
    views = exported.fit.held_out
    moved = [View(views[1].sensor, views[0].target), View(views[0].sensor, views[1].target)]
    pictures = {}
    for name, laid in (("given", ()), ("same", views), ("moved", moved)):
        output = tmp_path / name
        output.mkdir()
        found = export_fit(output, exported.fit, exported.joint.material, exported.joint.light, 1, laid=laid)
        pictures[name] = {path.name: path.read_bytes() for path in sorted(output.rglob("*.png"))}
        if name == "given":
            assert "held_out_laid" not in found
        else:
            assert (found["held_out_laid"] == found["held_out"]) == (name == "same")
    assert pictures["given"] == pictures["same"] == pictures["moved"]


def test_the_light_turns_with_held_out_cameras_too(exported, tmp_path, monkeypatch):
    """As seen from the first training view."""
    given = {}
    monkeypatch.setattr(
        fit_folder,
        "write_views",
        lambda output, folder, views, lights, _: (
            given.update(
                {view.sensor.id(): np.array(light.matrix) for view, light in zip(views, lights, strict=True)}
            )
            or {"views": {}, "mean": {"psnr": 0.0}}
        ),
    )
    many = 10**12  # of which there are not so many
    export_fit(tmp_path, exported.fit, exported.joint.material, exported.joint.light, many, light_turns=True)
    first = exported.fit.sensors[0]
    assert len(given) == VIEWS
    for view in (*exported.fit.training, *exported.fit.held_out):
        (_, turn) = turns_with_camera([first, view.sensor])
        expected = np.array(exported.joint.light.turned(turn).matrix)
        np.testing.assert_allclose(given[view.sensor.id()], expected, atol=1e-6)


def test_views_are_exposed_as_their_targets(exported, tmp_path):
    gains = np.ones((len(exported.fit.sensors), 3), np.float32)
    gains[0], gains[-1] = [0.25, 1, 1], 0.5
    last = exported.fit.sensors[-1].id()
    told = export_fit(tmp_path, exported.fit, exported.joint.material, exported.joint.light, 2, gains=gains)
    assert told["exposures"]["gains"][exported.fit.sensors[0].id()] == [0.25, 1, 1]
    assert told["exposures"]["stops"][last] == -1 and list(told["exposures"]["stops"].values()).count(0) > 1
    before, after = (
        np.array(Image.open(folder / "views" / "view_001.png"))[:, SIZE : 2 * SIZE].astype(int)
        for folder in (exported.output, tmp_path)
    )
    object_ = before.min(axis=-1) < 250
    assert (after[object_, 0] < 0.8 * before[object_, 0]).mean() > 0.8
    assert np.abs(after[..., 1:] - before[..., 1:]).mean() < 5
    assert "exposures" not in exported.metrics


def test_metrics(exported, mesh):
    stored = json.loads((exported.output / "metrics.json").read_text())
    assert stored == exported.metrics
    counts = stored["counts"]
    assert (counts["vertices"], counts["faces"]) == (len(mesh.vertices), len(mesh.faces))
    assert (counts["boundary_loops"], counts["components"], counts["nonmanifold_edges"]) == (1, 1, 0)
    assert stored["seconds"] == {"hull": 1.5, "joint": 2.0, "total": 3.5}
    assert stored["psnr_training"] == stored["training"]["mean"]["psnr"]
    assert stored["variant"] == mi.variant()


def test_mesh_round_trip(exported, mesh, tmp_path):
    read = read_ply(exported.output / "mesh.ply")
    np.testing.assert_array_equal(read.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    assert {name: values.shape[1:] for name, values in read.attributes.items()} == {
        "color": (3,),
        "roughness": (),
        "metallic": (),
    }
    write_ply(tmp_path / "again.ply", read.vertices, read.faces, read.normals, read.attributes)
    again = read_ply(tmp_path / "again.ply")
    np.testing.assert_array_equal(again.attributes["color"], read.attributes["color"])
    np.testing.assert_array_equal(again.normals, read.normals)


def test_missing_and_broken_mesh(tmp_path):
    with pytest.raises(UserError, match="does not exist; give the folder of a finished fit"):
        read_ply(tmp_path / "mesh.ply")
    (tmp_path / "mesh.ply").write_text("ply\nnonsense")
    with pytest.raises(UserError, match="cannot be read as a fitted mesh"):
        read_ply(tmp_path / "mesh.ply")


@pytest.mark.parametrize("channels", [2, 4])
def test_a_mesh_with_another_number_of_channels(tmp_path, channels):
    """As one byte of a name in its header makes them."""
    square, up = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.tile([0, 0, 1], (3, 1))
    write_ply(tmp_path / "mesh.ply", square, np.array([[0, 1, 2]]), up, {"color": np.zeros((3, channels))})
    with pytest.raises(UserError, match=r"its color has neither one channel nor three.*run the fit again"):
        read_ply(tmp_path / "mesh.ply")


def test_empty_mesh(tmp_path):
    attributes = {"vertex_color": np.zeros((0, 3)), "vertex_roughness": np.zeros(0)}
    write_ply(tmp_path / "mesh.ply", np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3)), attributes)
    header = (tmp_path / "mesh.ply").read_text()
    assert "element vertex 0\n" in header and "element face 0\n" in header and header.endswith("end_header\n")


@pytest.mark.parametrize("axis, up", list(enumerate(np.concatenate([np.eye(3), -np.eye(3)]))))
def test_up_axis(axis, up):
    # One view from above tells nothing about the others' up.
    rng = np.random.default_rng(axis)
    sensors = [
        mi.load_dict(
            {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at(
                    list(rng.normal(size=3) + 2 * up), [0, 0, 0], list(up)
                ),
            }
        )
        for _ in range(12)
    ]
    assert up_axis(sensors) == axis
