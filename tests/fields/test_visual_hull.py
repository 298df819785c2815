"""Hulls of bodies whose masks are known."""

import mitsuba as mi
import numpy as np
import pytest
from scipy import ndimage
from topology import assert_manifold, component_count, euler_characteristic

from gshell_mi.extraction import extract
from gshell_mi.fields.mask_distances import MaskDistances
from gshell_mi.fields.visual_hull import doubting_hulls, visual_hull
from gshell_mi.lattice import TetLattice
from gshell_mi.views import PinholeViews


def look_at(origin, size: int = 64, fov: float = 40.0) -> tuple[np.ndarray, np.ndarray]:
    """Origin and basis of a square pinhole camera that looks at the world's origin."""
    forward = -np.array(origin, float) / np.linalg.norm(origin)
    right = np.cross(forward, [0, 1, 0] if abs(forward[1]) < 0.99 else [1, 0, 0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    half = np.tan(np.radians(fov / 2))
    basis = np.stack([2 * half * right, 2 * half * down, forward - half * (right + down)], axis=1)
    return np.array(origin, float), basis


def around(count: int, size: int = 64) -> PinholeViews:
    """Cameras spread over a sphere of radius 3."""
    index = np.arange(count) + 0.5
    y, angle = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    origins = 3 * np.stack([np.sqrt(1 - y**2) * np.cos(angle), y, np.sqrt(1 - y**2) * np.sin(angle)], axis=1)
    poses = [look_at(origin, size) for origin in origins]
    return PinholeViews(
        tuple(map(str, range(count))),
        np.full((count, 2), size),
        np.array([origin for origin, _ in poses]),
        np.array([basis for _, basis in poses]),
    )


def coverage(views: PinholeViews, index: int, hit, samples: int = 4) -> np.ndarray:
    """Mask of one view: the mean over ``samples``^2 rays per pixel of ``hit(origins, directions)``."""
    size = views.sizes[index, 0]
    film = (np.arange(size * samples) + 0.5) / (size * samples)
    u, v = np.meshgrid(film, film)
    direction = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1) @ views.bases[index].T
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    seen = hit(views.origins[index], direction)
    return seen.reshape(size, samples, size, samples).mean((1, 3))


def sphere_hit(radius: float):
    def hit(origin, direction):
        along = direction @ origin
        return along**2 - origin @ origin + radius**2 > 0

    return hit


def torus_hit(major: float, minor: float):
    """Rays that come nearer than the surface to a torus around the y axis, by sphere tracing."""

    def hit(origin, direction):
        t = np.full(len(direction), 1.5)
        for _ in range(80):
            p = origin + t[:, None] * direction
            distance = np.hypot(np.hypot(p[:, 0], p[:, 2]) - major, p[:, 1]) - minor
            t += np.where(t < 5, distance, 0)
        return distance < 1e-3

    return hit


def extracted(distance: mi.Float, lattice: TetLattice):
    closed = mi.Float(np.ones(lattice.vertex_count, np.float32))
    still = mi.Float(np.zeros(3 * lattice.vertex_count, np.float32))
    vertices, faces, _ = extract(lattice, distance, closed, still).to_numpy()
    assert_manifold(vertices, faces)
    return vertices, faces


def hull(masks, views: PinholeViews, lattice: TetLattice, **options) -> mi.Float:
    return visual_hull(lattice.points(mi.Float), MaskDistances(views, masks), **options)


def test_hull_of_a_sphere():
    radius, lattice, views = 0.6, TetLattice(32), around(20)
    masks = [coverage(views, i, sphere_hit(radius)) for i in range(len(views))]
    distance = hull(masks, views, lattice)
    vertices, faces = extracted(distance, lattice)
    assert (component_count(faces), euler_characteristic(faces)) == (1, 2)
    excess = (np.linalg.norm(vertices, axis=1) - radius) / lattice.spacing
    assert np.abs(np.median(excess)) < 0.1 and excess.min() > -0.1, "the hull holds the object"
    assert excess.max() < 0.3
    # Inside, the distance is that to the nearest cone, hence about that to the sphere.
    centre = np.argmin(np.linalg.norm(lattice.vertex_positions(), axis=1))
    assert distance.numpy()[centre] == pytest.approx(-radius, abs=0.03)


@pytest.fixture(scope="module")
def torus():
    views = around(20)
    return views, [coverage(views, i, torus_hit(0.55, 0.2), samples=2) for i in range(len(views))]


def test_the_hole_of_a_torus_is_carved(torus):
    views, masks = torus
    lattice = TetLattice(24)
    daylight = sum((ndimage.binary_fill_holes(mask > 0.5) & (mask < 0.5)).any() for mask in masks)
    assert 4 <= daylight < 20, "some views look through the hole, and their masks enclose it"
    _, faces = extracted(hull(masks, views, lattice), lattice)
    assert (component_count(faces), euler_characteristic(faces)) == (1, 0), "of genus 1"
    _, faces = extracted(hull(masks, views, lattice, daylight_votes=1.0), lattice)
    assert (component_count(faces), euler_characteristic(faces)) == (1, 2), "without votes it is a pill"


def test_a_single_glimpse_of_daylight_is_not_carved():
    lattice, views = TetLattice(16), around(12, size=32)
    masks = [coverage(views, i, sphere_hit(0.6), samples=2) for i in range(len(views))]
    whole = hull(masks, views, lattice).numpy()
    for count, carved in ((1, False), (2, True)):
        pierced = [mask.copy() for mask in masks]
        for mask in pierced[:count]:
            mask[13:19, 13:19] = 0
        distance = hull(pierced, views, lattice).numpy()
        centre = np.argmin(np.linalg.norm(lattice.vertex_positions(), axis=1))
        assert (distance[centre] > 0) == carved, "what two views agree on is daylight"
        assert np.array_equal(distance, whole) != carved


def test_what_is_out_of_reach_is_as_far_as_that(torus):
    views, masks = torus
    lattice = TetLattice(16)
    exact = hull(masks, views, lattice).numpy()
    reach = 0.2
    assert (exact > 2 * reach).any() and (exact < -reach / 2).any()
    np.testing.assert_allclose(
        hull(masks, views, lattice, reach=reach).numpy(), np.minimum(exact, reach), atol=1e-6
    )


def test_an_empty_mask_leaves_nothing():
    views, lattice = around(3, size=16), TetLattice(8)
    masks = [np.zeros((16, 16))] + [coverage(views, i, sphere_hit(0.6), samples=1) for i in (1, 2)]
    assert (hull(masks, views, lattice).numpy() > 0).all()


def test_what_no_view_frames_is_outside():
    """Close-ups whose masks fill the frame say nothing of what they do not show."""
    origin, basis = look_at([0, 0, 3], size=16, fov=20)
    views = PinholeViews(("0",), np.full((1, 2), 16), origin[None], basis[None])
    points = mi.Point3f([0, 0, 0], [0, 2, 0], [0, 0, 4])  # in the frame, above it, behind the camera
    distance = visual_hull(points, MaskDistances(views, [np.ones((16, 16))])).numpy()
    assert distance[0] < 0 and (distance[1:] == np.inf).all()


def test_masks_that_are_not_believed():
    """Points are as far from the hull as the mask is that is next in distance."""
    views = around(9)
    masks = [coverage(views, index, sphere_hit(0.5)) for index in range(9)]
    points = mi.Point3f([0.0, 0.3, 0.7], [0.0, 0.1, 0.0], [0.0, -0.2, 0.0])
    expected = visual_hull(points, MaskDistances(views, masks)).numpy()
    masks[4] = np.zeros_like(masks[4])
    assert visual_hull(points, MaskDistances(views, masks)).numpy().min() > 0
    # All points are farthest outside of the empty mask, so the next one tells.
    believing, doubting = doubting_hulls(points, MaskDistances(views, masks), [0, 1])
    np.testing.assert_array_equal(believing.numpy(), visual_hull(points, MaskDistances(views, masks)).numpy())
    np.testing.assert_allclose(doubting.numpy(), expected, atol=1e-6)
