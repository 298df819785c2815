"""Poses of the bowl: corrected where they are wrong, kept where they are right or told to be, and told of."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from bowl import CLOSED, RADIUS, SHORT
from scipy.spatial.transform import Rotation
from silent_steps import Silent

from gshell_mi.calibration.corrections import Corrections
from gshell_mi.export.stock_scene import write_scene
from gshell_mi.fit.__main__ import main
from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint
from gshell_mi.fit.cameras.held_out import held_out_views
from gshell_mi.fit.cameras.laying import Laying
from gshell_mi.fit.judge import Verdict
from gshell_mi.fit.stage import Fit
from gshell_mi.fit.stages.poses import Poses
from gshell_mi.fit.surface import Surface
from gshell_mi.scene import load_fit_scene
from gshell_mi.scene_files import load_scene
from gshell_mi.views import PinholeViews

#: About where the bowl is.
POINTS = 0.5 * np.random.default_rng(0).normal(size=(50, 3))


@pytest.fixture(scope="module")
def bowl(exact) -> Surface:
    """As it is."""
    fields, scale = exact.scene.subject.fields(), exact.scene.subject.length_scale
    points = fields.lattice.vertex_positions()
    distance = np.linalg.norm(points, axis=1) - RADIUS / scale
    return Surface(fields).with_fields(
        sdf=distance.astype(np.float32), msdf=(-points[:, 1]).astype(np.float32)
    )


@pytest.fixture(scope="module")
def errors(exact) -> Corrections:
    """Two degrees: a pixel of these small images is 0.7."""
    rng, count = np.random.default_rng(2), len(exact.views)
    return Corrections(np.radians(2) * rng.normal(size=(count, 3)) / np.sqrt(3), np.zeros((count, 3)))


@pytest.fixture(scope="module")
def wrong(exact, errors) -> Fit:
    """The same images, taken for those of cameras that are wrong."""
    scene = dataclasses.replace(exact.scene, sensors=errors.sensors(exact.scene.sensors))
    return Fit(scene, exact.config, exact.lattices)


def left(found: PinholeViews, exact: PinholeViews) -> np.ndarray:
    """(N,) errors in pixels, but for what all cameras have in common."""
    change = Corrections(_turns(found, exact), found.origins - exact.origins).as_given(exact)
    return change.in_pixels(exact, POINTS)


def off(found: PinholeViews, exact: PinholeViews) -> np.ndarray:
    """(N,) errors in pixels."""
    return Corrections(_turns(found, exact), found.origins - exact.origins).in_pixels(exact, POINTS)


def _turns(found: PinholeViews, exact: PinholeViews) -> np.ndarray:
    return Rotation.from_matrix(found.bases @ np.linalg.inv(exact.bases)).as_rotvec()


def test_wrong_poses_are_corrected(exact, wrong, bowl):
    steps = Silent()
    found = Poses("poses", exact.config.cameras).run(wrong, bowl, steps)
    assert steps.facts["poses_kept"] and found.fields is bowl.fields
    corrected = wrong.corrected(found)
    assert corrected.scene.targets == wrong.scene.targets
    assert np.median(left(corrected.views, exact.views)) < 0.4 * np.median(left(wrong.views, exact.views))
    told = steps.facts["poses"]
    assert list(told["views"]) == list(exact.views.ids)
    mean_square = np.mean([view["pixels"] ** 2 for view in told["views"].values()])
    assert np.sqrt(mean_square) == pytest.approx(steps.facts["poses_verdict"]["pixels"], abs=1e-3)
    assert all(view["degrees"] < 10 for view in told["views"].values())


def test_corrected_poses_are_corrected_further(exact, wrong, errors, bowl):
    """What is told of them is told of those that were given."""
    half = Corrections(-0.5 * errors.rotations, errors.shifts).as_given(wrong.views)
    started, steps = dataclasses.replace(bowl, poses=half.to_array()), Silent()
    found = Poses("alignment", exact.config.cameras).run(wrong.corrected(started), started, steps)
    assert steps.facts["alignment_kept"]
    corrected = wrong.corrected(found)
    assert np.median(left(corrected.views, exact.views)) < 0.4 * np.median(left(wrong.views, exact.views))
    told = [view["degrees"] for view in steps.facts["poses"]["views"].values()]
    np.testing.assert_allclose(told, np.degrees(np.linalg.norm(found.poses[:, :3], axis=1)), atol=1e-4)


def test_last_cameras_lie_on_the_surface(exact, bowl):
    """Even if all of them have to move alike; where the surface is fitted again, they stay in the mean."""
    shift = np.full(len(exact.views), 0.06)[:, None] * [1.0, 0.0, 0.0]
    moved = Corrections(np.zeros_like(shift), shift)
    scene = dataclasses.replace(exact.scene, sensors=moved.sensors(exact.scene.sensors))
    fit = Fit(scene, exact.config, exact.lattices)
    before, left = off(fit.views, exact.views), []
    for last in (False, True):
        found = Poses("poses", exact.config.cameras, last=last).run(fit, bowl, Silent())
        left.append(np.median(off(fit.corrected(found).views, exact.views) / before))
    assert left[0] > 0.7 and left[1] < 0.3


def test_without_a_surface_poses_stay(exact, bowl):
    nothing = bowl.with_fields(msdf=-np.ones_like(bowl.fields.msdf))
    assert Poses("poses", exact.config.cameras).run(exact, nothing, Silent()) is nothing


def test_held_out_views_are_laid_on_the_surface_if_the_others_were(exact, wrong, bowl):
    held_out, kept = wrong.scene.training[::3], np.arange(len(wrong.views)) % 3 > 0
    chosen = [index for index, keep in enumerate(kept) if keep]
    scene = dataclasses.replace(
        exact.scene,
        sensors=[exact.scene.sensors[index] for index in chosen],
        targets=[exact.scene.targets[index] for index in chosen],
        held_out=held_out,
    )
    fit = Fit(scene, exact.config, exact.lattices)
    assert held_out_views(fit, bowl) == []
    moved = dataclasses.replace(bowl, poses=np.zeros((len(chosen), 6)))
    assert held_out_views(dataclasses.replace(fit, scene=wrong.scene), moved) == []
    laid = held_out_views(fit, moved)
    assert [view.sensor.id() for view in laid] == [view.sensor.id() for view in held_out]
    assert [view.target for view in laid] == [view.target for view in held_out]
    true = PinholeViews.from_sensors(exact.scene.sensors[::3])
    given, found = (PinholeViews.from_sensors([view.sensor for view in views]) for views in (held_out, laid))
    assert np.median(off(found, true)) < 0.4 * np.median(off(given, true))


def test_exact_poses_stay(exact, bowl):
    steps = Silent()
    assert Poses("poses", exact.config.cameras).run(exact, bowl, steps) is bowl
    assert steps.facts["poses_kept"] is False and "poses" not in steps.facts


@pytest.mark.parametrize("last", [False, True])
def test_a_single_wrong_camera_is_corrected_alone(exact, errors, bowl, monkeypatch, last):
    """If its own image says so; all views together say nothing of it."""
    count = len(exact.views)
    alone = np.arange(count) == 5
    zero, one = np.zeros(count), np.ones(count)
    told = Verdict(zero[:1], zero[:1], zero[:1], one[:1]), Verdict(zero, zero, np.where(alone, 9.0, 0), one)
    monkeypatch.setattr(Laying, "verdicts", lambda self: told)
    wrong = Corrections(np.where(alone[:, None], errors.rotations, 0), errors.shifts)
    scene = dataclasses.replace(exact.scene, sensors=wrong.sensors(exact.scene.sensors))
    fit, steps = Fit(scene, exact.config, exact.lattices), Silent()
    found = Poses("poses", exact.config.cameras, last=last).run(fit, bowl, steps)
    assert steps.facts["poses_verdict"]["cameras"] == 1
    assert np.flatnonzero(np.abs(found.poses).sum(axis=1)).tolist() == [5]
    assert off(fit.corrected(found).views, exact.views)[5] < 0.4 * off(fit.views, exact.views)[5]


def test_without_masks_poses_stay(exact, wrong, bowl):
    bare = [dataclasses.replace(target, has_alpha=False) for target in wrong.scene.targets]
    fit = Fit(dataclasses.replace(wrong.scene, targets=bare), wrong.config, wrong.lattices)
    assert Poses("poses", exact.config.cameras).run(fit, bowl, Silent()) is bowl


def test_a_surface_keeps_poses(bowl, errors):
    surface = dataclasses.replace(bowl, poses=errors.to_array())
    np.testing.assert_array_equal(Surface.from_arrays(surface.to_arrays()).poses, surface.poses)


#: Hardly any steps.
QUICK = (
    *SHORT,
    *CLOSED,
    "--iterations",
    "2",
    "--cavities.iterations",
    "0",
    "--refinement.iterations",
    "0",
    "--detail.iterations",
    "2",
    "--exposures",
    "keep",
)


def test_a_fit_exports_the_cameras_that_it_found(bowl_scene, exact, wrong, tmp_path, monkeypatch):
    """And a fit that is resumed after they were found goes on with them."""
    given = tmp_path / "given.xml"
    text = bowl_scene.read_text()
    start, end = text.index("<sensor"), text.rindex("</sensor>") + len("</sensor>")
    write_scene(tmp_path / "sensors.xml", exact.scene.light, wrong.scene.sensors)
    moved = (tmp_path / "sensors.xml").read_text()
    moved = moved[moved.index("<sensor") : moved.rindex("</sensor>") + len("</sensor>")]
    given.write_text(text[:start] + moved + text[end:])
    output, targets = tmp_path / "out", str(bowl_scene.with_suffix(""))
    command = [str(given), "--targets", targets, "-o", str(output), "--quiet", *QUICK]
    corrections = Corrections(np.full((len(exact.views), 3), [0, 0.01, 0]), np.zeros((len(exact.views), 3)))
    corrections.rotations[::2] *= -1

    def found(self, fit, surface, steps):
        return dataclasses.replace(surface, poses=corrections.to_array())

    def interrupted(self, fit, surface, steps):
        raise KeyboardInterrupt

    from gshell_mi.fit.stages.texture import Texture

    monkeypatch.setattr(Poses, "run", found)
    with monkeypatch.context() as patch:
        patch.setattr(Texture, "run", interrupted)
        assert main([*command, "--texture.rounds", "1"]) == 130
    assert Checkpoint.load(output / "checkpoint.npz").arrays["poses"].shape == (len(exact.views), 6)
    seen, run = [], Texture.run

    def watched(self, fit, surface, steps):
        seen.append(fit.views)
        return run(self, fit, surface, steps)

    monkeypatch.setattr(Texture, "run", watched)
    assert main([*command, "--texture.rounds", "1", "--resume"]) == 0
    expected = corrections.views(PinholeViews.from_sensors(load_fit_scene(given, Path(targets)).sensors))
    for views in (seen[0], PinholeViews.from_sensors(load_scene(output / "scene.xml").sensors())):
        np.testing.assert_allclose(views.bases, expected.bases, atol=1e-5)


def test_kept_poses(bowl_scene, tmp_path):
    assert main([str(bowl_scene), "-o", str(tmp_path / "out"), "--quiet", *QUICK, "--poses", "keep"]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert "poses" not in metrics and "poses_kept" not in metrics
