"""The joint stage with fields in blocks around the surface."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bowl import CLOSED, RADIUS, SHORT

from gshell_mi.fields import LatticeFields, sphere
from gshell_mi.fit import FitConfig
from gshell_mi.fit.__main__ import main
from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint
from gshell_mi.fit.joint.joint import JointStage
from gshell_mi.fit.stages.joint import start_material
from gshell_mi.fit.surface import Seen, Surface
from gshell_mi.lattice import BlockLattice, TetLattice
from gshell_mi.light import EnvironmentLight
from gshell_mi.material import MaterialField
from gshell_mi.scene import load_fit_scene

LATTICE = TetLattice(70)
CONFIG = FitConfig(iterations=10).changed(
    {
        "render.spp": 1,
        "render.primal_spp": 1,
        "render.max_depth": 2,
        "model.light_height": 4,
        "joint.warmup": 0.0,
    }
)


@pytest.fixture(scope="module")
def fit(bowl_scene):
    return load_fit_scene(bowl_scene)


def bowl() -> LatticeFields:
    points = LATTICE.vertex_positions()
    closed = LatticeFields.closed(np.linalg.norm(points, axis=1) - RADIUS)
    return replace(closed, msdf=(0.1 - points[:, 1]).astype(np.float32))


def stage(fit, fields: LatticeFields, settings: dict | None = None) -> JointStage:
    fit.subject.set_fields(fields)
    material = MaterialField(np.full((fields.lattice.vertex_count, 3), 0.5))
    return JointStage(fit, material, EnvironmentLight.uniform(4, 1.0), CONFIG.changed(settings or {}))


def test_a_step_is_that_on_the_whole_lattice(fit):
    """Gradients that are not smoothed do not know how far the lattice goes on."""
    rough = {
        "joint.geometry_smoothing": 1e-12,
        "joint.geometry_detail": 1e-12,
        "joint.material_smoothing": 0.0,
    }
    dense, stored = bowl(), bowl().in_blocks()
    after = {}
    for name, fields in (("dense", dense), ("stored", stored)):
        joint = stage(fit, fields, rough)
        losses = joint.step(0)
        after[name] = (
            losses,
            {
                key: optimizer.state[key]
                for optimizer in joint.optimizers.values()
                for key in optimizer.keys()
            },
        )
    assert after["dense"][0] == pytest.approx(after["stored"][0], rel=1e-4)
    blocks = stored.lattice
    everywhere = {"log_radiance", "shared_roughness", "shared_metallic"}
    for key, (value, _, _, (_, first, second, _)) in after["stored"][1].items():
        expected = after["dense"][1][key]
        for now, then in ((value, expected[0]), (first, expected[3][1]), (second, expected[3][2])):
            then = then if key in everywhere else blocks.take(then)
            inside = blocks.in_lattice(dr.arange(mi.UInt32, blocks.vertex_count)).numpy()
            inside = inside.repeat(dr.width(now) // len(inside)) if key not in everywhere else slice(None)
            scale = np.abs(then.numpy()).max()
            if key in ("sdf", "msdf", "deform") or now is not value:
                np.testing.assert_allclose(now.numpy()[inside], then.numpy()[inside], atol=1e-3 * scale)
    moved = np.abs(after["stored"][1]["sdf"][0].numpy() - stored.sdf)
    assert moved.max() > 0.01 * LATTICE.spacing


def test_blocks_follow_the_surface_with_all_that_is_stored_in_them(fit):
    joint = stage(fit, bowl().in_blocks())
    first = set(joint.subject.lattice.blocks.numpy())
    for iteration in range(5):
        optimizer = joint.geometry.optimizer
        optimizer["sdf"] = optimizer["sdf"] + 2 * LATTICE.spacing
        joint.step(iteration)
        lattice = joint.subject.lattice
        assert lattice.covers(joint.subject.surface.cells)
        geometry = [(optimizer, tuple(optimizer.keys())) for optimizer in joint.geometry.optimizers.values()]
        assert sorted(name for _, names in geometry for name in names) == ["deform", "msdf", "sdf"]
        for optimizer, names in (*geometry, (joint.material_optimizer, joint.material.on_lattice)):
            for name in names:
                value, _, _, (step, moment, _, _) = optimizer.state[name]
                assert dr.width(value) == dr.width(moment) and dr.width(value) % lattice.vertex_count == 0
                assert step[0] == iteration + 1
    assert first <= set(lattice.blocks.numpy())
    radius = np.linalg.norm(joint.subject.surface.to_numpy()[0], axis=1)
    assert np.median(radius) == pytest.approx(RADIUS - 10 * LATTICE.spacing, abs=LATTICE.spacing)
    joint._follow_surface(rescan=True)
    assert not first <= set(joint.subject.lattice.blocks.numpy()), "what the surface has left is dropped"
    joint.step(5)


def test_material_is_carried_to_a_finer_lattice(fit):
    coarse = TetLattice(20)
    points = coarse.vertex_positions()
    known = np.abs(np.linalg.norm(points, axis=1) - 0.6) < 0.25
    colors = np.where(known[:, None], 0.5 + 0.2 * points, 0)
    seen = Seen(colors.astype(np.float32), known, np.float32(1))
    surface = Surface(sphere(coarse), seen=seen)
    blocks = BlockLattice.around(LATTICE, lambda p: dr.norm(p) - 0.6, mi.Float)
    material = start_material(fit, surface, blocks, CONFIG.changed({"model.even_start": False}))
    found = material.values()["vertex_color"].numpy().reshape(-1, 3)
    near = np.abs(dr.norm(blocks.points(mi.Float)).numpy() - 0.6) < 0.05
    expected = 0.5 + 0.2 * blocks.points(mi.Float).numpy().T
    assert near.sum() > 1000
    np.testing.assert_allclose(found[near], expected[near], atol=1e-3)


def test_material_finds_its_place_in_blocks_that_have_moved(fit):
    """A fit that goes on may have other blocks than its stage was given."""
    first, second = (
        BlockLattice.around(LATTICE, lambda p, r=radius: dr.norm(p) - r, mi.Float) for radius in (0.6, 0.65)
    )
    points = first.points(mi.Float).numpy().T
    fields = LatticeFields.closed(np.linalg.norm(points, axis=1) - 0.6, LATTICE.grid)
    fields = replace(fields, blocks=first.blocks.numpy(), block_resolution=LATTICE.resolution)
    model = MaterialField(0.5 + 0.2 * points).parameters
    surface = Surface(fields, model={name: values.numpy() for name, values in model.items()})
    found = start_material(fit, surface, second, CONFIG).values()["vertex_color"].numpy().reshape(-1, 3)
    where = second.points(mi.Float).numpy().T
    both = np.isin(
        second.lattice_vertex(dr.arange(mi.UInt32, second.vertex_count)).numpy(),
        first.lattice_vertex(dr.arange(mi.UInt32, first.vertex_count)).numpy(),
    )
    assert 1000 < both.sum() < len(both)
    np.testing.assert_allclose(found[both], 0.5 + 0.2 * where[both], atol=1e-3)


def test_a_fit_in_blocks_is_resumed(bowl_scene, tmp_path, monkeypatch):
    output = tmp_path / "out"
    command = [
        str(bowl_scene),
        "-o",
        str(output),
        "--quiet",
        *SHORT,
        *CLOSED,
        "--resolution",
        "40",
        "--lattice.start-resolution",
        "16",
        "--lattice.band-resolution",
        "32",
        "--checkpoint-seconds",
        "0",
        "--iterations",
        "2",
        "--detail.iterations",
        "4",
    ]
    step = JointStage.step

    def stopped(self, iteration):
        if iteration == 2:
            raise KeyboardInterrupt
        return step(self, iteration)

    # However long it takes to save one.
    monkeypatch.setattr("gshell_mi.fit.runner._CHECKPOINT_PAUSE", 0)
    monkeypatch.setattr(JointStage, "step", stopped)
    assert main(command) == 130
    monkeypatch.setattr(JointStage, "step", step)
    kept = Checkpoint.load(output / "checkpoint.npz")
    assert (kept.stage, kept.iteration) == ("detail", 2) and len(kept.arrays["sdf"]) == 17**3
    assert len(kept.arrays["work/geometry/sdf/value"]) == len(kept.arrays["work/blocks sdf"]) < 41**3
    assert main([*command, "--resume"]) == 0
    assert (output / "mesh.ply").is_file()
    assert main([*command, "--resume"]) == 0
