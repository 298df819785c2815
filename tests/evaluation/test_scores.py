"""Scores against closed forms and independent computations."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from gshell_mi import UserError
from gshell_mi.evaluation import VIEW_SCORES, albedo_scale, image_scores, mesh_scores, view_scores
from gshell_mi.evaluation.mesh_scores import winding_numbers
from gshell_mi.images import srgb
from gshell_mi.targets import Target


def flat(color, alpha=1.0, size=16) -> np.ndarray:
    return np.broadcast_to(np.append(np.asarray(color, float), alpha), (size, size, 4)).copy()


def test_scores_of_flat_images():
    scores, flip = image_scores(flat([0.2, 0.2, 0.2]), flat([0.4, 0.4, 0.4]))
    step = srgb(np.array(0.4)) - srgb(np.array(0.2))
    assert scores["psnr"] == pytest.approx(-20 * np.log10(step), abs=1e-3)
    assert scores["relative_mse"] == pytest.approx(0.04 / (0.16 + 0.01))
    assert flip.shape == (16, 16, 3) and 0 < scores["flip"] < 1
    # Greys differ in lightness only; CIE L* of linear 0.2 and 0.4, and Sharma et al. (2005)'s weight S_L.
    low, high = (116 * y ** (1 / 3) - 16 for y in (0.2, 0.4))
    mean = (low + high) / 2
    weight = 1 + 0.015 * (mean - 50) ** 2 / np.sqrt(20 + (mean - 50) ** 2)
    assert scores["delta_e"] == pytest.approx((high - low) / weight, rel=1e-3)


def test_mask_iou():
    image, reference = flat([0, 0, 0], 0.0), flat([0, 0, 0], 0.0)
    image[:8, :, 3], reference[4:12, :, 3] = 1, 1
    assert image_scores(image, reference)[0]["mask_iou"] == pytest.approx(4 / 12)
    assert image_scores(flat([0, 0, 0], 0.0), flat([0, 0, 0], 0.0))[0]["mask_iou"] == 1


def test_psnr_inside_is_of_what_both_show():
    image, reference = flat([0.2, 0.2, 0.2]), flat([0.4, 0.4, 0.4])
    image[:8], reference[4:12] = 0, 0
    step = srgb(np.array(0.4)) - srgb(np.array(0.2))
    scores = image_scores(image, reference)[0]
    assert scores["psnr_inside"] == pytest.approx(-20 * np.log10(step), abs=1e-3)
    assert scores["psnr"] < scores["psnr_inside"], "white instead of grey is worse than another grey"
    image[12:] = 0
    assert image_scores(image, reference)[0]["psnr_inside"] is None


def test_scores_of_a_view_are_those_of_its_images():
    rng = np.random.default_rng(2)
    image, reference = (rng.random((16, 24, 4)).astype(np.float32) for _ in range(2))
    found = view_scores(image, Target(Path("a.exr"), reference, True))
    whole, _ = image_scores(image, reference)
    assert found == {name: whole[name] for name in VIEW_SCORES}


def test_what_a_target_does_not_tell_is_not_held_against_a_view():
    reference, image = flat([0.4, 0.4, 0.4]), flat([0.4, 0.4, 0.4])
    image[:, :8] = 0
    known = np.ones((16, 16), np.float32)
    assert view_scores(image, Target(Path("a.exr"), reference, True, known=known))["mask_iou"] == 0.5
    known[:, :8] = 0
    found = view_scores(image, Target(Path("a.exr"), reference, True, known=known))
    assert (found["psnr"], found["mask_iou"], found["ssim"], found["flip"]) == (120, 1, 1, 0)


def test_scores_that_a_view_does_not_have():
    black = flat([0, 0, 0], size=5)
    found = view_scores(black, Target(Path("a.exr"), black, has_alpha=False))
    assert found == {"psnr": 120, "psnr_inside": 120, "ssim": None, "flip": 0, "mask_iou": None}


def test_noise_lowers_every_score():
    rng = np.random.default_rng(0)
    image = rng.random((32, 32, 4)) * 0.5 + 0.25
    image[..., 3] = 1
    little, much = (
        image_scores(image + s * rng.normal(size=image.shape) * [1, 1, 1, 0], image)[0] for s in (0.01, 0.1)
    )
    assert little["psnr"] > much["psnr"] and little["ssim"] > much["ssim"]
    assert all(little[name] < much[name] for name in ("flip", "relative_mse", "delta_e"))


def test_sizes():
    with pytest.raises(UserError, match="only images of one size can be compared"):
        image_scores(flat([0, 0, 0]), flat([0, 0, 0], size=17))
    with pytest.raises(UserError, match="SSIM needs 7 at least"):
        image_scores(flat([0, 0, 0], size=5), flat([0, 0, 0], size=5))


def test_albedo_scale_is_the_least_squares_one():
    rng = np.random.default_rng(1)
    images, references = (list(rng.random((3, 8, 8, 4))) for _ in range(2))
    scale = albedo_scale(images, references)
    for channel in range(3):
        a, b = (np.stack(stack)[..., channel].ravel() for stack in (images, references))
        assert scale[channel] == pytest.approx(np.linalg.lstsq(a[:, None], b, rcond=None)[0][0])


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=5, radius=1.0)


def test_mesh_against_itself(ball):
    scores = mesh_scores(ball, ball, samples=100_000)
    assert scores["chamfer"] == pytest.approx(scores["chamfer_floor"], rel=0.05)
    assert scores["f_score"] > 0.99 and scores["winding_difference"] == 0
    assert scores["normal_consistency"] > 0.999
    assert scores["boundary_loops"] == {"found": 0, "reference": 0}


def test_larger_ball(ball):
    """Concentric spheres: every distance is the difference of the radii."""
    larger = ball.copy().apply_scale(1.05)
    scores = mesh_scores(larger, ball, samples=20000)
    assert scores["chamfer"] == pytest.approx(100 * 0.05 / np.sqrt(12), rel=0.06)
    assert scores["f_score"] == 0
    # The winding number differs in the shell, a known fraction of the box of side 2.4.
    shell = 4 / 3 * np.pi * (1.05**3 - 1) / 2.4**3
    assert scores["winding_difference"] == pytest.approx(shell, abs=0.008)


def test_turned_inside_out(ball):
    inverted = ball.copy()
    inverted.invert()
    scores = mesh_scores(inverted, ball, samples=20000)
    assert scores["normal_consistency"] > 0.999, "of unoriented normals"
    assert scores["winding_difference"] == pytest.approx(2 * 4 / 3 * np.pi / 2.4**3, abs=0.03)


def test_winding_number_of_an_open_surface(ball):
    half = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 1] < 0], process=False)
    low, high = np.array([[0, -0.01, 0], [0, 0.0, 100.0]])
    # Above a hemisphere's rim plane lies half of the solid angle.
    assert winding_numbers(half, np.array([low]))[0] == pytest.approx(0.5, abs=0.02)
    assert winding_numbers(half, np.array([high]))[0] == pytest.approx(0, abs=1e-3)
