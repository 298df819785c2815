"""The image of gshell_path is the one that Mitsuba's own splatting gives."""

import mitsuba as mi
import numpy as np
import pytest
from mitsuba.python.ad.integrators.common import ADIntegrator

import gshell_mi  # noqa: F401  registers gshell_path


@pytest.mark.parametrize(
    "film",
    [
        {},
        {"pixel_format": "rgba"},
        {"pixel_format": "luminance"},
        {"rfilter": {"type": "box"}},
        {"rfilter": {"type": "lanczos"}},
        {"sample_border": True},
        {"crop_width": 20, "crop_height": 10, "crop_offset_x": 7, "crop_offset_y": 5},
    ],
    ids=lambda film: "-".join(f"{name}" for name in film) or "default",
)
def test_image_is_that_of_mitsuba(film):
    scene = mi.load_dict(mi.cornell_box())
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": 39,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 40, "height": 32} | film,
        }
    )
    integrator = mi.load_dict({"type": "gshell_path", "max_depth": 3})
    ours = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=5, seed=3))
    mitsubas = np.array(ADIntegrator.render(integrator, scene, sensor, 3, 5))
    assert ours.shape == mitsubas.shape and ours.max() > 0.1
    assert np.abs(ours - mitsubas).max() < 1e-5 * mitsubas.max()
