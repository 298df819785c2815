"""Sparse voxels: where they are stored, how rays skip what is empty, and interpolation."""

import drjit as dr
import mitsuba as mi
import numpy as np

from gshell_mi.bricks import BRICK, Bricks


def _some_bricks() -> Bricks:
    live = np.zeros((4, 4, 4), bool)
    live[0, 1, 2] = live[3, 3, 3] = True
    return Bricks.where(live)


def test_every_voxel_is_found_at_its_centre():
    bricks = _some_bricks()
    place = mi.Vector3i((bricks.centres() + 1) * 0.5 * bricks.side)
    found = bricks.lookup().voxel(*place, mi.Bool(True))
    assert bricks.voxel_count == 2 * BRICK**3
    assert (found.numpy() == np.arange(bricks.voxel_count)).all()


def test_where_there_is_no_brick_the_distance_to_the_next_is_known():
    lookup = _some_bricks().lookup()
    # Brick (0, 0, 0) is two bricks from (2, 1, 0) and three from (3, 3, 3).
    assert lookup.voxel(mi.Int32(1), mi.Int32(2), mi.Int32(3), mi.Bool(True))[0] == -2


def test_the_way_out_ends_at_the_empty_cube():
    lookup = _some_bricks().lookup()
    direction = mi.Vector3f(1, 1e-6, 1e-6)
    # From the middle of brick (0, 0, 0): half a brick to its end, and one more that is empty, too.
    start = mi.Point3f(-0.75)
    way = lookup.way_out(start, dr.rcp(direction), mi.Int32(2))
    assert np.isclose(way[0], 0.25 + 0.5)


def test_interpolation_is_exact_for_what_is_linear():
    bricks = Bricks.where(np.ones((3, 3, 3), bool))
    x, y, z = bricks.centres()
    values = 2 * x - y + 3 * z + 0.5
    points = mi.Point3f([0.1, -0.53, 0.7], [0.2, 0.31, -0.6], [0.0, 0.8, 0.15])
    total = mi.Float(0)
    for voxel, weight in bricks.lookup().around(points, mi.Bool(True)):
        total += weight * dr.gather(mi.Float, values, voxel)
    assert np.allclose(total, 2 * points.x - points.y + 3 * points.z + 0.5, atol=1e-5)


def test_random_voxels_average_to_the_interpolation():
    bricks = Bricks.where(np.ones((2, 2, 2), bool))
    values = bricks.centres().x
    count = 200_000
    position = mi.Point3f(dr.full(mi.Float, 0.137, count), 0.05, -0.3)
    bits = mi.PCG32(size=count).next_uint32()
    voxel = bricks.lookup().nearby(position, bits, mi.Bool(True))
    assert np.isclose(dr.mean(dr.gather(mi.Float, values, voxel))[0], 0.137, atol=1e-3)


def test_dense_puts_values_where_the_voxels_are():
    bricks = _some_bricks()
    cube = bricks.dense(bricks.centres().z.numpy(), outside=9.0)
    filled = cube != 9.0
    assert filled.sum() == bricks.voxel_count
    z = (np.arange(bricks.side) + 0.5) * 2 / bricks.side - 1
    assert np.allclose(cube[filled], np.broadcast_to(z[:, None, None], cube.shape)[filled])


def test_bricks_at_places_are_the_same_ones():
    bricks = _some_bricks()
    again = Bricks.at(bricks.places[::-1], bricks.side)
    assert (again.places == bricks.places).all() and (again.slots.numpy() == bricks.slots.numpy()).all()
