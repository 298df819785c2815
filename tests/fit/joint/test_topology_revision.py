"""Openings change where the light explains what lies behind the surface better, or does not any more."""

from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from cap import cap

from gshell_mi.fields import sphere
from gshell_mi.fit import FitConfig
from gshell_mi.fit.joint import topology_revision
from gshell_mi.fit.joint.residuals import Residuals
from gshell_mi.fit.joint.topology_revision import TopologyRevision, doubtful
from gshell_mi.fit.judge import Verdict
from gshell_mi.lattice import TetLattice
from gshell_mi.template.msdf import without_specks
from gshell_mi.topology import topology

LATTICE, RADIUS = TetLattice(20), 0.6


# --- doubts


@pytest.mark.parametrize(("share", "error", "rays", "doubted"), [
    (0.03, 2.0, 50.0, True), (0.1, 2.0, 50.0, False), (0.03, 1.0, 50.0, False), (0.03, 2.0, 0.1, False)],
                         ids=["small", "large", "explained not much worse", "hardly seen"])
def test_small_openings_that_show_what_no_image_does_are_doubtful(ball, share, error, rays, doubted):
    up, down = cap(ball, [0, 0, 1], share), cap(ball, [0, 0, -1], 0.03)
    seen = np.where(up, rays, 50.0)
    found = Residuals(seen, seen * np.where(up, error, np.where(down, 0.6, 0.1)), seen)
    result = doubtful(np.where(up | down, -1.0, 1.0), ball.vertices, ball.faces, found)
    np.testing.assert_array_equal(result, up & doubted)


def test_openings_through_which_nothing_is_seen_are_doubtful(ball):
    """Where pixels are covered: however badly the surface is explained, there is nothing that could be."""
    up, down = cap(ball, [0, 0, 1], 0.03), cap(ball, [0, 0, -1], 0.03)
    rays = np.full(len(up), 50.0)
    found = Residuals(rays, rays * np.where(up, 4.0, np.where(down, 2.0, 0.5)), rays)
    result = doubtful(np.where(up | down, -1.0, 1.0), ball.vertices, ball.faces, found)
    np.testing.assert_array_equal(result, up)


# --- the worker


class StillJoint:
    """A joint stage whose steps change nothing."""

    def __init__(self, config: FitConfig):
        self.config, self.stage, self.iterations = config, config.joint, config.iterations
        self.subject = mi.load_dict({"type": "gshell", "resolution": LATTICE.resolution})
        fields = sphere(LATTICE, RADIUS)
        self.subject.set_fields(replace(fields, msdf=(0.45 - fields.lattice.vertex_positions()[:, 2])
                                        .astype(np.float32)))
        self._msdf = self.subject.msdf
        self.geometry = SimpleNamespace(replace=self._replace, frozen=None,
                                        is_explicit=config.model.field == "explicit")
        self.scene = self.integrator = None

    def _replace(self, name, field):
        assert name == "msdf"
        self.subject.msdf = self._msdf = field

    def apply(self, geometry):
        """What parametrises the geometry knows nothing of what ``finish`` has written into the subject."""
        self.subject.msdf = self._msdf
        self.subject.set_fields(self.subject.fields())

    def step(self, iteration):
        self.apply(geometry=True)
        return {}

    def finish(self):
        self.apply(geometry=True)
        self.subject.msdf = without_specks(self.subject.msdf, self.subject.template(), LATTICE,
                                           self.config.topology.min_area)
        self.subject.set_fields(self.subject.fields())

    def seed(self, iteration):
        return iteration

    def cut(self, opened: np.ndarray) -> None:
        """Opens the lattice's vertices, too, that are true."""
        self._replace("msdf", mi.Float(np.where(opened, -0.05, self.subject.msdf.numpy()).astype(np.float32)))

    def height(self) -> float:
        """Of the surface's highest point, which is on its rim."""
        self.apply(geometry=True)
        vertices, _, _ = self.subject.surface.to_numpy()
        return float(vertices[:, 2].max())

    def loops(self) -> int:
        vertices, faces, _ = self.subject.surface.to_numpy()
        return topology(vertices, faces).boundary_loops


