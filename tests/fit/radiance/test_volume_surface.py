"""What becomes of distances that a radiance volume tells."""

import numpy as np

from gshell_mi.fit.radiance.volume_surface import smoothed

CELLS = 32
Z, Y, X = np.mgrid[:CELLS, :CELLS, :CELLS] - (CELLS - 1) / 2


def crossings(distance: np.ndarray) -> np.ndarray:
    """Heights along z, from the middle upwards, at which each column leaves what is solid."""
    upper = distance[CELLS // 2 :]
    first = np.argmax(upper >= 0, axis=0)
    below, above = (np.take_along_axis(upper, (first - step)[None], axis=0)[0] for step in (1, 0))
    return first - below / (above - below)


def test_bumps_go_and_the_surface_stays():
    flat = np.abs(Z) - 8
    noise = np.random.default_rng(0).normal(0, 0.5, flat.shape)
    before, after = crossings(flat + noise), crossings(smoothed(flat + noise))
    inner = slice(4, -4), slice(4, -4)
    assert after[inner].std() < 0.5 * before[inner].std()
    assert abs(after[inner].mean() - crossings(flat)[inner].mean()) < 0.05


def test_a_sheet_and_a_gap_of_a_cell_stay():
    for sign in (1, -1):
        thin = sign * (np.abs(Z) - 0.7)
        np.testing.assert_array_equal(smoothed(thin), thin)


def test_far_distances_stay():
    flat = np.abs(Z) - 8
    far = np.abs(flat) >= 3
    np.testing.assert_array_equal(smoothed(flat)[far], flat[far])
