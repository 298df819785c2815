"""Gains from sightings of the same places: found where views disagree, refused where gloss explains it."""

import numpy as np
import pytest

from gshell_mi.calibration.observations import Observations
from gshell_mi.fit.cameras.gains import find_gains

STOP = np.log(2)
PRIOR = STOP / 3


def sightings(
    stops: np.ndarray,
    *,
    gloss: float = 0.0,
    look: float = 0.0,
    flat: float = 0.0,
    overlap: bool = True,
    lit: float = 0.0,
    seed: int = 0,
) -> Observations:
    """Of a ball by views around it, noisy.

    Args:
        stops: (N, 3) how the views are exposed.
        gloss: of a highlight and a broad lobe, a logarithm of radiance.
        look: how much brighter all looks from one side than from the middle, likewise.
        flat: how much brighter all looks from some directions, some 20 degrees wide, as a flat mirror does.
        overlap: if not, the second half of the views sees other places than the first one.
        lit: how much darker what only the second half sees is.
    """
    rng, views, places = np.random.default_rng(seed), len(stops), 300
    normal, toward = (
        array / np.linalg.norm(array, axis=1, keepdims=True)
        for array in (rng.normal(size=(places, 3)), rng.normal(size=(views, 3)))
    )
    side = np.zeros(places)
    if not overlap:
        side = np.arange(places) % 2
    sees = toward @ normal.T > 0.3
    if not overlap:
        sees &= side == (np.arange(views) >= views // 2)[:, None]
    view, place = np.nonzero(sees)
    mirrored = 2 * (toward[view] * normal[place]).sum(axis=1, keepdims=True) * normal[place] - toward[view]
    color = rng.normal(0, 0.5, (places, 3)) - lit * side[:, None]
    seen = color[place] + STOP * stops[view] + 0.05 * rng.normal(size=(len(view), 3))
    seen += gloss * (np.exp(8 * (mirrored @ [0.6, 0.6, 0.5] - 1)) + mirrored @ [0.3, 0.8, -0.2])[:, None]
    seen += look * toward[view][:, :1]
    bright = np.random.default_rng(0).normal(size=(12, 3))
    bright /= np.linalg.norm(bright, axis=1, keepdims=True)
    seen += flat * np.exp((toward[view] @ bright.T - 1) / np.radians(20) ** 2).sum(axis=1, keepdims=True)
    region = (normal > 0) @ np.array([4, 2, 1])
    return Observations(
        views, place, view, region[place], seen, np.ones_like(seen), normal[place], mirrored, toward[view]
    )


def exposed(views: int, size: float, seed: int = 1) -> np.ndarray:
    """(N, 3) stops, 0 in the mean."""
    rng = np.random.default_rng(seed)
    stops = size * (rng.normal(size=(views, 1)) + 0.2 * rng.normal(size=(views, 3)))
    return stops - stops.mean(axis=0)


@pytest.mark.parametrize("gloss", [0.0, 0.3])
def test_gains_are_recovered(gloss):
    stops = exposed(16, 0.3)
    found = find_gains(sightings(stops, gloss=gloss), PRIOR)
    error = found.log_gain / STOP - stops
    assert found.count and not found.look
    assert np.sqrt((error**2).mean()) < 0.05
    assert np.abs(found.log_gain.mean(axis=0)).max() < 1e-9
    # The error is about as large as is said.
    assert 0.5 < np.sqrt((error**2).mean() / (found.noise**2).mean()) * STOP < 2


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("gloss", [0.0, 0.3])
def test_views_that_are_exposed_alike_get_no_gains(gloss, seed):
    found = find_gains(sightings(np.zeros((16, 3)), gloss=gloss, seed=seed), PRIOR)
    assert not found.count


def test_views_that_share_no_places_tell_nothing_of_each_other():
    """The far side is two stops darker, and no view sees both: that is no exposure."""
    stops = np.zeros((16, 3))
    found = find_gains(sightings(stops, overlap=False, lit=2 * STOP), PRIOR)
    first, second = (found.log_gain[half].mean() / STOP for half in (slice(8), slice(8, None)))
    assert abs(first - second) < 0.02 and not found.count


def test_what_looks_brighter_from_one_side_is_not_exposed_so():
    stops = exposed(40, 0.15)
    found = find_gains(sightings(np.zeros((40, 3)), look=0.4), PRIOR)
    assert found.look and not found.count
    assert np.abs(found.log_gain).max() < 0.05 * STOP
    both = find_gains(sightings(stops, look=0.4), PRIOR)
    assert both.look and both.count
    # What of the exposures is smooth by chance goes with it.
    error = both.log_gain / STOP - stops
    assert np.sqrt((error**2).mean()) < 0.4 * np.sqrt((stops**2).mean())


def test_what_mirrors_lights_is_not_exposed_so():
    """It looks brighter from places that are near to each other, wherever they are."""
    seen = sightings(np.zeros((100, 3)), flat=0.3)
    found = find_gains(seen, PRIOR)
    assert found.look and found.log_gain.std() < 0.05 * STOP


def test_each_channel_has_its_own_gain():
    stops = np.zeros((16, 3))
    stops[::2, 2], stops[1::2, 2] = 0.2, -0.2
    found = find_gains(sightings(stops), PRIOR).log_gain / STOP
    assert np.abs(found[:, :2]).max() < 0.1
    np.testing.assert_allclose(found[:, 2], stops[:, 2], atol=0.1)


def test_no_sightings_no_gains():
    nothing = sightings(np.zeros((4, 3))).only(np.zeros(0, int))
    found = find_gains(nothing, PRIOR)
    assert not found.log_gain.any() and not found.count
