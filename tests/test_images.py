"""Images for people, against known values."""

import numpy as np
import pytest
from PIL import Image

from gshell_mi.images import (
    BOTH,
    FIT_ONLY,
    MASK_ONLY,
    UNKNOWN,
    mask_overlay,
    over_white,
    psnr,
    srgb,
    triptych,
    write_png,
)


@pytest.mark.parametrize(
    ("linear", "encoded"),
    [(0, 0), (1, 1), (0.0031308, 0.0404499), (0.18, 0.4613561), (0.5, 0.7353570), (-1, 0), (7, 1)],
)
def test_srgb(linear, encoded):
    assert srgb(np.array(linear)) == pytest.approx(encoded, abs=2e-6)


def test_srgb_is_monotonic_and_inverts_the_decoding():
    linear = np.linspace(0, 1, 10001)
    encoded = srgb(linear)
    assert (np.diff(encoded) > 0).all()
    decoded = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(decoded, linear, atol=2e-7)


def test_over_white():
    rgba = np.array([[[0, 0, 0, 0], [0, 0, 0, 1], [0.25, 0, 0, 0.5], [2, 2, 2, 1]]], float)
    expected = [[[1, 1, 1], [0, 0, 0], srgb(np.array([0.75, 0.5, 0.5])), [1, 1, 1]]]
    np.testing.assert_allclose(over_white(rgba), expected)


def test_psnr():
    noise = np.random.default_rng(0).normal(size=(64, 64, 3))
    noise *= 0.05 / np.sqrt((noise**2).mean())
    assert psnr(noise, np.zeros_like(noise)) == pytest.approx(-20 * np.log10(0.05))
    assert psnr(noise, noise) == pytest.approx(120)


def test_triptych():
    target, fit = np.zeros((5, 6, 4)), np.zeros((5, 6, 4))
    target[..., 3] = fit[..., 3] = 1
    fit[2, 3] = [0.001, 1, 0, 1]
    image = triptych(target, fit)
    assert image.shape == (5, 18, 3)
    np.testing.assert_array_equal(image[:, :6], 0)
    np.testing.assert_array_equal(image[:, 6:12], over_white(fit))
    np.testing.assert_allclose(image[2, 15], [4 * 12.92 * 0.001, 1, 0])
    assert np.count_nonzero(image[:, 12:]) == 2


def test_mask_overlay():
    target, fit = np.array([[0, 0.4, 0.6, 1, 1]]), np.array([[0, 0.6, 0.4, 1, 1]])
    overlay = mask_overlay(target, fit, np.array([[True, True, True, True, False]]))
    np.testing.assert_array_equal(overlay, [[(1, 1, 1), FIT_ONLY, MASK_ONLY, BOTH, UNKNOWN]])


def test_png_round_trip(tmp_path):
    levels = np.arange(256).reshape(16, 16)
    image = np.stack([levels, levels.T, 255 - levels], axis=-1)
    write_png(tmp_path / "a.png", image / 255)
    np.testing.assert_array_equal(np.array(Image.open(tmp_path / "a.png")), image)
    write_png(tmp_path / "b.png", np.array([[[-1, 2, 0.5]]]))
    assert np.array(Image.open(tmp_path / "b.png")).tolist() == [[[0, 255, 128]]]
