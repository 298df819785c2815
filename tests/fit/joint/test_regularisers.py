"""The regularisers on an open sphere: each moves its field the way it should, or stays away."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bowl import RADIUS

from gshell_mi import extras, losses  # noqa: F401 the former registers losses
from gshell_mi.fields import LatticeFields
from gshell_mi.fit import FitConfig
from gshell_mi.fit.joint.joint import JointStage
from gshell_mi.light import EnvironmentLight
from gshell_mi.material import MaterialField
from gshell_mi.scene import load_fit_scene

#: The joint stage's own weights, all 0.
NONE = FitConfig(iterations=4).changed(
    {
        "losses.material_smoothness": 0.0,
        "losses.light_grey": 0.0,
        "losses.flexicubes_deviation": 0.0,
        "render.spp": 1,
        "render.primal_spp": 1,
        "render.max_depth": 2,
        "model.light_height": 4,
    }
)


@pytest.fixture(scope="module")
def fit(bowl_scene):
    return load_fit_scene(bowl_scene)


def stage(fit, *, top: float = 0.0, radius: float = RADIUS, noise: float = 0.0, **weights) -> JointStage:
    """A sphere of grey material, cut open at the height ``top``, ready for a step."""
    lattice = fit.subject.lattice
    points = lattice.vertex_positions()
    sdf = np.linalg.norm(points, axis=1) - radius
    sdf += np.random.default_rng(0).normal(0, noise, len(sdf)) * (np.abs(sdf) < 0.2)
    fields = LatticeFields.closed(sdf)
    fit.subject.set_fields(replace(fields, msdf=(top - points[:, 1]).astype(np.float32)))
    material = MaterialField(np.full((lattice.vertex_count, 3), 0.5))
    config = NONE.changed({"losses.extra": weights})
    return JointStage(fit, material, EnvironmentLight.uniform(4, 1.0), config)


def gradients(joint: JointStage, view: int = 0) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """The terms of a view, and the derivative of their weighted sum with respect to all that is sought."""
    joint.apply(geometry=True)
    total, terms = joint._regularisers([view])
    dr.backward(total, dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    values = (*joint.fields.items(), *joint.material_optimizer.items(), *joint.light_optimizer.items())
    found = {name: np.array(dr.grad(value)).ravel() for name, value in values}
    return {name: float(value[0]) for name, value in terms.items()}, found


def heights(joint: JointStage) -> np.ndarray:
    """y of every lattice vertex."""
    return joint.subject.lattice.vertex_positions()[:, 1]


def test_weight_zero_computes_nothing(fit, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("computed in vain")

    for name in losses.__all__:
        if name not in ("IMAGE_LOSSES", "mask_l2", "tonemap"):
            monkeypatch.setattr(losses, name, refuse)
    log = stage(fit).step(3)
    assert set(log) == {"loss", "image", "mask", "psnr"}


def test_the_sum_is_weighted(fit):
    joint = stage(fit, hole_opening=2.0, sdf_sign=0.5)
    joint.apply(geometry=True)
    total, terms = joint._regularisers([0])
    assert set(terms) == {"hole_opening", "sdf_sign"}
    assert total[0] == pytest.approx(2 * terms["hole_opening"][0] + 0.5 * terms["sdf_sign"][0], rel=1e-5)


def test_terms_are_logged(fit):
    log = stage(fit, eikonal=0.1).step(3)
    assert log["eikonal"] > 0
    assert log["loss"] == pytest.approx(log["image"] + NONE.losses.mask * log["mask"] + 0.1 * log["eikonal"])


def test_hole_opening_lowers_the_msdf_of_the_surface_only(fit):
    joint = stage(fit, hole_opening=1.0)
    _, found = gradients(joint)
    cell = joint.subject.lattice.spacing
    assert found["msdf"].max() > 0 and found["msdf"].min() >= 0, "a step of descent lowers it"
    assert not found["msdf"][heights(joint) > 1.01 * cell].any(), "where it is cut already, nothing"
    assert not found["sdf"].any() and not found["deform"].any()


def test_hole_closing_raises_the_msdf_along_the_visible_rim(fit):
    joint = stage(fit, top=0.3, hole_closing=1.0)
    seen, found = gradients(joint, view=0)
    assert seen["hole_closing"] > 0, "the first view looks in from above"
    assert found["msdf"].min() < 0 and found["msdf"].max() <= 0, "a step of descent raises it"
    assert not found["msdf"][np.abs(heights(joint) - 0.3) > 1.01 * joint.subject.lattice.spacing].any()
    below, _ = gradients(joint, view=len(fit.sensors) - 1)
    assert below["hole_closing"] == 0, "the bowl hides its rim from below"


def test_hole_closing_of_a_closed_surface(fit):
    terms, found = gradients(stage(fit, top=9.0, hole_closing=1.0))
    assert terms["hole_closing"] == 0 and not found["msdf"].any()


def test_mask_terms_are_silent_where_the_masks_agree(fit):
    """The bowl's own masks: hardly a pixel disagrees but along the silhouettes, which cross pixels."""
    terms, _ = gradients(stage(fit, visible_inside=1.0), view=11)
    wrong, found = gradients(stage(fit, top=-0.3, visible_inside=1.0), view=6)
    assert terms["visible_inside"] < 0.02 * wrong["visible_inside"]
    assert found["msdf"].min() < 0 and found["msdf"].max() <= 0, "too short a bowl: ν rises"


