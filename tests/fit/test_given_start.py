"""A fit that starts from what its scene gives: fields, material and light."""

import mitsuba as mi
import numpy as np
import pytest
from bowl import SHORT, write_fit_scene

from gshell_mi import TetLattice, make_lattice
from gshell_mi.fields import LatticeFields
from gshell_mi.fit.__main__ import main
from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint
from gshell_mi.fit.stages.hull import Given
from gshell_mi.light import EnvironmentLight
from gshell_mi.material import given_material

RESOLUTION = 12


def _cut_sphere() -> LatticeFields:
    points = TetLattice(RESOLUTION).vertex_positions()
    sdf = np.linalg.norm(points, axis=1) - 0.6
    return LatticeFields(sdf, (0.05 - points[:, 1]).astype(np.float32), np.zeros(3 * len(sdf), np.float32))


@pytest.mark.parametrize("grid", [None, "bcc"])
def test_fields_of_the_scene_are_the_start(grid, tmp_path):
    """On the lattice that they are given on, or interpolated on another."""
    path = write_fit_scene(tmp_path)
    _cut_sphere().save(tmp_path / "start.npz")
    xml = path.read_text()
    shape = xml[xml.index("<shape") : xml.index("</shape>")]
    given = (
        '<shape type="gshell" id="subject"> <string name="filename" value="start.npz"/>'
        '<bsdf type="principled"> <float name="roughness" value="0.3"/>'
        '<rgb name="base_color" value="0.2, 0.4, 0.6"/> </bsdf>'
    )
    path.write_text(xml.replace(shape, given))
    output = tmp_path / "out"
    arguments = [str(path), "-o", str(output), "--quiet", *SHORT]
    arguments[arguments.index("--iterations") + 1] = "0"
    assert main(arguments + (["--grid", grid] if grid else [])) == 0
    lattice = make_lattice(grid or "tet", RESOLUTION)
    assert Checkpoint.load(output / "checkpoint.npz").arrays["sdf"].size == lattice.vertex_count
    mesh = mi.load_dict({"type": "ply", "filename": str(output / "mesh.ply")})
    parameters = mi.traverse(mesh)
    positions = np.array(parameters["vertex_positions"]).reshape(-1, 3)
    # Chords of a sphere with cells of 1/6: at most cell^2 / 2 r inside it.
    assert np.linalg.norm(positions, axis=1).max() < 0.6 + 1e-4
    assert abs(positions[:, 1].max() - 0.05) < 0.02
    np.testing.assert_allclose(np.array(parameters["vertex_roughness"]), 0.3, atol=1e-3)
    np.testing.assert_allclose(
        np.array(parameters["vertex_color"]).reshape(-1, 3),
        np.broadcast_to([0.2, 0.4, 0.6], (len(positions), 3)),
        atol=1e-3,
    )


def test_fields_in_blocks_are_a_start(tmp_path):
    subject = mi.load_dict({"type": "gshell", "resolution": RESOLUTION})
    points = subject.lattice.vertex_positions()
    fine = make_lattice("tet", 4 * RESOLUTION)
    sdf = np.linalg.norm(fine.vertex_positions(), axis=1) - 0.6
    found = Given._on(TetLattice(RESOLUTION), LatticeFields.closed(sdf).in_blocks())
    near = np.abs(np.linalg.norm(points, axis=1) - 0.6) < 0.1
    np.testing.assert_allclose(found.sdf[near], np.linalg.norm(points[near], axis=1) - 0.6, atol=0.01)


def test_only_a_principled_bsdf_gives_a_material():
    assert given_material(mi.load_dict({"type": "diffuse"})) == {}
    nested = {
        "type": "principled",
        "roughness": 0.25,
        "metallic": 0.75,
        "base_color": {"type": "rgb", "value": [0.1, 0.2, 0.3]},
    }
    found = given_material(mi.load_dict({"type": "twosided", "nested": nested}))
    assert (found["roughness"], found["metallic"]) == (0.25, 0.75)
    np.testing.assert_allclose(found["base_color"], [0.1, 0.2, 0.3], atol=1e-6)


def test_an_environment_map_keeps_its_radiance_and_rotation():
    columns = np.linspace(0.5, 1.5, 32, dtype=np.float32)
    image = np.broadcast_to(columns[None, :, None], (16, 32, 3)).copy()
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 90)
    given = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(image), "to_world": turned})
    light = EnvironmentLight.from_emitter(given, 16)
    np.testing.assert_allclose(np.array(light.radiance), image, rtol=1e-3)
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f([-0.6, 0.3, 0.1], [0.1, -0.4, 0.2], [0.8, 0.5, -0.9])
    si.wi = si.wi / np.sqrt(np.array(si.wi.x) ** 2 + np.array(si.wi.y) ** 2 + np.array(si.wi.z) ** 2)
    np.testing.assert_allclose(np.array(light.emitter().eval(si)), np.array(given.eval(si)), rtol=2e-3)


def test_a_constant_light_says_nothing():
    assert EnvironmentLight.from_emitter(mi.load_dict({"type": "constant"}), 8) is None