@pytest.fixture
def evidence_above(monkeypatch):
    """Says that there is nothing above z = 0.2, or that the side x > 0.5 is explained badly; errors of both
    change by the factor ``later``."""
    said = {"later": 1.0, "empty": 0.4, "doubtful": 0.1}

    def fake(template, scene, integrator, views, pixels, seed, behind):
        x, _, z = template.to_numpy()[0].T
        empty, side = z > 0.2, x > 0.5
        rays, later = np.full(len(z), 50.0), said["later"] if seed else 1.0
        now = np.where(empty, said["empty"] * later, np.where(side, said["doubtful"] * later, 0.1))
        return Residuals(rays, rays * now, rays * np.where(empty, 0.6, 4.0))

    monkeypatch.setattr(topology_revision, "residuals_of", fake)
    return said


CONFIG = FitConfig(iterations=8).changed({"joint.revision": 0.0, "joint.revision_gain": 0.9})


class Says:
    """A judge that finds everything as good as before, or worse."""

    def __init__(self, gain: float):
        self.gain = gain

    def shown(self, mesh):
        return mesh

    def compare(self, before, after, places) -> Verdict:
        assert len(after[1]) < len(before[1]), "something has opened"
        one = np.ones(places[1].max() + 1)
        return Verdict(one, one, self.gain * one, 0.1 * one)


def run(joint: StillJoint, steps: range, state: dict | None = None, gain: float = 0.0) -> TopologyRevision:
    worker = TopologyRevision(joint, None, None, Says(gain), state or {})
    for iteration in steps:
        worker.step(iteration)
    return worker


@pytest.mark.parametrize(("later", "height"), [(0.5, 0.2), (0.95, 0.45)])
def test_growth_stays_if_the_images_are_explained_better(evidence_above, later, height):
    evidence_above["later"] = later
    joint = StillJoint(CONFIG)
    worker = run(joint, range(1))
    assert joint.height() == pytest.approx(0.2, abs=1.5 * LATTICE.spacing), "opened at first, either way"
    # A fit that was interrupted goes on with what the checkpoint kept.
    worker = run(joint, range(1, 8), worker.state())
    assert worker.finish() is (height < 0.4)
    assert joint.height() == pytest.approx(height, abs=1.5 * LATTICE.spacing)
    assert joint.loops() == 1


def test_what_unseen_views_refuse_does_not_grow(evidence_above):
    joint = StillJoint(CONFIG)
    run(joint, range(1), gain=-1.0)
    assert joint.height() == pytest.approx(0.45, abs=1.5 * LATTICE.spacing)


def test_what_has_grown_rests_until_it_is_judged(evidence_above):
    """At the lattice's vertices inside of what has opened; a fit that goes on knows of it."""
    evidence_above["later"] = 0.5
    joint = StillJoint(CONFIG)
    worker = run(joint, range(1))
    frozen, msdf = joint.geometry.frozen.numpy(), joint.subject.msdf.numpy()
    z = LATTICE.vertex_positions()[:, 2]
    opened = (msdf < 0) & (z < 0.45) & (np.abs(joint.subject.fields().sdf) < 0.5 * LATTICE.spacing)
    rim = opened & (z < 0.35)
    assert frozen[opened & ~rim].all() and (opened & ~rim).sum() > 40
    assert 0 < (frozen & rim).sum() < 0.3 * rim.sum()
    assert (msdf[frozen] < 0).all()

    joint.geometry.frozen, state = None, worker.state()
    worker = run(joint, range(1, 4), state)
    np.testing.assert_array_equal(joint.geometry.frozen.numpy(), frozen)
    np.testing.assert_array_equal(worker.state()["frozen"], frozen)
    worker = run(joint, range(4, 5), worker.state())
    assert joint.geometry.frozen is None and "frozen" not in worker.state()


