"""What a fit takes as given stays as it was given; what is left is still found."""

import json
import shutil
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from bowl import CLOSED, RADIUS, SHORT, half_sphere
from topology import assert_manifold

from gshell_mi.compat import triangle_mesh
from gshell_mi.fields import LatticeFields
from gshell_mi.fit.__main__ import main
from gshell_mi.fit.joint.joint import JointStage
from gshell_mi.fit.surface import Surface
from gshell_mi.lattice import TetLattice
from gshell_mi.scene import load_fit_scene

#: The start of the geometry in these tests: a sphere that is too small.
SMALL = 0.94 * RADIUS
MATERIAL = (
    '<bsdf type="principled"> <rgb name="base_color" value="0.3, 0.2, 0.1"/>'
    '<float name="roughness" value="0.7"/> <float name="metallic" value="0.0"/> </bsdf>'
)


def fit(scene: Path, output: Path, *arguments: str) -> dict:
    """The metrics of a short fit."""
    assert main([str(scene), "-o", str(output), "--quiet", *SHORT, *arguments]) == 0
    return json.loads((output / "metrics.json").read_text())


@pytest.fixture
def scene(bowl_scene, tmp_path) -> Path:
    """A copy of the bowl's scene whose subject is of a known material."""
    shutil.copytree(bowl_scene.parent, tmp_path / "in")
    path = tmp_path / "in" / bowl_scene.name
    path.write_text(path.read_text().replace("</shape>", MATERIAL + "</shape>"))
    return path


def start_from_sphere(scene: Path, radius: float) -> None:
    """Gives the subject a sphere cut open at y = 0, as its initial fields."""
    points = TetLattice(20).vertex_positions()
    sdf = (np.linalg.norm(points, axis=1) - radius).astype(np.float32)
    LatticeFields(sdf, -points[:, 1], np.zeros(3 * len(sdf), np.float32)).save(scene.parent / "start.npz")
    scene.write_text(
        scene.read_text().replace(
            '<integer name="resolution" value="20"/>', '<string name="filename" value="start.npz"/>'
        )
    )


def render_targets_with_the_given_material(scene: Path) -> None:
    """Instead of the bowl's print, which no uniform material explains."""
    fit = load_fit_scene(scene)
    truth = half_sphere()
    mesh = triangle_mesh("truth", np.asarray(truth.vertices), np.asarray(truth.faces))
    mesh.set_bsdf(mi.load_dict({"type": "twosided", "bsdf": fit.bsdf}))
    reference = mi.load_dict({"type": "scene", "truth": mesh, "light": {"type": "constant"}})
    integrator = mi.load_dict({"type": "path", "hide_emitters": True})
    for target, sensor in zip(fit.targets, fit.sensors, strict=True):
        image = mi.render(reference, sensor=sensor, integrator=integrator, spp=64)
        mi.Bitmap(image).write(str(target.path))


def material(output: Path) -> dict[str, np.ndarray]:
    mesh = trimesh.load(output / "mesh.ply", process=False)
    data = mesh.metadata["_ply_raw"]["vertex"]["data"]
    return {name: data[name] for name in data.dtype.names if name.endswith(("_0", "_1", "_2"))}


def test_fixed_material(scene, tmp_path):
    """Exactly what was given, at every vertex, and a light that moved."""
    fit(scene, tmp_path / "out", *CLOSED, "--fixed-material", "--iterations", "3")
    found = material(tmp_path / "out")
    expected = {"color_0": 0.3, "color_1": 0.2, "color_2": 0.1, "roughness_0": 0.7, "metallic_0": 0.0}
    assert set(found) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, atol=1e-6)
    light = np.array(mi.Bitmap(str(tmp_path / "out" / "light.exr")))
    assert np.ptp(light) > 0.01


