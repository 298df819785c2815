"""The optimised environment map against stock Mitsuba's."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.compat import environment_data
from gshell_mi.light import MINIMUM_RADIANCE, EnvironmentLight


@pytest.fixture
def radiance() -> np.ndarray:
    return np.random.default_rng(4).uniform(0.1, 5, (6, 12, 3)).astype(np.float32)


@pytest.fixture
def stock(radiance) -> mi.Emitter:
    return mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(radiance)})


def look(emitter) -> mi.Color3f:
    """What the emitter sends from directions all around, many of them at the seam and the poles."""
    turn, tilt = np.meshgrid(np.linspace(0, 2 * np.pi, 73), np.linspace(0.001, np.pi - 0.001, 31))
    si = dr.zeros(mi.SurfaceInteraction3f, turn.size)
    direction = [np.sin(tilt) * np.sin(turn), np.cos(tilt), -np.sin(tilt) * np.cos(turn)]
    si.wi = -mi.Vector3f(np.stack([d.ravel() for d in direction]))
    return emitter.eval(si)


def test_environment_data_wraps_around(radiance, stock):
    data = np.array(environment_data(mi.TensorXf(radiance)))
    assert data.shape == (6, 14, 3)
    np.testing.assert_array_equal(data[:, 1:-1], radiance)
    np.testing.assert_array_equal(data[:, 0], radiance[:, -1])
    np.testing.assert_array_equal(data[:, -1], radiance[:, 0])
    np.testing.assert_allclose(np.array(mi.traverse(stock)["data"])[..., :3], data, rtol=1e-6)


def test_round_trip(radiance):
    light = EnvironmentLight(radiance)
    assert light.log_radiance.shape == radiance.shape
    np.testing.assert_allclose(np.array(light.radiance), radiance, rtol=1e-6)


def test_darkness_has_a_logarithm():
    light = EnvironmentLight(np.zeros((2, 4, 3)))
    np.testing.assert_allclose(np.array(light.radiance), MINIMUM_RADIANCE, rtol=1e-5)


def test_uniform():
    light = EnvironmentLight.uniform(5, 0.7)
    assert light.radiance.shape == (5, 10, 3)
    np.testing.assert_allclose(np.array(light.radiance), 0.7, rtol=1e-6)


def test_the_emitter_shines_like_a_stock_one(radiance, stock):
    emitter = EnvironmentLight(radiance).emitter()
    assert emitter.id() == "light"
    np.testing.assert_allclose(np.array(look(emitter)), np.array(look(stock)), rtol=1e-4)


def test_from_an_emitter(radiance, stock):
    """A rotated and scaled map starts as it is; a constant says nothing of the light."""
    rotated = mi.load_dict(
        {
            "type": "envmap",
            "bitmap": mi.Bitmap(radiance),
            "scale": 2.0,
            "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 70),
        }
    )
    light = EnvironmentLight.from_emitter(rotated, height=6)
    np.testing.assert_allclose(np.array(light.radiance), 2 * radiance, rtol=1e-5)
    np.testing.assert_allclose(np.array(look(light.emitter())), np.array(look(rotated)), rtol=1e-4)
    assert EnvironmentLight.from_emitter(mi.load_dict({"type": "constant"}), height=6) is None


def test_from_an_emitter_of_another_size():
    ramp = np.broadcast_to(np.linspace(1, 2, 64)[:, None, None], (64, 128, 3)).astype(np.float32)
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(ramp))})
    radiance = np.array(EnvironmentLight.from_emitter(emitter, height=8).radiance)
    assert radiance.shape == (8, 16, 3)
    expected = np.broadcast_to(ramp[:, 0, 0].reshape(8, 8).mean(1)[:, None], (8, 16))
    np.testing.assert_allclose(radiance[1:-1, :, 0], expected[1:-1], rtol=0.01)


@pytest.mark.parametrize("column", [0, 31, 64, 127])
def test_a_small_sun_keeps_its_energy(column):
    """Also at the seam."""
    sky = np.full((64, 128, 3), 0.1, np.float32)
    sky[20, column] = 1000
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(sky)})
    light = EnvironmentLight.from_emitter(emitter, height=16)
    assert np.array(light.radiance).mean() == pytest.approx(sky.mean(), rel=1e-3)


def test_and_so_it_does_after_an_update(radiance, stock):
    scene = mi.load_dict({"type": "scene", "light": EnvironmentLight.uniform(6, 1.0).emitter()})
    parameters = mi.traverse(scene)
    EnvironmentLight(radiance).update(parameters)
    parameters.update()
    np.testing.assert_allclose(np.array(look(scene.environment())), np.array(look(stock)), rtol=1e-4)
    # Importance sampling follows, too.
    reference = mi.load_dict({"type": "scene", "light": stock})
    it = dr.zeros(mi.Interaction3f, 64)
    random = mi.Point2f(np.random.default_rng(0).random((2, 64)).astype(np.float32))
    ours, theirs = (s.sample_emitter_direction(it, random)[0] for s in (scene, reference))
    np.testing.assert_allclose(np.array(ours.d), np.array(theirs.d), atol=1e-4)


def test_derivatives_reach_the_logarithm(radiance):
    """One more in every logarithm is a factor e: the gradient's sum is the sum of what is seen."""
    light = EnvironmentLight(radiance)
    scene = mi.load_dict({"type": "scene", "light": light.emitter()})
    parameters = mi.traverse(scene)
    dr.enable_grad(light.log_radiance)
    light.update(parameters)
    parameters.update()
    seen = look(scene.environment())
    total = dr.sum(dr.ravel(seen))
    dr.backward(total)
    gradient = np.array(dr.grad(light.log_radiance))
    assert gradient.sum(dtype=np.float64) == pytest.approx(total[0], rel=1e-3)
    assert gradient.min() > 0, "every texel is seen"


def test_solid_angles_of_texels():
    height = 64
    angles = EnvironmentLight.uniform(height, 1.0).solid_angles.numpy()
    assert angles.shape == (height, 1, 1)
    assert angles.sum() * 2 * height * (np.pi / height) ** 2 == pytest.approx(4 * np.pi, rel=1e-3)
    assert angles[height // 2, 0, 0] == pytest.approx(1, abs=1e-3)
