"""Samples that derivatives do not depend on are left out, and only those."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.integrators.camera_samples import not_lost
from gshell_mi.integrators.edge_table import scene_edge_tables
from gshell_mi.integrators.reparameterised_film import Warp, _prepare
from pipelines import gradient_scenes as scenes

SIZE, SPP = 24, 16


class Chosen:
    """What is traced of a moving sphere."""

    def __init__(self, hide_emitters=True, sampler="independent", radius=0.5):
        sensor = {**scenes.camera(SIZE), "sampler": {"type": sampler, "sample_count": SPP}}
        self.scene = scenes.load(
            sensor, scenes.constant(), scenes.make_mesh("subject", *scenes.sphere(3, radius))
        )
        parameters = mi.traverse(self.scene)
        dr.enable_grad(parameters["subject.vertex_positions"])
        parameters.update()
        self.integrator = mi.load_dict({"type": "gshell_path", "hide_emitters": hide_emitters})
        self.sensor = self.scene.sensors()[0]
        with dr.suspend_grad():
            _, self.before, _, self.samples = _prepare(self.integrator, self.scene, self.sensor, 7, SPP)
            self.warp = Warp(
                self.scene, scene_edge_tables(self.scene), self.sensor, self.samples, self.integrator
            )
            self.index, self.traced, self.sampler = not_lost(
                self.integrator, self.scene, self.sensor, self.samples, self.before, self.warp, 7
            )

    def hits(self, samples):
        ray, _ = samples.rays(self.sensor, samples.u)
        return self.scene.ray_intersect_preliminary(ray).is_valid().numpy()


def test_all_that_sees_something_is_kept():
    chosen = Chosen()
    index = chosen.index.numpy()
    assert set(np.flatnonzero(chosen.hits(chosen.samples))) <= set(index)
    assert 100 < len(index) < 0.5 * SIZE**2 * SPP
    np.testing.assert_array_equal(chosen.traced.u.numpy(), chosen.samples.u.numpy()[:, index])


def test_what_is_left_out_does_not_move():
    chosen = Chosen()
    lost = np.setdiff1d(np.arange(SIZE**2 * SPP), chosen.index.numpy())
    assert not chosen.hits(chosen.samples.take(mi.UInt32(lost))).any()
    derivative = []
    for kept in (lost, chosen.index.numpy()):
        positions = mi.traverse(chosen.scene)["subject.vertex_positions"]
        dr.set_grad(positions, 1)
        moved, _ = chosen.warp(chosen.samples.take(mi.UInt32(kept)).u)
        dr.forward_to(moved, flags=dr.ADFlag.ClearInterior)
        derivative.append(np.abs(dr.grad(moved).numpy()).max())
    assert derivative[0] == 0 < derivative[1]


def test_numbers_are_those_of_as_many_samples():
    chosen = Chosen()
    assert dr.width(chosen.sampler.next_1d()) == dr.width(chosen.index)


def test_an_empty_film_keeps_two():
    chosen = Chosen(radius=1e-4)
    assert 2 <= dr.width(chosen.index) < 40 * SPP


@pytest.mark.parametrize("options", [{"hide_emitters": False}, {"sampler": "multijitter"}])
def test_all_are_kept_where_they_count(options):
    chosen = Chosen(**options)
    assert chosen.index is None and chosen.traced is chosen.samples and chosen.sampler is chosen.before