def test_specks_grow_with_the_opening_that_they_belong_to(evidence_above):
    """Noise has cut a few vertices out of what is to open: one opening comes of it, as of the rest."""
    evidence_above["later"] = 0.5
    joint, (x, y, z) = StillJoint(CONFIG), LATTICE.vertex_positions().T
    joint.cut((x > 0.45) & (np.abs(z - 0.35) < 0.06) & (np.abs(y) < 0.06))
    joint.apply(geometry=True)
    assert joint.loops() == 2
    run(joint, range(1))
    assert joint.loops() == 1 and joint.height() == pytest.approx(0.2, abs=1.5 * LATTICE.spacing)


@pytest.mark.parametrize("grows", [False, True])
def test_specks_are_gone_in_the_end(evidence_above, grows):
    """A hole of a vertex below and an island of one above."""
    evidence_above |= {"later": 0.5, "empty": 0.4 if grows else 0.1}
    joint, (x, y, z) = StillJoint(CONFIG), LATTICE.vertex_positions().T
    worker = run(joint, range(8))
    specks = np.hypot(x, y) < 0.6 * LATTICE.spacing
    msdf = np.where(specks, np.where(z < 0, -0.02, 0.02), joint.subject.msdf.numpy())
    joint.geometry.replace("msdf", mi.Float(msdf.astype(np.float32)))
    joint.apply(geometry=True)
    assert topology(*joint.subject.surface.to_numpy()[:2]).components == 2
    worker.finish()
    found = topology(*joint.subject.surface.to_numpy()[:2])
    assert (found.components, found.boundary_loops, found.pinholes) == (1, 1, 0)


def test_growth_that_led_to_other_loops_is_taken_back(evidence_above):
    """As if it should have taken one away, which only undoing it makes right."""
    evidence_above["later"] = 0.5
    joint = StillJoint(CONFIG)
    state = run(joint, range(8)).state() | {"spent": np.array([[1, 0]])}
    assert run(joint, range(0), state).finish() is False
    assert joint.loops() == 1 and joint.height() == pytest.approx(0.45, abs=1.5 * LATTICE.spacing)


def test_growth_that_is_not_to_blame_for_other_loops_stays(evidence_above):
    """An opening at the other end has come of something else."""
    evidence_above["later"] = 0.5
    joint = StillJoint(CONFIG)
    worker = run(joint, range(8))
    below = LATTICE.vertex_positions()[:, 2] + 0.4
    joint.geometry.replace("msdf", mi.Float(np.minimum(joint.subject.msdf.numpy(), below).astype(np.float32)))
    assert worker.finish() is True
    assert joint.loops() == 2 and joint.height() == pytest.approx(0.2, abs=1.5 * LATTICE.spacing)


def met_openings(gone_below: bool) -> tuple[StillJoint, TopologyRevision]:
    """Of two openings one grows, and later a strip between them goes, and more; before the end a third one,
    at the other end, may go."""
    joint, (x, _, z) = StillJoint(CONFIG), LATTICE.vertex_positions().T
    joint.cut(0.8 * x - 0.6 * z > 0.45)
    if gone_below:
        joint.cut(z < -0.5)
    worker = run(joint, range(7))
    assert joint.loops() == 2 + gone_below
    if gone_below:
        closed = np.where(z < -0.35, 0.05, joint.subject.msdf.numpy()).astype(np.float32)
        joint.geometry.replace("msdf", mi.Float(closed))
    joint.cut((x > 0.1) & (z > -0.25))
    joint.apply(geometry=True)
    assert joint.loops() == 1
    return joint, worker


