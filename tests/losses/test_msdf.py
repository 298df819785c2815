"""Regularisers of the mSDF."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from closed_form import value

from gshell_mi import losses

E = losses.msdf.EPSILON


def gradient(loss, msdf):
    msdf = mi.Float(msdf)
    dr.enable_grad(msdf)
    dr.backward(loss(msdf))
    return dr.grad(msdf).numpy()


def test_hole_opening():
    assert value(losses.hole_opening(mi.Float(3 - E, -5))) == pytest.approx(2.5 / 2, rel=1e-5), "huber 3"
    assert value(losses.hole_opening(mi.Float(-E, -1))) == 0
    assert value(losses.hole_opening(mi.Float([]))) == 0, "no surface"


def test_hole_opening_pulls_down_until_there_is_a_hole():
    found = gradient(losses.hole_opening, [0.5, 0.0, -0.5 * E, -2 * E])
    np.testing.assert_allclose(found, np.array([0.5 + E, E, 0.5 * E, 0]) / 4, rtol=1e-5)


def test_hole_closing_pulls_up_what_is_visible():
    visible = mi.Bool(True, False, True, True)
    found = gradient(lambda msdf: losses.hole_closing(msdf, visible), [0.0, 0.0, -0.5, 2 * E])
    np.testing.assert_allclose(found, np.array([-E, 0, -0.5 - E, 0]) / 3, rtol=1e-5)
    assert value(losses.hole_closing(mi.Float([]), mi.Bool([]))) == 0, "a closed surface"
    assert value(losses.hole_closing(mi.Float(0, 0), mi.Bool(False, False))) == 0


def test_visible_terms():
    """Outside the mask ν falls where it is positive; inside, it rises where nothing is seen through it."""
    alpha, covered = mi.Float(0, 0, 1, 1, 0.5), mi.Bool(True, False, False, True, False)
    msdf = [0.4, -0.4, -0.4, -0.4, -0.4]
    assert value(losses.visible_outside(mi.Float(msdf), alpha)) == pytest.approx(0.4 / 5)
    assert value(losses.visible_inside(mi.Float(msdf), alpha, covered)) == pytest.approx((0.4 + 0.2) / 5)
    np.testing.assert_allclose(gradient(lambda m: losses.visible_outside(m, alpha), msdf), [0.2, 0, 0, 0, 0])
    np.testing.assert_allclose(
        gradient(lambda m: losses.visible_inside(m, alpha, covered), msdf), [0, 0, -0.2, 0, -0.1], atol=1e-7
    )
