"""Distances to masks against the closed form."""

import numpy as np

from gshell_mi.fields.visual_hull import mask_distance


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
