"""A step of the joint stage compiles nothing, whatever the surface's sizes have become."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from gshell_mi import extras  # noqa: F401 registers losses
from gshell_mi.fields import LatticeFields
from gshell_mi.fit import FitConfig
from gshell_mi.fit.joint.joint import JointStage
from gshell_mi.fit.stages.joint import start_light, start_material
from gshell_mi.fit.surface import Seen, Surface
from gshell_mi.lattice import make_lattice
from gshell_mi.scene import load_fit_scene

#: Losses over the surface, whose size changes, that the defaults leave out.
LOSSES = {
    "hole_opening": 1e-3,
    "hole_closing": 1e-3,
    "sdf_sign": 1e-3,
    "eikonal": 1e-3,
    "normal_variation": 1e-3,
}
CONFIG = FitConfig(iterations=100).changed(
    {
        "lattice.band_resolution": 99,
        "joint.warmup": 0.0,
        "joint.geometry_lr": 0.6,
        "render.views": 2,
        "render.spp": 2,
        "render.primal_spp": 2,
        "model.light_height": 8,
    }
)


@pytest.mark.parametrize(
    ("grid", "settings"),
    [
        ("flexicubes", {}),
        ("tet", {}),
        ("flexicubes", {"losses.extra": LOSSES}),
        ("flexicubes", {"render.reparam_depth": 2}),
    ],
    ids=["flexicubes", "tet", "losses", "shadows"],
)
def test_a_step_compiles_nothing(bowl_scene, grid, settings):
    lattice, config = make_lattice(grid, 18), CONFIG.changed(settings)
    fit = load_fit_scene(bowl_scene)
    points = lattice.vertex_positions()
    closed = LatticeFields.closed((np.linalg.norm(points, axis=1) - 0.6).astype(np.float32), grid)
    fit.subject.set_fields(replace(closed, msdf=(0.1 - points[:, 1]).astype(np.float32)))
    seen = Seen(np.full((len(points), 3), 0.3, np.float32), np.full(len(points), True), np.float32(0.5))
    surface = Surface(closed, seen=seen)
    material, light = start_material(fit, surface, lattice, config), start_light(fit, surface, config)
    joint = JointStage(fit, material, light, config)

    counts, launched, compiled = set(), 0, []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for step in range(36):
            dr.kernel_history_clear()
            joint.step(step)
            kernels = dr.kernel_history([dr.KernelType.JIT])
            if step >= 12:
                counts.add(fit.subject.surface.vertex_count)
                launched += len(kernels)
                # A kernel from the cache in memory was neither compiled nor loaded from disk.
                compiled.append([k["size"] for k in kernels if not k["cache_hit"] or k["cache_disk"]])
    assert len(counts) > 6, "the sizes must change for this to mean something"
    assert launched > 500
    # A few kernels come in variants, the rarer of which may turn up late; a size that was part of a kernel
    # would compile it in most steps.
    assert sum(bool(sizes) for sizes in compiled) <= 3, compiled
