"""Light and material that are both sought: shading goes into the light and is not painted on."""

from dataclasses import replace
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bowl import RADIUS, sensors_xml

from gshell_mi.fields import sphere
from gshell_mi.fit import FitConfig
from gshell_mi.fit.joint.joint import JointStage
from gshell_mi.fit.stages.joint import start_light, start_material
from gshell_mi.fit.surface import TYPICAL_REFLECTANCE, Seen, Surface
from gshell_mi.lattice import TetLattice
from gshell_mi.scene import load_fit_scene

LATTICE = TetLattice(12)
SUN = np.array([0.6, 0.64, 0.48])
CONFIG = FitConfig(iterations=60).changed(
    {
        "lattice.band_resolution": 99,
        "joint.warmup": 1.0,
        "render.spp": 4,
        "render.primal_spp": 4,
        "render.max_depth": 2,
        "model.light_height": 8,
    }
)


def directions(height: int) -> np.ndarray:
    """(height, 2 height, 3) directions of an envmap's texels."""
    polar, turn = np.meshgrid(
        (np.arange(height) + 0.5) * np.pi / height,
        (np.arange(2 * height) + 0.5) * np.pi / height,
        indexing="ij",
    )
    return np.stack([np.sin(polar) * np.sin(turn), np.cos(polar), -np.sin(polar) * np.cos(turn)], axis=-1)


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    """A grey ball in the sun, seen by 12 small views."""
    folder = tmp_path_factory.mktemp("ball")
    sensors = "\n".join(sensors_xml())
    sky = np.where(directions(16) @ SUN > np.cos(0.2), 25.0, 0.3)
    light = mi.Bitmap(np.repeat(sky[..., None], 3, axis=2).astype(np.float32))
    light.write(str(folder / "sky.exr"))
    (folder / "reference.xml").write_text(f"""\
<scene version="3.0.0">
    <shape type="sphere"> <float name="radius" value="{RADIUS}"/> <bsdf type="diffuse"/> </shape>
    <emitter type="envmap"> <string name="filename" value="sky.exr"/> </emitter>
{sensors}
</scene>""")
    (folder / "ball.xml").write_text(f"""\
<scene version="3.0.0">
    <shape type="gshell" id="subject"> <integer name="resolution" value="{LATTICE.resolution}"/> </shape>
    <emitter type="constant" id="light"/>
{sensors}
</scene>""")
    truth = mi.load_file(str(folder / "reference.xml"))
    path = mi.load_dict({"type": "path", "hide_emitters": True})
    (folder / "ball").mkdir()
    for sensor in truth.sensors():
        mi.util.write_bitmap(
            str(folder / "ball" / f"{sensor.id()}.exr"),
            mi.render(truth, sensor=sensor, integrator=path, spp=256),
            write_async=False,
        )
    return load_fit_scene(folder / "ball.xml")


@pytest.fixture
def seen() -> Surface:
    """What earlier stages have left of a ball that is lit from the sun's side."""
    points = LATTICE.vertex_positions()
    lit = 0.1 + np.maximum(points @ SUN, 0) / np.linalg.norm(points + 1e-9, axis=1)
    light = np.float32(np.median(lit) / TYPICAL_REFLECTANCE)
    return Surface(
        sphere(LATTICE, RADIUS),
        seen=Seen(np.repeat(lit[:, None], 3, axis=1), np.full(len(points), True), light),
    )


def start(fit, seen, config: FitConfig) -> JointStage:
    fit.subject.set_fields(sphere(LATTICE, RADIUS))
    return JointStage(fit, start_material(fit, seen, LATTICE, config), start_light(fit, seen, config), config)


def test_it_starts_with_one_colour(fit, seen):
    color = start_material(fit, seen, LATTICE, CONFIG).values()["vertex_color"].numpy().reshape(-1, 3)
    np.testing.assert_allclose(color, TYPICAL_REFLECTANCE, rtol=1e-4)


