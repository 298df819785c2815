"""Image losses against their closed forms on a few numbers."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from closed_form import value

from gshell_mi import losses


def test_log_l1():
    image, target = np.array([0.0, 1.0, 3.0, 7.0]), np.array([1.0, 1.0, 0.0, 1.0])
    expected = np.abs(np.log1p(image) - np.log1p(target)).mean()
    assert expected == pytest.approx(5 / 4 * np.log(2)), "log 2, 0, 2 log 2, 2 log 2"
    tensor = losses.log_l1(mi.TensorXf(image, (2, 2)), mi.TensorXf(target, (2, 2)))
    assert value(tensor) == pytest.approx(expected, rel=1e-6)


def test_log_l1_of_colours_is_the_mean_over_channels():
    assert value(losses.log_l1(mi.Color3f([0, 0], 1, 3), mi.Color3f(0))) == pytest.approx(np.log(2), rel=1e-6)


def test_negative_radiance_counts_as_black():
    assert value(losses.log_l1(mi.TensorXf([-0.5, -9.0], (2,)), mi.TensorXf([0.0, 0.0], (2,)))) == 0


def test_gradient_of_log_l1():
    image = mi.TensorXf([3.0, 1.0], (2,))
    dr.enable_grad(image)
    dr.backward(losses.log_l1(image, mi.TensorXf([1.0, 4.0], (2,))))
    np.testing.assert_allclose(dr.grad(image).array, [0.5 / 4, -0.5 / 2], rtol=1e-6)


def test_mask_l2():
    assert value(losses.mask_l2(mi.Float(0, 1, 0.5), mi.Float(1, 1, 0))) == pytest.approx(1.25 / 3)


def test_chroma_difference():
    red, green = mi.Color3f(2, 0, 0), mi.Color3f(0, 5, 0)
    assert value(losses.chroma_difference(red, green)) == pytest.approx(2)
    assert value(losses.chroma_difference(red, 7 * red)) == 0, "brightness does not count"
    black = mi.Color3f(0)
    assert np.isfinite(value(losses.chroma_difference(black, red)))


def test_chroma_of_chosen_entries():
    first, second = mi.Color3f([1, 0], [0, 1], [0, 0]), mi.Color3f([0, 0], [1, 3], [0, 0])
    assert value(losses.chroma_difference(first, second, mi.Bool(True, False))) == pytest.approx(2)
    assert value(losses.chroma_difference(first, second, mi.Bool(False, False))) == 0


A, B = mi.TensorXf([1.0, 0.0, 3.0], (3,)), mi.TensorXf([3.0, 0.0, 3.0], (3,))


@pytest.mark.parametrize(
    ("name", "expected"),
    [("l1", 2 / 3), ("smape", 2 / 4.01 / 3), ("relative_l2", 4 / 9.01 / 3), ("log_l1", np.log(2) / 3)],
)
def test_image_losses_by_name(name, expected):
    assert value(losses.IMAGE_LOSSES[name](A, B)) == pytest.approx(expected, rel=1e-5)
    assert value(losses.IMAGE_LOSSES[name](B, B)) == 0


@pytest.mark.parametrize("name", ["smape", "relative_l2"])
def test_relative_losses_do_not_see_exposure(name):
    """Ten times as bright, the same error; the absolute loss grows tenfold."""
    loss = losses.IMAGE_LOSSES[name]
    assert value(loss(10 * A, 10 * B)) == pytest.approx(value(loss(A, B)), rel=0.01)
    assert value(losses.l1(10 * A, 10 * B)) == pytest.approx(10 * value(losses.l1(A, B)), rel=1e-5)


@pytest.mark.parametrize("name", sorted(losses.IMAGE_LOSSES))
def test_image_losses_have_finite_derivatives_in_the_dark(name):
    image = mi.TensorXf([0.0, 1e-8, 2.0], (3,))
    dr.enable_grad(image)
    dr.backward(losses.IMAGE_LOSSES[name](image, mi.TensorXf([0.0, 0.0, 1.0], (3,))))
    gradient = np.array(dr.grad(image).array)
    assert np.isfinite(gradient).all() and gradient[2] > 0


def test_depth_l1():
    distance, target = mi.Float(1, 2, 5, 7), mi.Float(1.5, 2, 1, 0)
    valid = mi.Bool(True, True, True, False)
    assert value(losses.depth_l1(distance, target, valid, 10.0)) == pytest.approx((0.5 + 0 + 4) / 3)
    dr.enable_grad(distance)
    dr.backward(losses.depth_l1(distance, target, valid, 1.0))
    np.testing.assert_allclose(dr.grad(distance).numpy(), [-1 / 3, 0, 0, 0], atol=1e-6)
    assert value(losses.depth_l1(distance, target, mi.Bool([False] * 4), 1.0)) == 0
