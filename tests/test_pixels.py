"""Random pixels: which are drawn, and what a mean over them stands for."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.pixels import PixelPool
from gshell_mi.targets import Target
from gshell_mi.views import PinholeViews

#: Width and height of the two views' images.
SIZES = (64, 48), (80, 60)


def views() -> PinholeViews:
    return PinholeViews.from_sensors(
        [
            mi.load_dict(
                {"type": "perspective", "film": {"type": "hdrfilm", "width": width, "height": height}}
            )
            for width, height in SIZES
        ]
    )


def ring(width: int, height: int) -> Target:
    """A ring around the centre of an image. Red is the column and green the row, where it is covered."""
    row, column = np.mgrid[:height, :width].astype(np.float32)
    distance = np.hypot(column + 0.5 - width / 2, row + 0.5 - height / 2)
    covered = ((distance > 6) & (distance < 12)).astype(np.float32)
    return Target(None, np.stack([covered * column, covered * row, covered, covered], axis=-1), True)


@pytest.fixture(scope="module")
def drawn():
    pool = PixelPool(views(), [ring(*size) for size in SIZES])
    return pool, pool.sample(1 << 16, seed=3, step=5)


def test_pixels_are_those_at_the_film_positions(drawn):
    _, sample = drawn
    size = np.array(SIZES)[sample.view.numpy()].T
    column, row = np.floor(sample.film.numpy() * size)
    covered = sample.alpha.numpy() > 0
    np.testing.assert_array_equal(sample.radiance.numpy()[:2], [covered * column, covered * row])


def test_far_from_the_masks_nothing_is_drawn_but_their_holes_are(drawn):
    _, sample = drawn
    size = np.array(SIZES)[sample.view.numpy()].T
    distance = np.hypot(*(np.floor(sample.film.numpy() * size) + 0.5 - size / 2))
    assert distance.max() < 12 + 3 * np.sqrt(2)
    assert distance.min() < 1


def test_a_mean_times_the_share_is_one_over_all_pixels(drawn):
    pool, sample = drawn
    whole = np.concatenate([ring(*size).rgba.reshape(-1, 4) for size in SIZES])
    assert pool.share[0] * sample.alpha.numpy().mean() == pytest.approx(whole[:, 3].mean(), rel=0.02)
    assert pool.share[0] * sample.radiance.numpy()[0].mean() == pytest.approx(whole[:, 0].mean(), rel=0.02)
    assert len(sample.alpha) == round((1 << 16) * pool.share[0]), "as many to a pixel as asked for"


def test_every_one_of_many_pixels_may_be_drawn(monkeypatch):
    """A float has 23 random bits; a pool that says it has 2^26 pixels draws odd ones, too."""
    pool = PixelPool(views(), [ring(*size) for size in SIZES])
    indices = []
    monkeypatch.setattr(pool, "_count", 1 << 26)
    given = dr.gather

    def gather(kind, source, index, *options):
        if source is pool._view:
            indices.append(index.numpy())
            index = mi.UInt32(index % 100)
        return given(kind, source, mi.UInt32(index % 100) if source is not pool._size else index, *options)

    monkeypatch.setattr(dr, "gather", gather)
    pool.sample(10_000, seed=0, step=0)
    assert np.bincount(indices[0] % 8, minlength=8).min() > 0.8 * len(indices[0]) / 8


def test_what_is_unknown_is_not_drawn():
    targets = []
    for width, height in SIZES:
        known = np.ones((height, width), np.float32)
        known[:, : width // 2] = 0
        targets.append(Target(None, ring(width, height).rgba, True, known=known))
    sample = PixelPool(views(), targets).sample(1 << 14, seed=3, step=5)
    assert sample.film.numpy()[0].min() >= 0.5
    nothing = [Target(None, each.rgba, True, known=np.zeros_like(each.known)) for each in targets]
    assert len(PixelPool(views(), nothing).sample(64, seed=3, step=5).alpha), "there is always something"


def test_without_masks_all_pixels_are_drawn():
    targets = [Target(None, np.ones((height, width, 4), np.float32), False) for width, height in SIZES]
    pool = PixelPool(views(), targets)
    assert pool.share[0] == 1
    sample = pool.sample(1 << 18, seed=0, step=0)
    film = sample.film.numpy()[:, sample.view.numpy() == 1]
    assert len(np.unique(np.floor(film * [[80], [60]]), axis=1).T) == 80 * 60


def test_a_step_draws_the_same_again_and_another_step_others(drawn):
    pool, sample = drawn
    again, other = (pool.sample(1 << 16, seed=3, step=step).film.numpy() for step in (5, 6))
    np.testing.assert_array_equal(again, sample.film.numpy())
    assert (other != again).any(axis=0).mean() > 0.99


def test_of_what_is_all_outline_all_is_drawn():
    plate, twig = (np.zeros((height, width, 4), np.float32) for width, height in SIZES)
    plate[10:40, 10:50], twig[:, 40:45] = 1, 1
    pool = PixelPool(views(), [Target(None, rgba, True) for rgba in (plate, twig)], off_outline=3)
    sample = pool.sample(1 << 14, seed=3, step=5)
    column, row = np.floor(sample.film.numpy() * np.array(SIZES)[sample.view.numpy()].T)
    of_plate = sample.view.numpy() == 0
    assert (column[of_plate].min(), column[of_plate].max()) == (13, 46)
    assert (row[of_plate].min(), row[of_plate].max()) == (13, 36)
    assert column[~of_plate].min() < 40 and column[~of_plate].max() > 44
