"""Each loss against its closed form on a few numbers."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi import losses


def value(loss) -> float:
    assert type(loss) is mi.Float and dr.width(loss) == 1
    return loss[0]


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


@pytest.mark.parametrize(("alpha", "expected"), [(0, 0), (1, 0), (0.5, 1), (0.25, 0.75)])
def test_binary_entropy_bound(alpha, expected):
    assert value(losses.binary_entropy_bound(mi.Float([alpha] * 3))) == pytest.approx(expected)
    entropy = -sum(p * np.log2(p) for p in (alpha, 1 - alpha) if p > 0)
    assert expected <= entropy + 1e-9


def test_transparency():
    assert value(losses.transparency(mi.Float(0, 1, 0.25))) == pytest.approx(1.75 / 3)


def test_chroma_difference():
    red, green = mi.Color3f(2, 0, 0), mi.Color3f(0, 5, 0)
    assert value(losses.chroma_difference(red, green)) == pytest.approx(2)
    assert value(losses.chroma_difference(red, 7 * red)) == 0, "brightness does not count"
    black = mi.Color3f(0)
    assert np.isfinite(value(losses.chroma_difference(black, red)))


def test_edge_smoothness():
    """Differences 1, 2 and 3 along the edges of a triangle; the second triangle is even."""
    faces = mi.Vector3u([0, 3], [1, 4], [2, 5])
    values = mi.Float(0, 1, 3, 8, 8, 8)
    assert value(losses.edge_smoothness(values, faces)) == pytest.approx((1 + 2 + 3) / 3 / 2)
    colors = mi.Color3f(values, 0, 0)
    assert value(losses.edge_smoothness(colors, faces)) == pytest.approx((1 + 2 + 3) / 3 / 2 / 3)


def test_grey_world():
    assert value(losses.grey_world(mi.Color3f([1, 9], [1, 9], [1, 9]))) == 0
    assert value(losses.grey_world(mi.Color3f(3, 0, 0))) == pytest.approx((2 + 1 + 1) / 3)
