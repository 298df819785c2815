"""Exposures on the bowl: found and told where views differ, refused on exact renders, and corrected."""

import dataclasses
import json
import shutil
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from bowl import CLOSED, SHORT
from silent_steps import Silent

from gshell_mi.fit.__main__ import main
from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint
from gshell_mi.fit.stages.exposures import Exposures
from gshell_mi.fit.stages.hull import Hull
from gshell_mi.fit.stages.joint import Joint
from gshell_mi.fit.surface import Surface
from gshell_mi.scene import load_fit_scene

#: Hardly any steps, and no stage between the hull and the joint one but that of the exposures.
QUICK = (*SHORT, *CLOSED, "--iterations", "1", "--cavities.iterations", "0", "--refinement.iterations", "0")


def stops_of(count: int) -> np.ndarray:
    """(N, 3) exposures up to half a stop and white balances; 0 in the mean."""
    rng = np.random.default_rng(5)
    stops = rng.uniform(-0.5, 0.5, (count, 1)) + rng.uniform(-0.1, 0.1, (count, 3))
    return stops - stops.mean(axis=0)


@pytest.fixture(scope="module")
def bowl(exact) -> Surface:
    """The hull, open where the bowl is."""
    hull = Hull(exact.config.hull).run(exact, None, Silent())
    height = hull.lattice.vertex_positions()[:, 1]
    return hull.with_fields(msdf=(-0.05 - height).astype(np.float32))


@pytest.fixture(scope="module")
def stops(exact) -> np.ndarray:
    return stops_of(len(exact.views))


@pytest.fixture(scope="module")
def photographed(bowl_scene, stops, tmp_path_factory) -> Path:
    """The bowl's scene as photographed with those exposures."""
    folder = tmp_path_factory.mktemp("photographed")
    shutil.copytree(bowl_scene.parent, folder, dirs_exist_ok=True)
    for gain, path in zip(2**stops, sorted((folder / "bowl").glob("view_*.exr")), strict=True):
        pixels = np.array(mi.Bitmap(str(path))) * np.append(gain, 1).astype(np.float32)
        mi.Bitmap(pixels).write(str(path))
    return folder / bowl_scene.name


def test_exposures_are_recovered(exact, bowl, photographed, stops):
    steps = Silent()
    fit = dataclasses.replace(exact, scene=load_fit_scene(photographed))
    found = Exposures(fit.config.gains).run(fit, bowl, steps)
    assert steps.facts["exposures_kept"] and found.fields is bowl.fields
    # Few and coarse views: test_gains.py has what more of them tell.
    assert np.sqrt(((np.log2(found.gains) - stops) ** 2).mean()) < 0.45 * np.sqrt((stops**2).mean())
    assert np.log2(found.gains).mean(axis=0) == pytest.approx(0, abs=1e-5)


def test_exact_renders_stay_as_they_are(exact, bowl):
    steps = Silent()
    assert Exposures(exact.config.gains).run(exact, bowl, steps) is bowl
    assert steps.facts["exposures_kept"] is False and len(steps.facts["exposures_verdict"]["gain"]) == 1


def test_corrected_targets_are_those_of_one_exposure(exact, bowl, photographed, stops):
    fit = dataclasses.replace(exact, scene=load_fit_scene(photographed))
    before = fit.pixels
    corrected = fit.corrected(dataclasses.replace(bowl, gains=(2**stops).astype(np.float32)))
    targets = (one.scene.targets for one in (corrected, exact, fit))
    for target, true, given in zip(*targets, strict=True):
        np.testing.assert_allclose(target.rgba, true.rgba, rtol=2e-3, atol=1e-4)
        assert (target.rgba[..., 3] == given.rgba[..., 3]).all()
    assert corrected.pixels.mean_radiance() == pytest.approx(exact.pixels.mean_radiance(), rel=1e-3)
    assert fit.pixels is not before, "the pools of what was given are let go"


@pytest.fixture(scope="module")
def fitted(photographed, tmp_path_factory) -> Path:
    """The folder of a fit, interrupted after its exposures were found, and resumed."""
    output = tmp_path_factory.mktemp("fitted") / "out"
    command = [str(photographed), "-o", str(output), "--quiet", *QUICK]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Joint, "run", _interrupt)
        assert main(command) == 130
    checkpoint = Checkpoint.load(output / "checkpoint.npz")
    assert checkpoint.stage == "joint" and "gains" in checkpoint.arrays

    seen, run = [], Joint.run

    def watched(self, fit, surface, steps):
        seen.append((surface.gains, fit.scene.targets[0].rgba.copy()))
        return run(self, fit, surface, steps)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Joint, "run", watched)
        assert main([*command, "--resume"]) == 0
    ((gains, rgba),) = seen[:1]
    np.testing.assert_array_equal(gains, checkpoint.arrays["gains"])
    given = load_fit_scene(photographed).targets[0].rgba
    np.testing.assert_allclose(rgba[..., :3] * gains[0], given[..., :3], rtol=1e-4, atol=1e-6)
    return output


def _interrupt(*_):
    raise KeyboardInterrupt


def test_metrics_tell_how_views_are_exposed(fitted, stops):
    metrics = json.loads((fitted / "metrics.json").read_text())
    gains = Checkpoint.load(fitted / "checkpoint.npz").arrays["gains"]
    assert metrics["exposures_kept"] is True
    told = metrics["exposures"]
    assert list(told["gains"].values()) == [pytest.approx(list(gain), abs=1e-4) for gain in gains]
    assert list(told["stops"].values()) == pytest.approx(np.log2(gains).mean(axis=1), abs=1e-3)
    assert told["spread_stops"] == pytest.approx(stops.mean(axis=1).std(), abs=0.05)


def test_scores_compare_with_what_was_given(fitted, photographed):
    """With the render exposed as the view is: the triptych's left third is the given target."""
    from gshell_mi.images import triptych

    target = load_fit_scene(photographed).targets[0].rgba
    expected = (triptych(target, target) * 255 + 0.5).astype(np.uint8)
    written = np.array(mi.Bitmap(str(fitted / "views" / "view_000.png")))
    width = target.shape[1]
    assert np.abs(written[:, :width].astype(int) - expected[:, :width]).max() <= 1


def test_kept_exposures(photographed, tmp_path):
    assert (
        main([str(photographed), "-o", str(tmp_path / "out"), "--quiet", *QUICK, "--exposures", "keep"]) == 0
    )
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert "exposures" not in metrics and "exposures_kept" not in metrics