def test_openings_that_have_met_are_parted(evidence_above):
    evidence_above["later"] = 0.5
    joint, worker = met_openings(gone_below=False)
    assert worker.finish() is True
    assert joint.loops() == 2
    above, all_above = (((z > 0.25) & (z < 0.45)).sum() for z in (
        mesh.to_numpy()[0][:, 2] for mesh in (joint.subject.surface, joint.subject.template())))
    assert above < 0.9 * all_above, "not all that had opened comes back"


def test_openings_are_parted_alike_where_loops_elsewhere_have_gone(evidence_above):
    evidence_above["later"] = 0.5
    parted = []
    for gone_below in (False, True):
        joint, worker = met_openings(gone_below)
        assert worker.finish() is True
        assert joint.loops() == 2
        vertices = joint.subject.surface.to_numpy()[0]
        parted.append(vertices[vertices[:, 2] > -0.2])
    np.testing.assert_allclose(*parted, atol=1e-4)


def test_what_comes_apart_on_a_finer_lattice_is_joined(evidence_above):
    """All that has grown closes there, but for a place a cell away from the opening."""
    evidence_above["later"] = 0.5
    worker = run(StillJoint(CONFIG), range(8))
    assert worker.finish() is True
    joint, (x, _, z) = StillJoint(CONFIG.changed({"joint.revision": 1.0})), LATTICE.vertex_positions().T
    joint.cut((x > 0.2) & (z > 0.25) & (z < 0.35))
    joint.apply(geometry=True)
    assert joint.loops() == 2
    assert run(joint, range(8), worker.state()).finish() is True
    assert joint.loops() == 1


@pytest.mark.parametrize("later", [0.5, 1.1])
def test_a_doubtful_opening_stays_shut_if_the_images_are_explained_better(evidence_above, later):
    """The opening at the side is small, and nothing looks like the images through it."""
    evidence_above |= {"later": later, "doubtful": 20.0, "empty": 0.1}
    joint = StillJoint(CONFIG)
    joint.cut(LATTICE.vertex_positions()[:, 0] > 0.55)
    joint.apply(geometry=True)
    assert joint.loops() == 2
    worker = run(joint, range(1))
    assert joint.loops() == 1, "shut at first, either way"
    worker = run(joint, range(1, 8), worker.state())
    assert worker.finish() is (later < 1)
    assert joint.loops() == (1 if later < 1 else 2)


def ball_and_disc(thickness: float, msdf: float, place: float = 0.65) -> StillJoint:
    """An open ball, and beside it, at a place on x, a loose part with that mSDF: a disc or a drum so many
    cells thick."""
    joint, (x, y, z) = StillJoint(CONFIG), LATTICE.vertex_positions().T
    disc = np.maximum(np.hypot(y, z) - 4.5 * LATTICE.spacing,
                      np.abs(x - place) - thickness / 2 * LATTICE.spacing)
    ball = np.linalg.norm([x + 0.35, y, z], axis=0) - RADIUS
    joint.subject.set_fields(replace(joint.subject.fields(), sdf=np.minimum(disc, ball).astype(np.float32)))
    joint.geometry.replace("msdf", mi.Float(np.where(x > 0.3, msdf, 0.45 - z).astype(np.float32)))
    joint.apply(geometry=True)
    return joint


@pytest.mark.parametrize(("thickness", "later", "components", "loops"),
                         [(1.2, 0.5, 2, 2), (4.0, 0.5, 2, 1), (1.2, 1.1, 1, 1)])
def test_a_sheet_that_comes_back_has_one_side(evidence_above, monkeypatch, thickness, later, components,
                                              loops):
    """The disc has been cut away."""
    monkeypatch.setattr(topology_revision, "_SMALL", 0.8)     # as a lattice this coarse needs
    evidence_above |= {"later": later, "doubtful": 20.0, "empty": 0.1}
    joint = ball_and_disc(thickness, -0.05)
    assert joint.loops() == 1
    worker = run(joint, range(7))
    worker = run(joint, range(7, 8), worker.state())
    assert worker.finish() is (later < 1)
    found = topology(*joint.subject.surface.to_numpy()[:2])
    assert (found.components, found.boundary_loops, found.pinholes) == (components, loops, 0)


