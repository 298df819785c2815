"""Distances from depth maps, against planes and a sheet."""

import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.fields.depth_fusion import fused_distance
from gshell_mi.views import PinholeViews

_SIZE, _FAR = 64, 4.0


def _looking_down_z(signs: list[int]) -> PinholeViews:
    """Views from z = 4 (sign 1) and z = -4 (sign -1) at the origin, 1 wide at depth 1."""
    count = len(signs)
    origins = np.array([[0.0, 0.0, _FAR * sign] for sign in signs])
    bases = np.array([[[1.0, 0, -0.5], [0, -1.0, 0.5], [0, 0, -sign]] for sign in signs])
    return PinholeViews(tuple(f"view_{i}" for i in range(count)), np.full((count, 2), _SIZE), origins, bases)


def _depth_of_plane(views: PinholeViews, index: int, z: float) -> np.ndarray:
    ray = views.pixel_rays(index)
    return ((z - ray.o.z) / ray.d.z).numpy().reshape(_SIZE, _SIZE)


def _at(z: list[float]) -> mi.Point3f:
    return mi.Point3f(0.02, -0.03, mi.Float(z))


def test_a_sheet_seen_from_both_sides_is_0_and_positive_around():
    views = _looking_down_z([1, 1, -1, -1])
    depths = [_depth_of_plane(views, index, 0.0) for index in range(4)]
    found = fused_distance(_at([0.2, 0.05, 0.0, -0.05, -0.2]), views, depths, truncation=0.5, share=0.3)
    assert np.allclose(found, [0.2, 0.05, 0.0, 0.05, 0.2], atol=2e-3)


def test_a_solid_is_negative_inside_and_truncated():
    views = _looking_down_z([1, 1, -1, -1])
    depths = [_depth_of_plane(views, index, 0.3 * sign) for index, sign in enumerate([1, 1, -1, -1])]
    found = fused_distance(_at([0.4, 0.2, 0.0, -0.2, 2.0]), views, depths, truncation=0.25, share=0.3)
    assert np.allclose(found, [0.1, -0.1, -0.25, -0.1, 0.25], atol=2e-3)


@pytest.mark.parametrize(("share", "expected"), [(0.2, 0.5), (0.5, -0.1)])
def test_as_many_views_as_asked_for_have_to_look_through(share, expected):
    views = _looking_down_z([1, 1, 1])
    depths = [_depth_of_plane(views, index, 0.0) for index in range(2)] + [np.full((_SIZE, _SIZE), np.inf)]
    found = fused_distance(_at([-0.1]), views, depths, truncation=0.5, share=share)[0]
    assert np.isclose(found, expected, atol=2e-3)


def test_views_from_which_a_point_is_hidden_have_no_say():
    """Nine of ten views see a sheet far in front of the point, the tenth looks past it."""
    views = _looking_down_z([1] * 10)
    depths = [_depth_of_plane(views, index, 2.0) for index in range(9)] + [np.full((_SIZE, _SIZE), np.inf)]
    assert fused_distance(_at([0.0]), views, depths, truncation=0.5, share=0.3)[0] == 0.5


@pytest.mark.parametrize("unknown", [np.nan, None])
def test_what_is_unknown_or_out_of_the_frame_says_nothing(unknown):
    views = _looking_down_z([1, 1])
    if unknown is None:
        points, depths = mi.Point3f(50.0, 0, 0), [np.full((_SIZE, _SIZE), np.inf)] * 2
    else:
        points, depths = _at([0.5]), [np.full((_SIZE, _SIZE), unknown)] * 2
    assert fused_distance(points, views, depths, truncation=0.5, share=0.3)[0] == -0.5


def test_at_the_edge_of_a_surface_the_nearer_depth_counts():
    views = _looking_down_z([1])
    depth = _depth_of_plane(views, 0, 0.0)
    depth[:, _SIZE // 2 :] = np.inf
    # Half a pixel beyond the last pixel that shows the plane, and two pixels beyond.
    pixel = _FAR / _SIZE
    found = fused_distance(mi.Point3f([0.0, 2 * pixel], 0.0, -0.1), views, [depth], truncation=0.5, share=0.3)
    assert np.allclose(found, [-0.1, 0.5], atol=2e-3)