def test_geometry_only(scene, tmp_path):
    """A bowl that is too small grows, under the given light and material; no mask tells it to."""
    render_targets_with_the_given_material(scene)
    start_from_sphere(scene, SMALL)
    metrics = fit(
        scene, tmp_path / "out", "--geometry-only", "--iterations", "30", "--joint.geometry-lr", "0.4"
    )
    light = np.array(mi.Bitmap(str(tmp_path / "out" / "light.exr")))
    np.testing.assert_allclose(light, 1, rtol=1e-3)
    np.testing.assert_allclose(material(tmp_path / "out")["color_0"], 0.3, atol=1e-6)
    steps = list(map(json.loads, (tmp_path / "out" / "log.jsonl").read_text().splitlines()))
    assert len(steps) == 30 and all(step["mask"] == 0 for step in steps)
    radius = np.linalg.norm(trimesh.load(tmp_path / "out" / "mesh.ply", process=False).vertices, axis=1)
    assert abs(np.median(radius) - RADIUS) < 0.7 * (RADIUS - SMALL)
    assert metrics["counts"]["boundary_loops"] == 1


def test_geometry_only_shades_faces_flat(scene):
    from gshell_mi.fit import FitConfig
    from gshell_mi.fit.joint.joint import JointStage
    from gshell_mi.fit.stages.joint import start_light, start_material
    from gshell_mi.fit.surface import Seen, Surface

    loaded = load_fit_scene(scene)
    count = loaded.subject.lattice.vertex_count
    surface = Surface(loaded.subject.fields(), seen=Seen(np.zeros((count, 3)), np.zeros(count, bool), 1.0))
    config = FitConfig(geometry_only=True)
    assert start_light(loaded, surface, config) is None
    joint = JointStage(loaded, start_material(loaded, surface, loaded.subject.lattice, config), None, config)
    hit = joint.scene.ray_intersect(mi.Ray3f(mi.Point3f([0.1, 0.2], [0.05, 0.1], 3), mi.Vector3f(0, 0, -1)))
    np.testing.assert_allclose(np.array(hit.sh_frame.n), np.array(hit.n), atol=1e-6)


def test_watertight(scene, tmp_path):
    """The open bowl, told to be closed: no openings, no boundary, and it is as closed as its template."""
    output = tmp_path / "out"
    metrics = fit(scene, output, "--watertight", "--iterations", "4", "--poses", "keep")
    assert metrics["counts"]["boundary_loops"] == metrics["counts"]["pinholes"] == 0
    found = trimesh.load(output / "mesh.ply", process=False)
    assert found.is_watertight
    assert_manifold(found.vertices, found.faces)
    template = trimesh.load(output / "template.ply", process=False)
    np.testing.assert_array_equal(template.vertices, found.vertices)
    assert template.metadata["_ply_raw"]["vertex"]["data"]["msdf_0"].min() > 0
    stages = {json.loads(line)["stage"] for line in (output / "log.jsonl").read_text().splitlines()}
    assert stages == {"cavities", "refinement", "joint"}


def test_watertight_closes_given_openings(scene, tmp_path):
    start_from_sphere(scene, RADIUS)
    metrics = fit(
        scene, tmp_path / "out", "--watertight", "--iterations", "0", "--refinement.iterations", "0"
    )
    assert metrics["counts"]["boundary_loops"] == 0


@pytest.mark.parametrize("weights", [False, True])
def test_all_modes_at_once_resume(scene, tmp_path, weights, monkeypatch):
    """Nothing but sdf, deform and, if asked for, weights is optimised; a checkpoint knows how to go on."""
    output = tmp_path / "out"
    modes = (
        "--watertight",
        "--known-light",
        "--fixed-material",
        "--refinement.iterations",
        "0",
        *["--model.field", "flexicubes"] * weights,
        "--iterations",
        "2",
    )
    command = [str(scene), "-o", str(output), "--quiet", *SHORT, *modes]
    with monkeypatch.context() as patch:
        patch.setattr(JointStage, "finish", _interrupt)
        assert main(command) == 130
    stored = np.load(output / "checkpoint.npz")
    optimised = {"sdf", "deform", "weights"} if weights else {"sdf", "deform"}
    assert {name.split("/")[2] for name in stored.files if name.count("/") > 1} == optimised
    fit(scene, output, *modes, "--resume")
    end = Surface.from_arrays(np.load(output / "checkpoint.npz"))
    assert (end.fields.weights is not None) == weights and not end.model


def _interrupt(self):
    raise KeyboardInterrupt
