"""Bumps that no view asks for go; those that views see stay."""

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from cup import HALF, fit_of, solid_block, surface_of
from silent_steps import Silent

from gshell_mi.fit.stages.smoothing import Smoothing, SmoothingConfig
from gshell_mi.topology import topology

RESOLUTION = 32
CELL = 2 / RESOLUTION
#: Of bumps, in cells: those of noise, and those that there are.
LOW, HIGH = 0.5, 1.5


@pytest.fixture(scope="module")
def subject() -> mi.Shape:
    return mi.load_dict({"type": "gshell", "resolution": RESOLUTION})


@pytest.fixture(scope="module")
def flat(subject):
    points = subject.lattice.points(mi.Float).numpy()
    return np.abs(points).max(axis=0) - HALF


def bumpy(subject, flat, height):
    points = subject.lattice.points(mi.Float).numpy() / CELL
    waves = np.sin(1.3 * points + np.array([[0.3], [1.1], [2.0]])).prod(axis=0)
    return flat + height * CELL * waves / np.abs(waves).max()


def smoothed(subject, sdf, shape, most=0.8):
    """What becomes of a surface in views of a shape: its vertices, and what the stage tells."""
    steps, surface = Silent(), surface_of(sdf, np.ones_like(sdf))
    found = Smoothing(SmoothingConfig(most)).run(fit_of(subject, shape), surface, steps)
    return surface, found, steps.facts


def off(subject, surface) -> float:
    """Mean distance from the block, in cells."""
    vertices, _, _ = subject.surface_of(surface.fields).to_numpy()
    return np.abs(np.abs(vertices).max(axis=1) - HALF).mean() / CELL


def test_bumps_of_what_is_flat_go(subject, flat):
    before, after, facts = smoothed(subject, bumpy(subject, flat, LOW), solid_block())
    assert facts["smoothed_cells"] >= 0.4
    assert off(subject, after) < 0.6 * off(subject, before)
    counts = topology(*subject.surface_of(after.fields).to_numpy()[:2])
    assert (counts.components, counts.boundary_loops, counts.pinholes) == (1, 0, 0)


def test_bumps_that_there_are_stay(subject, flat):
    rough = bumpy(subject, flat, HIGH)
    vertices, faces, _ = subject.surface_of(surface_of(rough, np.ones_like(rough)).fields).to_numpy()
    before, after, facts = smoothed(subject, rough, trimesh.Trimesh(vertices, faces, process=False))
    assert after is before and facts["smoothed_cells"] == 0
    assert len(facts["smoothing_verdicts"]) == 1 and facts["smoothing_verdicts"][0]["gain"][0] < 0


def test_what_is_flat_stays(subject, flat):
    before, after, _ = smoothed(subject, flat, solid_block())
    assert off(subject, after) < off(subject, before) + 0.02
