"""What is open after all, and what is not, is told by the images on the surface that there is."""

from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from cap import cap
from cup import HALF, WALL, capture, cup, solid_block
from scripted_judge import ScriptedJudge
from silent_steps import Silent

from gshell_mi.extraction import extract
from gshell_mi.fields import sphere
from gshell_mi.fit.carving.recesses import recess_depths, sunk
from gshell_mi.fit.judge import Judge
from gshell_mi.fit.stages.revision import Revision, _closed, _moved
from gshell_mi.fit.surface import Surface
from gshell_mi.lattice import TetLattice
from gshell_mi.template.caps import Recesses
from gshell_mi.topology import inner, topology


@pytest.fixture(scope="module")
def opened(fit, hull):
    """What a revision makes of it, and whether it says so."""
    return revised(fit, hull)


def revised(fit, surface):
    steps = Silent()
    return Revision(fit.config.openings).run(fit, surface, steps), steps.facts["openings_changed"]


def loops(fit, surface):
    return topology(*fit.scene.subject.surface_of(surface.fields).to_numpy()[:2])


def cut(fit, surface, cap):
    """The surface with a hole: (N, 3) lattice vertices to (N,) whether they are cut."""
    chosen = cap(surface.lattice.points(mi.Float).numpy().T)
    msdf = np.where(chosen, -surface.lattice.spacing, surface.fields.msdf)
    return surface.with_fields(msdf=msdf.astype(np.float32))


def test_a_lid_opens(fit, hull, opened):
    assert loops(fit, hull).boundary_loops == 0
    found, changed = opened
    assert changed and not found.settled
    assert loops(fit, found).boundary_loops == 1 and loops(fit, found).components == 1
    vertices = fit.scene.subject.surface_of(found.fields).to_numpy()[0]
    assert vertices[:, 1].max() < 0.15 and vertices[:, 1].min() < -0.5


def test_a_hole_closes_and_the_mouth_stays(fit, opened):
    before, _ = opened
    torn = cut(fit, before, lambda points: (np.hypot(points[:, 0], points[:, 2]) < 0.35) & (points[:, 1] < 0))
    assert loops(fit, torn).boundary_loops == 2
    mended, changed = revised(fit, torn)
    assert changed
    assert loops(fit, mended).boundary_loops == 1
    assert loops(fit, mended).boundary_length == pytest.approx(loops(fit, before).boundary_length, rel=0.1)


def test_what_is_right_stays(fit, opened):
    before, _ = opened
    again, _ = revised(fit, before)
    assert loops(fit, again).boundary_loops == 1
    assert loops(fit, again).boundary_length == pytest.approx(loops(fit, before).boundary_length, rel=0.05)


def test_a_bulge_that_is_open_closes_without_it(fit, opened):
    """Its cap, where it is, explains the images no better than the hole; what goes on around it does."""
    before, _ = opened
    lattice = before.lattice
    points = lattice.points(mi.Float).numpy().T
    lowest = vertices_of(fit, before)[:, 1].min()
    bulge = np.linalg.norm(points - [0, lowest, 0], axis=1) - 2.2 * lattice.spacing
    torn = cut(fit, before, lambda points: bulge < 1.5 * lattice.spacing)
    torn = torn.with_fields(sdf=np.minimum(torn.fields.sdf, bulge).astype(np.float32))
    assert loops(fit, torn).boundary_loops == 2
    mended, _ = revised(fit, torn)
    assert loops(fit, mended).boundary_loops == 1
    assert vertices_of(fit, mended)[:, 1].min() == pytest.approx(lowest, abs=lattice.spacing)


