"""The radiance volume: closed forms, its adjoint, and a run that goes on where another one stopped."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cup import CONFIG, capture, hull_of

from gshell_mi.fit.bookkeeping.checkpoint import optimizer_arrays, restore_optimizer
from gshell_mi.fit.carving import density_grid
from gshell_mi.fit.carving.density_grid import DensityGrid


@pytest.fixture(scope="module")
def seen():
    return capture()


def make(seen, first=0):
    views, pixels, _ = seen
    hull, vertices, faces = hull_of(32)
    return DensityGrid(hull, vertices, faces, mi.ScalarTransform4f(), views, pixels, CONFIG.cavities, first)


def march(volume, rays, **options):
    return volume._march(rays, 5, **options)


def test_no_ray_meets_the_hull(seen):
    views, pixels, _ = seen
    hull, vertices, faces = hull_of(32)
    volume = DensityGrid(hull, vertices + 50, faces, mi.ScalarTransform4f(), views, pixels, CONFIG.cavities)
    before = volume.opacity()
    assert np.isfinite(list(volume.step(0).values())).all()
    np.testing.assert_array_equal(volume.opacity(), before)
    assert not volume.seen().any()


def test_even_fog_absorbs_exponentially(seen):
    volume = make(seen)
    rays, _, _ = volume._rays(0)
    origin = mi.Point3f(0, 0, -0.3)
    rays = origin, mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(0.6)
    radiance, transmittance = march(volume, rays)
    depth = np.log1p(np.exp(density_grid._FOG))  # of a cell
    steps = np.ceil(0.6 / (0.5 * 2 / volume.resolution))
    assert transmittance[0] == pytest.approx(np.exp(-0.5 * steps * depth), rel=1e-3)
    assert radiance.x[0] == pytest.approx(volume.mean_radiance * (1 - transmittance[0]), rel=1e-3)


def test_replay_gives_the_derivative(seen):
    """By the density and the radiance, along a random direction, against finite differences."""
    volume = make(seen)
    rays, _, _ = volume._rays(3)
    optimizer = volume.optimizers["volume"]
    generator = np.random.default_rng(0)
    radiance, transmittance = march(volume, rays)
    by_radiance = mi.Color3f(generator.normal(size=(3, dr.width(transmittance))))
    by_transmittance = mi.Float(generator.normal(size=dr.width(transmittance)))
    gradient = dr.unravel(
        mi.Vector4f, march(volume, rays, adjoint=(radiance, transmittance, by_radiance, by_transmittance))
    )
    inside = volume._allowed.numpy()
    base = {name: optimizer[name].numpy().astype(np.float64) for name in ("density", "radiance")}
    slope = inside / (1 + np.exp(-base["density"]))
    towards = {name: 1 + generator.uniform(size=len(value)) for name, value in base.items()}
    expected = (slope * towards["density"] * gradient.w.numpy()).sum() + (
        towards["radiance"].reshape(-1, 3) * gradient.numpy()[:3].T
    ).sum()

    def loss(t):
        for name, value in base.items():
            optimizer[name] = mi.Float((value + t * towards[name]).astype(np.float32))
        radiance, transmittance = march(volume, rays)
        return (radiance.numpy().astype(np.float64) * by_radiance.numpy()).sum() + (
            transmittance.numpy().astype(np.float64) * by_transmittance.numpy()
        ).sum()

    step = 0.01
    assert expected == pytest.approx((loss(step) - loss(-step)) / (2 * step), rel=0.02)


def test_a_resumed_run_takes_the_same_steps(seen):
    whole = make(seen)
    values = [whole.step(i) for i in range(CONFIG.cavities.iterations)]
    for stop in (3, whole.coarse_steps, whole.coarse_steps + 4):
        first = make(seen)
        for i in range(stop):
            first.step(i)
        arrays = optimizer_arrays("volume", first.optimizers["volume"])
        second = make(seen, stop)
        restore_optimizer("volume", second.optimizers["volume"], arrays)
        assert second.step(stop)["image"] == pytest.approx(values[stop]["image"], rel=1e-4)


def test_it_thins_in_the_cup_and_not_in_its_walls(seen):
    volume = make(seen)
    losses = [volume.step(i)["loss"] for i in range(CONFIG.cavities.iterations)]
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])
    opacity, visible = volume.opacity(), volume.seen()
    within, bottom = (16, 21, 16), (16, 15, 16)
    assert opacity[within] < 0.2 < 0.5 < opacity[bottom]
    assert visible[within] > 0.03 and visible[16, 10, 16] < 0.03
