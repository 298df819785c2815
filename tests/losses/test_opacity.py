"""Losses of the opacity in the openings stage."""

import mitsuba as mi
import numpy as np
import pytest
from closed_form import value

from gshell_mi import losses


@pytest.mark.parametrize(("alpha", "expected"), [(0, 0), (1, 0), (0.5, 1), (0.25, 0.75)])
def test_binary_entropy_bound(alpha, expected):
    assert value(losses.binary_entropy_bound(mi.Float([alpha] * 3))) == pytest.approx(expected)
    entropy = -sum(p * np.log2(p) for p in (alpha, 1 - alpha) if p > 0)
    assert expected <= entropy + 1e-9


def test_transparency():
    assert value(losses.transparency(mi.Float(0, 1, 0.25))) == pytest.approx(1.75 / 3)
