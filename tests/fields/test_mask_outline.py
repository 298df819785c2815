"""Distances to masks against the closed form; sheets that are seen edge-on."""

import numpy as np
import pytest
from scipy import ndimage

from gshell_mi.fields.mask_outline import mask_distance, sharp, with_thin_parts


def test_distance_to_a_disc_is_sub_pixel():
    fine = (np.arange(64 * 8) + 0.5) / 8 - 0.5
    x, y = np.meshgrid(fine, fine)
    inside = np.hypot(x - 31.3, y - 30.8) < 17.4
    alpha = inside.reshape(64, 8, 64, 8).mean((1, 3))
    x, y = np.meshgrid(np.arange(64), np.arange(64))
    exact = np.hypot(x - 31.3, y - 30.8) - 17.4
    near = np.abs(exact) < 5
    error = np.abs(mask_distance(alpha) - exact)[near]
    assert error.max() < 0.15 and error.mean() < 0.075


def test_empty_and_full_masks():
    assert (mask_distance(np.zeros((8, 8))) == np.inf).all()
    assert (mask_distance(np.ones((8, 8))) == -np.inf).all()


def test_holes_are_filled_on_request():
    alpha = np.zeros((32, 32))
    alpha[8:24, 8:24] = 1
    alpha[14:18, 14:18] = 0
    assert mask_distance(alpha)[16, 16] < 0 < mask_distance(alpha, fill_holes=False)[16, 16]


@pytest.mark.parametrize("shares", [(0.3,), (0.15, 0.2), (0.05, 0.3, 0.05), (0.02,)])
def test_a_sheet_seen_edge_on_counts_as_a_pixel_wide(shares):
    alpha = np.zeros((32, 32))
    alpha[4:28, 16 : 16 + len(shares)] = shares
    assert (mask_distance(alpha) > 0).all()
    distance = mask_distance(with_thin_parts(alpha))
    peak = 16 + int(np.argmax(shares))
    assert (distance[5:27, peak] < 0).all()
    assert distance[16, peak + 8] == pytest.approx(7.5, abs=0.75)


@pytest.mark.parametrize("haze", [0.005, 0.04, 0.3])
def test_faint_haze_is_no_sheet(haze):
    assert (mask_distance(with_thin_parts(np.full((16, 16), haze))) == np.inf).all()


def blurred_disc(blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Coverage of a disc, and the distances to it."""
    fine = (np.arange(64 * 8) + 0.5) / 8 - 0.5
    x, y = np.meshgrid(fine, fine)
    alpha = (np.hypot(x - 31.3, y - 30.8) < 17.4).reshape(64, 8, 64, 8).mean((1, 3))
    x, y = np.meshgrid(np.arange(64), np.arange(64))
    return ndimage.gaussian_filter(alpha, blur), np.hypot(x - 31.3, y - 30.8) - 17.4


@pytest.mark.parametrize("blur", [0.0, 0.5])
def test_a_sharp_edge_stays_where_it_is(blur):
    alpha, exact = blurred_disc(blur)
    assert sharp([alpha])
    assert np.abs(mask_distance(with_thin_parts(alpha)) - exact)[np.abs(exact) < 5].max() < 0.15


@pytest.mark.parametrize("blur", [1.0, 1.5, 3.0])
def test_soft_mattes_are_told_from_sheets(blur):
    assert not sharp([blurred_disc(blur)[0]])


def test_a_view_that_only_shows_an_edge_is_judged_by_the_others():
    edge_on = np.zeros((32, 32))
    edge_on[4:28, 16] = 0.3
    assert sharp([edge_on, blurred_disc(0.0)[0]])
    assert sharp([np.zeros((8, 8))])
