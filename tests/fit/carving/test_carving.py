"""Carving a cup out of the block that is its hull; and leaving a block, or what has other loops, alone."""

from functools import cache

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from cup import CONFIG, HALF, cup, fit_of, hull_of, solid_block, surface_of
from scipy.spatial import cKDTree

from gshell_mi.fit.carving import carving
from gshell_mi.fit.carving.carving import carve, opacity_and_visibility
from gshell_mi.fit.stages.cavities import volume_inside
from gshell_mi.fit.surface import Surface
from gshell_mi.fit.template import template_of
from gshell_mi.lattice import make_lattice

RESOLUTION = 32
CELL = 2 / RESOLUTION
LATTICE = make_lattice("tet", RESOLUTION)


@pytest.fixture(scope="module")
def subject() -> mi.Shape:
    return mi.load_dict({"type": "gshell", "resolution": RESOLUTION})


@pytest.fixture(scope="module")
def before() -> Surface:
    hull, _, _ = hull_of(RESOLUTION)
    return surface_of(hull, np.ones_like(hull))


@pytest.fixture(scope="module")
def volumes(subject, before):
    """A function that trains a volume on views of a shape; returns a fit and the volume."""

    @cache
    def trained(shape):
        fit = fit_of(subject, shape())
        volume = volume_inside(before, fit, CONFIG.cavities, {})
        for step in range(CONFIG.cavities.iterations):
            volume.step(step)
        return fit, volume

    return trained


@pytest.fixture(scope="module")
def trained(subject, before, volumes):
    """A function that carves the hull of a shape."""

    def run(shape, **fields):
        fit, volume = volumes(shape)
        return subject, before, carve(fit, before.with_fields(**fields), volume)

    return run


def test_the_volume_thins_in_the_cup_and_not_in_its_walls(subject, before, volumes):
    opacity, seen = opacity_and_visibility(volumes(cup)[1], before, subject.to_world)
    within, bottom, deep, outside = (16, 21, 16), (16, 15, 16), (16, 10, 16), (1, 1, 1)
    assert opacity[within] < 0.2 < 0.5 < opacity[bottom]
    assert seen[within] and seen[outside] and not seen[deep]


def test_a_cup_is_found(trained):
    subject, before, carved = trained(cup)
    sdf = carved.fields.sdf.reshape((RESOLUTION + 1,) * 3)
    centre, half_depth = RESOLUTION // 2, round(0.5 * HALF / CELL)
    assert sdf[centre, centre + half_depth, centre] > 0 > sdf[centre, centre - half_depth, centre]
    found = template_of(subject, carved)
    inner = np.abs(found.start).max(axis=1) < HALF - 0.25 * CELL
    truth, _ = trimesh.sample.sample_surface(cup(), 40000, seed=1)
    distance = cKDTree(truth).query(found.start[inner])[0]
    assert inner.sum() > 300 and np.median(distance) < 0.7 * CELL
    np.testing.assert_array_equal(carved.hull, np.maximum(carved.hull, before.hull))


def test_a_block_stays(trained):
    assert trained(solid_block)[2] is None


def test_hollows_have_to_be_justified(trained, rejecting):
    assert trained(cup)[2] is None


def test_openings_that_there_were_stay(trained, monkeypatch):
    """Whatever is said of new ones; the bottom has one here."""
    monkeypatch.setattr(carving, "close_rejected", lambda logits, *_: np.abs(logits))
    _, y, _ = LATTICE.vertex_positions().T
    msdf = np.where(y < -HALF + CELL, -CELL, CELL).astype(np.float32)
    fields = trained(cup, msdf=msdf)[2].fields
    sdf = fields.sdf.reshape((RESOLUTION + 1,) * 3)
    centre = RESOLUTION // 2
    assert sdf[centre, centre + round(0.5 * HALF / CELL), centre] > 0, "carved"
    near = np.abs(fields.sdf) < CELL
    assert (fields.msdf[near & (y < -HALF + 0.5 * CELL)] < 0).mean() > 0.9
    assert (fields.msdf[near & (y > -HALF + 3 * CELL)] > 0).all()


def test_new_parts_are_solid_and_old_ones_keep_their_opacity():
    subject = mi.load_dict({"type": "gshell", "resolution": RESOLUTION})
    hull, _, _ = hull_of(RESOLUTION)
    z = np.repeat(np.linspace(-1, 1, RESOLUTION + 1), (RESOLUTION + 1) ** 2).astype(np.float32)
    surface = surface_of(hull, z * CELL)
    before = template_of(subject, surface)
    hole = 0.3 - np.linalg.norm(subject.lattice.vertex_positions(), axis=1)
    carved = surface.with_fields(sdf=np.maximum(surface.fields.sdf, hole).astype(np.float32))
    after = template_of(subject, carved, like=before)
    inner = np.abs(after.vertices).max(axis=1) < 0.45
    assert inner.any() and after.solid[inner].all()
    np.testing.assert_array_equal(after.solid[~inner], after.vertices[~inner, 2] > 0)


def test_the_shape_may_have_another_lattice_and_stays_as_it_is():
    """As that of a fit with --grid or --resolution has: it comes from the scene's file."""
    subject = mi.load_dict({"type": "gshell", "resolution": 12})
    lattice, hull = subject.lattice, hull_of(RESOLUTION)[0]
    found = template_of(subject, surface_of(hull, np.full_like(hull, 2 * CELL), "cube"))
    assert subject.lattice is lattice
    np.testing.assert_allclose(found.logits, 2, rtol=1e-5)


def test_a_hollow_may_not_eat_into_a_silhouette(trained, monkeypatch):
    """The block carved to the ball inside it: what is gone between them would be sky."""
    axis = np.linspace(-1, 1, RESOLUTION + 1)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    outside_of_ball = (np.sqrt(x**2 + y**2 + z**2) - HALF) / CELL
    monkeypatch.setattr(carving, "hollows", lambda *_: outside_of_ball)
    assert trained(solid_block)[2] is None