@pytest.mark.parametrize(("thickness", "loops", "grows"), [(1.2, 2, False), (1.2, 2, True), (4.0, 1, False)])
def test_a_loose_sheet_has_one_side(evidence_above, monkeypatch, thickness, loops, grows):
    """The disc has both. Whether there is anything else to change is of no account."""
    monkeypatch.setattr(topology_revision, "_SMALL", 0.8)
    evidence_above |= {"later": 0.5, "empty": 0.4 if grows else 0.1}
    joint = ball_and_disc(thickness, 0.05)
    assert joint.loops() == 1
    assert run(joint, range(8)).finish() is (True if grows else None)
    assert joint.loops() == loops
    assert (joint.height() < 0.3) == grows
    assert joint.geometry.frozen is None


@pytest.mark.parametrize("thickness", [0.6, 1.0])
def test_the_side_of_a_thin_sheet_that_stays_is_whole(evidence_above, monkeypatch, thickness):
    """Both sides hang on one layer of the lattice's vertices; the mSDF is small, as after many steps."""
    monkeypatch.setattr(topology_revision, "_SMALL", 0.8)
    evidence_above |= {"empty": 0.1}
    joint = ball_and_disc(thickness, 0.1 * LATTICE.spacing, place=0.7)
    run(joint, range(8)).finish()
    vertices, faces, _ = joint.subject.surface.to_numpy()
    disc = faces[vertices[faces][:, :, 0].mean(axis=1) > 0.3]
    area = trimesh.Trimesh(vertices, disc, process=False).area
    assert area == pytest.approx(np.pi * (4.5 * LATTICE.spacing) ** 2, rel=0.3)


@pytest.mark.parametrize("neck", [False, True])
def test_a_loose_sheet_that_closes_opens_in_the_end(evidence_above, monkeypatch, neck):
    """But for a speck, which is noise, or for where the template goes on from its edge."""
    monkeypatch.setattr(topology_revision, "_SMALL", 0.8)
    evidence_above |= {"empty": 0.1}
    joint, cell = ball_and_disc(1.2, 0.05), LATTICE.spacing
    x, y, z = LATTICE.vertex_positions().T
    msdf = np.where(x > 0.3, 0.05, joint.subject.msdf.numpy())
    if neck:
        bar = np.maximum(np.hypot(x - 0.65, z) - 1.1 * cell, np.abs(y - 5.5 * cell) - 2.5 * cell)
        sdf = np.minimum(joint.subject.sdf.numpy(), bar)
        joint.subject.set_fields(replace(joint.subject.fields(), sdf=sdf.astype(np.float32)))
        msdf[(x > 0.3) & (y > 4.8 * cell)] = -0.02
    else:
        msdf[(x > 0.65) & (np.hypot(y, z) < 0.6 * cell)] = -0.02
    worker = run(joint, range(7))
    joint.geometry.replace("msdf", mi.Float(msdf.astype(np.float32)))
    joint.apply(geometry=True)
    found = topology(*joint.subject.surface.to_numpy()[:2])
    assert found.boundary_loops + found.pinholes == 2
    assert worker.finish() is None
    found = topology(*joint.subject.surface.to_numpy()[:2])
    assert (found.components, found.boundary_loops, found.pinholes) == (2, 2, 0)
    assert found.boundary_length > 1.3 * 2 * np.pi * RADIUS


@pytest.mark.parametrize("settings", [{"joint.revision": 1.0}, {"watertight": True},
                                      {"model.field": "hashgrid"}, {"iterations": 1}])
def test_modes_without_it(evidence_above, settings):
    joint = StillJoint(CONFIG.changed(settings))
    worker = run(joint, range(joint.config.iterations))
    assert worker.finish() is None and not worker.state()
    assert joint.height() == pytest.approx(0.45, abs=LATTICE.spacing)
