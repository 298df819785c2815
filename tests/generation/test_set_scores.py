"""Scores of sets whose answers are known."""

import numpy as np
import pytest

from gshell_mi.generation.set_scores import (
    chamfer_distances,
    coverage,
    earth_movers_distances,
    jensen_shannon_divergence,
    minimum_matching_distance,
    nearest_chamfer_distances,
    nearest_neighbour_accuracy,
)


def shapes(count: int, seed: int, offset: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.3, 0.3, (count, 64, 3)) + rng.uniform(-0.2, 0.2, (count, 1, 3)) + offset


def accuracy(a: np.ndarray, b: np.ndarray) -> float:
    return nearest_neighbour_accuracy(
        chamfer_distances(a, a), chamfer_distances(a, b), chamfer_distances(b, b)
    )


def test_copies_of_the_set_are_as_good_as_it_gets():
    a = shapes(12, 0)
    between = chamfer_distances(a, a)
    assert np.allclose(np.diag(between), 0)
    assert minimum_matching_distance(between) == 0 and coverage(between) == 1
    assert jensen_shannon_divergence(a, a) == 0
    assert accuracy(a, a) == pytest.approx(0.5)


def test_halves_of_one_set_cannot_be_told_apart():
    half = np.random.default_rng(1).permutation(200)
    pool = shapes(200, 2)[:, :16]
    assert accuracy(pool[half[:100]], pool[half[100:]]) == pytest.approx(0.5, abs=0.1)


def test_sets_apart_are_always_told_apart():
    a, b = shapes(8, 0, -0.5), shapes(8, 1, 0.5)
    assert accuracy(a, b) == 1
    assert jensen_shannon_divergence(a, b) == 1
    assert minimum_matching_distance(chamfer_distances(a, b)) > 0.5


def test_one_shape_over_and_over_covers_one():
    true = shapes(10, 0)
    assert coverage(chamfer_distances(np.repeat(true[:1], 10, axis=0), true)) == 0.1


def test_a_shift_is_the_distance_by_either_measure():
    # Of numbers that single precision holds exactly.
    points = np.random.default_rng(0).integers(-4096, 4096, (1, 100, 3)) / 4096
    moved = points + np.array([1 / 1024, 0, 0])
    assert chamfer_distances(points, moved)[0, 0] == pytest.approx(1 / 1024)
    assert earth_movers_distances(points, moved)[0, 0] == pytest.approx(1 / 1024)


def test_only_the_earth_mover_counts_how_many_points_there_are():
    a = np.zeros((1, 10, 3))
    a[0, 9] = 1
    b = np.zeros((1, 10, 3))
    b[0, 5:] = 1
    assert chamfer_distances(a, b)[0, 0] == 0
    assert earth_movers_distances(a, b)[0, 0] == pytest.approx(4 * np.sqrt(3) / 10)


def test_distances_among_one_set_are_those_to_itself():
    a = shapes(9, 3)
    assert np.array_equal(chamfer_distances(a), chamfer_distances(a, a))


def test_the_nearest_of_many_is_found_among_the_likeliest():
    rng = np.random.default_rng(0)
    true = rng.uniform(-0.5, 0.5, (60, 1, 3)) + rng.uniform(-0.3, 0.3, (60, 512, 3))
    a = true[::6] + 0.01
    expected = chamfer_distances(a, true)
    assert np.array_equal(nearest_chamfer_distances(a, true, tried=8), expected.min(axis=1))
    assert np.array_equal(expected.argmin(axis=1), np.arange(0, 60, 6))