def test_what_is_seen_outside_the_mask_goes(fit):
    """The whole sphere sticks out above the masks of a half one, seen from the side."""
    joint = stage(fit, top=9.0, visible_outside=1.0)
    terms, found = gradients(joint, view=5)
    assert terms["visible_outside"] > 0
    y = heights(joint)
    assert found["msdf"][y > 0.1].sum() > 0 and found["msdf"].min() >= 0
    assert found["msdf"][y < -0.2].sum() < 0.05 * found["msdf"][y > 0.1].sum()


def test_normal_variation_smooths(fit):
    joint = stage(fit, noise=0.02, normal_variation=1.0)
    rough, found = gradients(joint)
    smooth, _ = gradients(stage(fit, normal_variation=1.0))
    assert rough["normal_variation"] > 2 * smooth["normal_variation"]
    step = 0.02 * found["sdf"] / np.abs(found["sdf"]).max()
    geometry = joint.geometry.optimizer
    geometry["sdf"] = geometry["sdf"] - mi.Float(step.astype(np.float32))
    after, _ = gradients(joint)
    assert after["normal_variation"] < rough["normal_variation"]


def test_eikonal_of_the_start(fit):
    terms, _ = gradients(stage(fit, eikonal=1.0))
    assert terms["eikonal"] < 0.02, "a distance"
    terms, _ = gradients(stage(fit, noise=0.03, eikonal=1.0))
    assert terms["eikonal"] > 0.1


def test_albedo_chroma_pulls_the_colour_towards_the_images(fit):
    """The bowl is reddish: grey base colours get more red and less blue."""
    joint = stage(fit, albedo_chroma=1.0)
    terms, found = gradients(joint)
    red, _, blue = found["vertex_color"].reshape(-1, 3).sum(axis=0)
    assert terms["albedo_chroma"] > 0 and red < 0 < blue
    assert not found["log_radiance"].any() and not found["sdf"].any()


def test_light_terms_reach_the_light_only(fit):
    joint = stage(fit, light_smoothness=1.0)
    speckle = np.random.default_rng(1).normal(size=(4, 8, 3)).astype(np.float32)
    joint.light_optimizer["log_radiance"] = mi.TensorXf(speckle)
    terms, found = gradients(joint)
    assert terms["light_smoothness"] > 0.5 and found["log_radiance"].any()
    assert not found["vertex_color"].any() and not found["msdf"].any()


def test_a_given_light_has_no_terms(fit):
    joint = stage(fit)
    config = NONE.changed({"losses.extra": {"light_smoothness": 1.0}, "losses.light_grey": 1.0})
    _, terms = JointStage(fit, joint.material, None, config)._regularisers(0)
    assert terms == {}
