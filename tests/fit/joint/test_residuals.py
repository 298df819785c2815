"""How well the images are explained by a surface, and by what is behind it."""

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.fields import LatticeFields
from gshell_mi.fit.joint.residuals import residuals_of
from gshell_mi.lattice import TetLattice
from gshell_mi.pixels import PixelPool
from gshell_mi.targets import Target
from gshell_mi.views import PinholeViews

LATTICE, RADIUS = TetLattice(20), 0.6


def half_ball(top: float) -> LatticeFields:
    """A half-ball below y = 0 with a lid; the lid is open but for a rim of the width ``top``."""
    x, y, z = LATTICE.vertex_positions().T
    sdf = np.maximum(np.sqrt(x * x + y * y + z * z) - RADIUS, y + 0.01)
    closed = LatticeFields.closed(sdf.astype(np.float32), "tet")
    msdf = np.where(y < -0.12, 1.0, np.hypot(x, z) - (RADIUS - top))
    return replace(closed, msdf=(msdf if top < RADIUS else np.ones_like(msdf)).astype(np.float32))


def test_what_is_left_of_a_lid_is_explained_by_what_is_behind_it():
    """Targets show an open bowl in the light and the material that the scene has. Light that comes in through
    the middle of the lid tells what is behind its rim."""
    subject = mi.load_dict({"type": "gshell", "resolution": LATTICE.resolution,
                            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}})
    scene = mi.load_dict({"type": "scene", "subject": subject, "light": {"type": "constant"}})
    sensors = [mi.load_dict({
        "type": "perspective", "fov": 30, "film": {"type": "hdrfilm", "width": 48, "height": 48,
                                                   "pixel_format": "rgba", "rfilter": {"type": "box"}},
        "to_world": mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 0, 1])})
               for origin in ([0.5, 3, 0.5], [0.5, -3, 0.5])]
    integrator = mi.load_dict({"type": "gshell_path", "max_depth": 4, "hide_emitters": True})

    def show(fields):
        subject.set_fields(fields)
        scene.parameters_changed()

    show(half_ball(0.06))
    images = (mi.render(scene, sensor=sensor, integrator=integrator, spp=1024) for sensor in sensors)
    targets = [Target(Path(), np.array(image), True) for image in images]
    show(half_ball(0.22))
    views, template = PinholeViews.from_sensors(sensors), subject.template()
    found = residuals_of(template, scene, integrator, views, PixelPool(views, targets), seed=1)
    once = residuals_of(template, scene, integrator, views, PixelPool(views, targets), seed=1, behind=False)
    np.testing.assert_array_equal(once.without, 0)
    assert once.now.sum() == pytest.approx(found.now.sum(), rel=0.02)
    x, y, z = template.to_numpy()[0].T
    lid = (y > -0.05) & (np.hypot(x, z) > 0.4) & (np.hypot(x, z) < 0.5)
    now, without = (np.array([sums[part].sum() / found.rays[part].sum() for part in (lid, y < -0.2)])
                    for sums in (found.now, found.without))
    # The lid is lit by all of the sky, the inside by a part of it; the outside is as its targets show it.
    assert 0 < without[0] < 0.7 * now[0]
    assert abs(now[1]) < 0.02 * without[1]