@pytest.mark.parametrize("settings", [{"model.even_start": False}, {"known_light": True}])
def test_or_with_what_was_seen(fit, seen, settings):
    config = CONFIG.changed(settings)
    color = start_material(fit, seen, LATTICE, config).values()["vertex_color"].numpy().reshape(-1, 3)
    np.testing.assert_allclose(color, np.clip(seen.seen.radiance / seen.seen.light, 0.02, 0.98), rtol=1e-4)


def test_the_light_moves_first(fit, seen):
    joint = start(fit, seen, CONFIG.changed({"iterations": 10, "joint.color_hold": 0.8}))
    sought = (
        (joint.material_optimizer, "vertex_color"),
        (joint.material_optimizer, "vertex_roughness"),
        (joint.light_optimizer, "log_radiance"),
    )
    values = [[optimizer[name].numpy() for optimizer, name in sought]]
    for iteration in range(8):
        joint.step(iteration)
        values.append([optimizer[name].numpy() for optimizer, name in sought])
    color, roughness, light = (
        [np.abs(after[i] - before[i]).max() for before, after in pairwise(values)] for i in range(3)
    )
    assert color[0] == 0 and light[0] == pytest.approx(CONFIG.joint.light_lr, rel=1e-3)
    assert color[7] > 5 * color[1]
    assert roughness[0] == pytest.approx(CONFIG.joint.material_lr, rel=1e-3)


def test_a_colour_that_is_no_number_stays_alone(fit, seen):
    """Derivatives that it spoils, as slivers do, go no farther; the optimisers would never be rid of them."""
    joint = start(fit, seen, CONFIG.changed({"joint.warmup": 0.0, "joint.color_hold": 0.0}))
    before = joint.light_optimizer["log_radiance"].numpy()
    color = joint.material_optimizer["vertex_color"].numpy().reshape(-1, 3)
    points = LATTICE.vertex_positions()
    spoiled = np.argmin(np.abs(np.linalg.norm(points, axis=1) - RADIUS) - 0.1 * (points @ SUN))
    color[spoiled] = np.nan
    joint.material_optimizer["vertex_color"] = mi.Float(color.ravel())
    for iteration in range(2):
        joint.step(iteration)
    for optimizer in joint.optimizers.values():
        for name in optimizer.keys():
            lost = ~np.isfinite(optimizer[name].numpy())
            assert lost.sum() == (3 if name == "vertex_color" else 0), name
    assert np.abs(joint.light_optimizer["log_radiance"].numpy() - before).max() > 0.1


def test_a_material_under_a_given_light_need_not_wait(fit, seen):
    joint = start(fit, seen, replace(CONFIG, known_light=True))
    before = joint.material_optimizer["vertex_color"].numpy()
    joint.step(0)
    after = joint.material_optimizer["vertex_color"].numpy()
    assert np.abs(after - before).max() > 0.5 * CONFIG.joint.material_lr


def test_the_sun_is_found_and_not_painted(fit, seen):
    joint = start(fit, seen, CONFIG)
    for iteration in range(CONFIG.iterations):
        joint.step(iteration)
    with dr.suspend_grad():
        color = joint.subject.surface.interpolate(joint.material.values()["vertex_color"], 3).numpy()
    assert color.std() / color.mean() < 0.15
    radiance = joint.light.radiance.numpy().mean(axis=2)
    toward = directions(CONFIG.model.light_height)
    brightest = toward.reshape(-1, 3)[radiance.argmax()]
    assert np.degrees(np.arccos(brightest @ SUN)) < 25
    solid_angles = np.broadcast_to(joint.light.solid_angles.numpy()[..., 0], radiance.shape)
    around = toward @ SUN > np.cos(0.5)
    mean = np.average(radiance, weights=solid_angles)
    assert np.average(radiance[around], weights=solid_angles[around]) > 3 * mean
