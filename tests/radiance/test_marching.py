"""Rays through a volume: closed forms, and derivatives by replay against finite differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.bricks import Bricks
from gshell_mi.radiance.marching import Adjoint, Rays, composite, depth_along

_SIDE = 16


def _rays(bricks: Bricks, count: int = 64) -> Rays:
    random = mi.PCG32(size=count)
    origin = mi.Point3f(random.next_float32() - 0.5, random.next_float32() - 0.5, -3)
    target = mi.Point3f(random.next_float32() - 0.5, random.next_float32() - 0.5, 0)
    return Rays.through(bricks, mi.Ray3f(origin, target - origin), jitter=3)


def _packets(bricks: Bricks, width: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    packets = rng.uniform(0.2, 1.0, (bricks.voxel_count, width, 4)).astype(np.float32)
    packets[:, 1:] *= 0.1
    packets[:, 0, 3] *= 0.4
    return packets


def test_even_fog_dims_by_its_depth():
    bricks = Bricks.where(np.ones((_SIDE // 4,) * 3, bool))
    packets = np.tile(np.float32([0.5, 0.25, 1.0, 0.05]), bricks.voxel_count)
    ray = mi.Ray3f(mi.Point3f(0, 0, -3), mi.Vector3f(0, 0, 1))
    seen = composite(bricks, mi.Float(packets), Rays.through(bricks, ray), 0)
    expected = np.exp(-0.05 * _SIDE)
    assert np.isclose(seen.transmittance[0], expected, rtol=0.03)
    assert np.allclose(seen.radiance.numpy()[:, 0], np.array([0.5, 0.25, 1.0]) * (1 - expected), rtol=0.03)


def test_depth_is_where_half_of_the_light_is_blocked():
    live = np.zeros((_SIDE // 4,) * 3, bool)
    live[2] = True  # z from 0 to 0.5
    bricks = Bricks.where(live)
    packets = np.zeros((bricks.voxel_count, 4), np.float32)
    packets[bricks.centres().z.numpy() > 0.25, 3] = 50
    ray = mi.Ray3f(mi.Point3f([0.1, 3.0], 0.2, -2), mi.Vector3f(0, 0, 2))
    depth = depth_along(bricks, mi.Float(packets.ravel()), Rays.through(bricks, ray)).numpy()
    voxel = 2 / _SIDE
    assert abs(depth[0] - 2.25) < voxel  # the opaque voxels begin there
    assert depth[1] == np.inf  # a ray beside the cube


def test_the_distortion_is_that_of_the_weights():
    """Of even fog: the mean distance of two samples, times the square of all weights."""
    bricks = Bricks.where(np.ones((_SIDE // 4,) * 3, bool))
    depth = 0.2
    packets = np.tile(np.float32([0, 0, 0, depth]), bricks.voxel_count)
    ray = mi.Ray3f(mi.Point3f(0, 0, -3), mi.Vector3f(0, 0, 1))
    seen = composite(bricks, mi.Float(packets), Rays.through(bricks, ray), 0)
    edges = np.linspace(0, 1, 2 * _SIDE + 1)
    light = np.exp(-depth * _SIDE * edges)
    weight, middle = light[:-1] - light[1:], (edges[:-1] + edges[1:]) / 2
    apart = np.abs(middle[:, None] - middle)
    expected = weight @ apart @ weight + (weight**2 * np.diff(edges)).sum() / 3
    assert np.isclose(seen.spread.z[0], expected, rtol=0.02)
    assert np.isclose(seen.spread.x[0], weight.sum(), rtol=0.02)


@pytest.mark.parametrize("width", [1, 4])
def test_derivatives_are_those_of_finite_differences(width):
    bricks = Bricks.where(np.ones((_SIDE // 4,) * 3, bool))
    packets, rays, weight = _packets(bricks, width), _rays(bricks), 0.7
    by_radiance, by_transmittance = mi.Color3f(0.3, -0.5, 0.8), mi.Float(0.4)

    def seen(values: np.ndarray):
        return composite(bricks, mi.Float(values.ravel()), rays, 5)

    def loss(values: np.ndarray) -> float:
        result = seen(values)
        total = dr.dot(result.radiance, by_radiance) + result.transmittance * by_transmittance
        return float(dr.sum(mi.Float64(total + weight * result.spread.z))[0])

    result = seen(packets)
    count = dr.width(result.transmittance)
    adjoint = Adjoint(
        result.radiance,
        result.transmittance,
        result.spread,
        mi.Color3f(*(dr.full(mi.Float, c[0], count) for c in by_radiance)),
        dr.full(mi.Float, by_transmittance[0], count),
        mi.Float(weight),
    )
    gradient = composite(bricks, mi.Float(packets.ravel()), rays, 5, adjoint=adjoint).numpy()
    rng = np.random.default_rng(1)
    for _ in range(3):
        direction = rng.normal(size=packets.shape).astype(np.float32)
        direction[:, 1:, 3] = 0
        step = 2e-3
        difference = (loss(packets + step * direction) - loss(packets - step * direction)) / (2 * step)
        # Faint samples are drawn at random.
        assert np.isclose(gradient @ direction.ravel(), difference, rtol=0.05, atol=0.2)


def test_the_same_seed_sees_the_same_voxels():
    bricks = Bricks.where(np.ones((_SIDE // 4,) * 3, bool))
    packets, rays = mi.Float(_packets(bricks, 1).ravel()), _rays(bricks)
    first, same, other = (composite(bricks, packets, rays, seed).radiance.numpy() for seed in (5, 5, 6))
    assert (first == same).all() and (first != other).any()
