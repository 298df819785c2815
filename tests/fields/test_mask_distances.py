"""Distances to masks' outlines, where film positions of several views are."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.fields.mask_distances import MaskDistances
from gshell_mi.fields.mask_outline import mask_distance
from gshell_mi.views import PinholeViews

SIZES = (12, 7), (5, 9), (1, 4)


@pytest.fixture
def views() -> PinholeViews:
    """Cameras of different films: width and height."""
    count = len(SIZES)
    return PinholeViews(
        tuple(map(str, range(count))), np.array(SIZES), np.zeros((count, 3)), np.stack([np.eye(3)] * count)
    )


@pytest.fixture
def alphas() -> list[np.ndarray]:
    masks = [np.zeros((height, width)) for width, height in SIZES]
    masks[0][1:6, 2:9] = 1
    masks[0][3, 4:6] = 0  # a hole
    masks[1][2:5, 1:3] = 1
    masks[2][2:] = 1
    return masks


def test_at_the_centres_of_pixels_they_are_those_of_the_mask(views, alphas):
    masks = MaskDistances(views, alphas)
    for values, filled in ((masks.plain, False), (masks.filled, True)):
        for view, (alpha, (width, height)) in enumerate(zip(alphas, SIZES, strict=True)):
            row, column = np.mgrid[:height, :width].reshape(2, -1)
            film = mi.Point2f((column + 0.5) / width, (row + 0.5) / height)
            found = masks.at(values, dr.full(mi.UInt32, view, width * height), film)
            expected = mask_distance(alpha, fill_holes=filled)
            np.testing.assert_allclose(found.numpy(), expected.ravel(), atol=1e-4)


def test_between_and_beyond_the_centres(views, alphas):
    masks = MaskDistances(views, alphas)
    first = mask_distance(alphas[0], fill_holes=False)
    film = mi.Point2f([3.0 / 12, -0.5, 2.0], [2.0 / 7, -0.5, 2.0])
    found = masks.at(masks.plain, mi.UInt32(0, 0, 0), film).numpy()
    np.testing.assert_allclose(found, [first[1:3, 2:4].mean(), first[0, 0], first[-1, -1]], atol=1e-4)


def test_masks_without_holes_are_filled(views, alphas):
    alphas[0][3, 4:6] = 1
    masks = MaskDistances(views, alphas)
    assert masks.filled is masks.plain


def test_a_ring_thinner_than_a_pixel_has_a_hole(views, alphas):
    """Nowhere is it half of a pixel, but what it encloses is daylight."""
    alphas[0][:] = 0
    alphas[0][1:6, 2:9] = 0.48
    alphas[0][2:5, 3:8] = 0
    alphas[1][:], alphas[2][:] = 0, 0
    masks = MaskDistances(views, alphas)
    plain, filled = (
        values.numpy()[: alphas[0].size].reshape(7, 12) for values in (masks.plain, masks.filled)
    )
    assert plain[1, 4] < 0 < plain[3, 5] and filled[3, 5] < 0