@pytest.mark.parametrize(("better", "stays"), [(0.03, False), (0.08, True)])
def test_an_opening_has_to_explain_more_by_its_noise(better, stays):
    """By 0.6 and by 1.6 standard errors."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    opened = cap(ball, [0, 0, 1], 0.1)
    judge = ScriptedJudge(len(ball.vertices), lambda opaque: np.exp(np.where(opaque, better, 0.0)))
    values = np.where(opened, -1.0, 1.0)
    closed = _closed(judge, judge.shown((ball.vertices, ball.faces)), values, np.full(len(values), -1))
    np.testing.assert_array_equal(closed <= 0, opened & stays)


@pytest.mark.parametrize(("better", "stays"), [(0.5, True), (-0.5, False)])
def test_the_rim_of_an_opening_does_not_speak_for_it(better, stays):
    """A slit of which all but the middle explains more than its cap; its middle explains more or less."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    x, y, z = ball.vertices.T
    slit = (z > 0) & (np.abs(y) < 0.7) & (np.abs(x) < 0.13)
    middle = inner(slit, ball.faces)
    assert 0 < middle.sum() < slit.sum() / 2
    worse = np.where(middle, better, 2.0)
    judge = ScriptedJudge(len(ball.vertices), lambda opaque: np.exp(np.where(opaque, worse, 0.0)))
    template, values = judge.shown((ball.vertices, ball.faces)), np.where(slit, -1.0, 1.0)
    found = _closed(judge, template, values, np.full(len(values), -1))
    np.testing.assert_array_equal(found <= 0, slit & stays)


