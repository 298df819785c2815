"""Priors of the light."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from closed_form import value

from gshell_mi import losses


def test_grey_world():
    assert value(losses.grey_world(mi.Color3f([1, 9], [1, 9], [1, 9]))) == pytest.approx(0, abs=1e-6)
    assert value(losses.grey_world(mi.Color3f(3, 0, 0))) == pytest.approx((2 + 1 + 1) / 3)


def test_light_smoothness():
    """One row brighter by e: a difference of 1 to the row above and to the one below, of 4 - 1 pairs."""
    light = np.zeros((4, 6, 3), np.float32)
    light[1] = 1
    assert value(losses.light_smoothness(mi.TensorXf(light))) == pytest.approx(2 / 3)
    brighter = losses.light_smoothness(mi.TensorXf(light + 5))
    assert value(brighter) == pytest.approx(2 / 3), "brightness is free"
    assert value(losses.light_smoothness(mi.TensorXf(np.ones((4, 6, 3), np.float32)))) == 0


def test_light_smoothness_wraps_around():
    ramp = np.broadcast_to(np.arange(6, dtype=np.float32)[None, :, None], (4, 6, 3))
    assert value(losses.light_smoothness(mi.TensorXf(ramp))) == pytest.approx((5 * 1 + 5) / 6)
    rolled = np.ascontiguousarray(np.roll(ramp, 2, axis=1))
    assert value(losses.light_smoothness(mi.TensorXf(rolled))) == pytest.approx((5 * 1 + 5) / 6)


def test_derivative_of_light_smoothness():
    light = mi.TensorXf(np.random.default_rng(2).normal(size=(3, 4, 3)).astype(np.float32))
    dr.enable_grad(light)
    loss = losses.light_smoothness(light)
    dr.backward(loss)
    gradient = np.array(dr.grad(light))
    assert gradient.sum() == pytest.approx(0, abs=1e-6), "a factor of all texels changes nothing"
    step = light - 1e-3 * dr.grad(light)
    predicted = value(loss) - 1e-3 * (gradient**2).sum()
    assert value(losses.light_smoothness(dr.detach(step))) == pytest.approx(predicted, abs=1e-6)
