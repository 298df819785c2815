"""The even light that a fit starts from."""

import numpy as np
import pytest

from gshell_mi.fit.surface import Seen


def radiance(*parts: tuple[float, int]) -> np.ndarray:
    """(V, 3): so bright, so many vertices each."""
    return np.concatenate([np.full((count, 3), bright) for bright, count in parts])


def test_what_is_usual_reflects_a_half():
    assert Seen.even_light(radiance((0.2, 90), (0.4, 10))) == pytest.approx(0.4)


def test_white_on_black_is_no_brighter_than_white():
    """Ten times as bright as the rest: at a reflectance of 0.8, where the light is 2.5 times the mean."""
    assert Seen.even_light(radiance((0.05, 90), (0.5, 10))) == pytest.approx(0.5 / 2.0)


def test_a_few_bright_vertices_are_highlights():
    assert Seen.even_light(radiance((0.2, 99), (50.0, 1))) == pytest.approx(0.4)


def test_where_nothing_is_seen():
    assert Seen.even_light(np.zeros((0, 3))) == 1