@pytest.mark.parametrize("backed", ["all", "half"])
def test_the_open_side_of_a_sheet_does_not_speak_for_its_cap(backed):
    """Its cap explains more; where a sheet has its other side behind, that is no wonder."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    opened, half = cap(ball, [0, 0, 1], 0.1), ball.vertices[:, 0] > 0
    sheet = opened & (half if backed == "half" else True)
    error = np.where(half, 3.0, 0.3)
    judge = ScriptedJudge(len(ball.vertices), lambda opaque: np.where(opaque, 1.0, error))
    template, values = judge.shown((ball.vertices, ball.faces)), np.where(opened, -1.0, 1.0)
    below = int(ball.vertices[:, 2].argmin())
    np.testing.assert_array_equal(_closed(judge, template, values, np.where(sheet, below, -1)), values)
    closed = _closed(judge, template, values, np.full(len(values), -1))
    np.testing.assert_array_equal(closed, np.abs(values))


def vertices_of(fit, surface):
    """(V, 3) vertices of the surface."""
    return fit.scene.subject.surface_of(surface.fields).to_numpy()[0]


@pytest.mark.parametrize(("floor", "wall"), [(0.0, WALL), (-0.57, 0.03)])
def test_what_lies_half_way_is_a_recess_and_what_lies_behind_is_seen_through_an_opening(floor, wall):
    """A block that is a cup in truth, whose floor is in its middle, or its bottom."""
    views, _, targets = capture(cup(floor, wall))
    judge = Judge(views, targets, Judge.halves(len(views)), batch=16384)
    side = 0.06
    vertices, faces = trimesh.remesh.subdivide_to_size(solid_block().vertices, solid_block().faces, side)
    lid = (vertices[:, 1] > HALF - 1e-6) & (np.abs(vertices[:, [0, 2]]) < HALF - wall).all(axis=1)
    place, closed = np.where(lid, 0, -1), np.ones(len(vertices))
    recesses = Recesses(vertices, faces, place)
    depth, least = recess_depths(
        judge, judge.shown((vertices, faces)), recesses, closed, np.where(lid, -1, closed), place, side
    )
    if floor == 0:
        assert recesses.at(depth)[lid, 1].min() == pytest.approx(floor, abs=0.15) and least[0] < 0
    else:
        assert least[0] > 0


def test_what_is_filled_sinks_where_something_is_proposed():
    """The lid of a block that is a cup in truth, its floor in the middle, and a side of it that is right."""
    views, _, targets = capture(cup(0.0, WALL))
    judge = Judge(views, targets, Judge.halves(len(views)), batch=16384)
    config = SimpleNamespace(topology=SimpleNamespace(min_area=0.001))
    side = 0.06
    vertices, faces = trimesh.remesh.subdivide_to_size(solid_block().vertices, solid_block().faces, side)
    lid = (vertices[:, 1] > HALF - 1e-6) & (np.abs(vertices[:, [0, 2]]) < HALF - WALL).all(axis=1)
    wall = (vertices[:, 0] > HALF - 1e-6) & (np.abs(vertices[:, 1:]) < HALF - WALL).all(axis=1)
    template, closed = judge.shown((vertices, faces)), np.ones(len(vertices))
    fit = SimpleNamespace(outline_judge=judge, config=config)
    moved = sunk(fit, template, closed, np.where(lid | wall, -1.0, 1.0), side)
    assert moved[lid, 1].min() == pytest.approx(0, abs=0.15)
    np.testing.assert_array_equal(moved[~lid], vertices[~lid])
    np.testing.assert_array_equal(sunk(fit, template, closed, closed, side), vertices)
    # What has opened stays as it is.
    opened = np.where(lid, -1.0, 1.0)
    np.testing.assert_array_equal(sunk(fit, template, opened, opened, side), vertices)


@pytest.mark.parametrize("recess", [False, True])
def test_what_a_recess_explains_as_well_does_not_open(fit, hull, monkeypatch, recess):
    """The lid, if a recess in it were as good as what is seen through it, and better than the lid, or not."""
    given = Judge.compare

    def compare(self, before, after, label=None, where=None):
        verdict = given(self, before, after, label, where)
        if before.shown is after.shown:
            return verdict
        better = np.abs(verdict.gain) + 3 * verdict.noise
        return replace(verdict, gain=better if recess and where is before.shown else -better)

    monkeypatch.setattr(Judge, "compare", compare)
    found, changed = revised(fit, hull)
    assert not changed and loops(fit, found).boundary_loops == 0
    before, after = (vertices_of(fit, surface)[:, 1].max() for surface in (hull, found))
    assert after == before if not recess else not found.settled and after < before


def test_a_surface_in_blocks_moves_farther_than_they_reach():
    """A cap of a ball goes down by more cells than there are around it; colours stay where they are."""
    ball = sphere(TetLattice(64), 0.6).in_blocks()
    color = ball.lattice.points(mi.Float).x.numpy().repeat(3)
    surface = Surface(ball, model={"vertex_color": color, "log_radiance": np.zeros(7)})
    fit = SimpleNamespace(
        scene=SimpleNamespace(subject=SimpleNamespace(to_world=mi.ScalarTransform4f())),
        cell=lambda surface: surface.lattice.spacing,
    )
    vertices, faces, _ = extract(ball.lattice, mi.Float(ball.sdf)).to_numpy()
    place = np.where(vertices[:, 2] > 0.45, 0, -1)
    recessed = Recesses(vertices, faces, place).at(10 * ball.lattice.spacing)
    found = _moved(fit, surface, vertices, recessed, faces, np.ones(len(vertices)))
    again = extract(found.lattice, mi.Float(found.fields.sdf)).to_numpy()[0]
    middle = (np.hypot(again[:, 0], again[:, 1]) < 0.05) & (again[:, 2] > 0)
    np.testing.assert_allclose(
        again[middle, 2], 0.6 - 10 * ball.lattice.spacing, atol=0.2 * ball.lattice.spacing
    )
    assert found.lattice.vertex_count < ball.lattice.lattice.vertex_count
    kept = ball.lattice.take(found.lattice.spread_out(mi.Float(found.model["vertex_color"])))
    stays = (np.abs(ball.sdf) < ball.lattice.spacing) & (ball.lattice.points(mi.Float).z.numpy() < 0.4)
    np.testing.assert_array_equal(kept.numpy().reshape(-1, 3)[stays], color.reshape(-1, 3)[stays])
    assert found.model["log_radiance"].shape == (7,)
