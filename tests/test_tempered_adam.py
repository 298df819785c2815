"""Steps of an optimiser between one size per value and one size for all."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.tempered_adam import TemperedAdam


def stepped(optimizer, gradient) -> np.ndarray:
    optimizer["x"] = dr.zeros(mi.Float, len(gradient))
    dr.set_grad(optimizer["x"], mi.Float(gradient))
    optimizer.step()
    return optimizer["x"].numpy()


def test_a_first_step_goes_as_the_root_of_the_gradient():
    """Adam makes it one size, uniform Adam as large as the gradient; this one is their geometric mean."""
    gradient = np.array([1, -0.25, 0.01, 0], np.float32)
    adam, uniform = (stepped(mi.ad.Adam(lr=0.1, uniform=flag), gradient) for flag in (False, True))
    tempered = stepped(TemperedAdam(lr=0.1), gradient)
    np.testing.assert_allclose(tempered, -0.1 * np.sign(gradient) * np.sqrt(np.abs(gradient)), atol=1e-6)
    np.testing.assert_allclose(np.abs(tempered), np.sqrt(adam * uniform), atol=1e-6)


def test_no_gradient_no_step():
    np.testing.assert_array_equal(stepped(TemperedAdam(lr=0.1), np.zeros(3, np.float32)), 0)


@pytest.mark.parametrize("scale", [1e-6, 1e4])
def test_the_unit_of_the_loss_does_not_matter(scale):
    gradient = np.array([0.5, -2, 1], np.float32)
    np.testing.assert_allclose(
        stepped(TemperedAdam(lr=0.1, epsilon=1e-12), scale * gradient),
        stepped(TemperedAdam(lr=0.1), gradient),
        rtol=1e-3,
    )
