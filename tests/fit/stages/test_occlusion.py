"""What one mask of the bowl denies and all others show is found, and nothing where all masks are right."""

import dataclasses
import json

import numpy as np
import pytest
from bowl import CLOSED, SHORT
from silent_steps import Silent

from gshell_mi.fit import FitConfig
from gshell_mi.fit.__main__ import main
from gshell_mi.fit.stage import Fit
from gshell_mi.fit.stages.hull import Hull
from gshell_mi.fit.stages.occlusion import Occlusion
from gshell_mi.fit.surface import Surface
from gshell_mi.packed_pixels import unpacked

#: Hides a part of the bowl: rows from the middle on, in these columns.
VIEW, COLUMNS = 5, slice(0, 48)


@pytest.fixture(scope="module")
def hidden(exact) -> np.ndarray:
    """(height, width) what a stand hides in one view."""
    covered = exact.scene.targets[VIEW].rgba[..., 3] > 0.5
    pixels = np.zeros_like(covered)
    pixels[len(covered) // 2 :, COLUMNS] = True
    assert (pixels & covered).sum() > 60
    return pixels


@pytest.fixture(scope="module")
def occluded(exact, hidden) -> Fit:
    targets = list(exact.scene.targets)
    targets[VIEW] = dataclasses.replace(targets[VIEW], rgba=targets[VIEW].rgba * ~hidden[..., None])
    return Fit(dataclasses.replace(exact.scene, targets=targets), exact.config, exact.lattices)


def start(fit: Fit) -> Surface:
    return Surface(fit.scene.subject.fields())


def test_what_a_stand_hides_is_ignored(exact, occluded, hidden):
    steps = Silent()
    found = Occlusion(FitConfig().occlusion).run(occluded, start(occluded), steps)
    ignored = unpacked(found.ignored, occluded.views.sizes)
    truly = hidden & (exact.scene.targets[VIEW].rgba[..., 3] > 0.5)
    assert (ignored[VIEW] & truly).sum() > 0.6 * truly.sum()
    assert sum(pixels.sum() for pixels in ignored) < 1.5 * ignored[VIEW].sum()
    assert steps.facts["occluded_views"] >= 1 and max(steps.facts["occlusion_verdict"]["gain"]) > 0
    # The hull that follows is about as large as without the stand, where less is known a little larger.
    sizes = [
        int((Hull(fit.config.hull).run(fit, None, Silent()).fields.sdf < 0).sum())
        for fit in (exact, occluded, occluded.corrected(found))
    ]
    assert sizes[1] < 0.9 * sizes[0] and 0.97 * sizes[0] < sizes[2] < 1.3 * sizes[0]


def test_right_masks_are_believed(exact):
    before, steps = start(exact), Silent()
    assert Occlusion(FitConfig().occlusion).run(exact, before, steps) is before
    assert steps.facts["occluded_views"] == 0


def test_without_masks_nothing_is_denied(occluded):
    bare = [dataclasses.replace(target, has_alpha=False) for target in occluded.scene.targets]
    fit = Fit(dataclasses.replace(occluded.scene, targets=bare), occluded.config, occluded.lattices)
    before = start(fit)
    assert Occlusion(FitConfig().occlusion).run(fit, before, Silent()) is before


def test_what_was_found_of_the_views_is_carried_on(exact):
    before = dataclasses.replace(start(exact), ignored=np.array([7], np.uint8), gains=np.ones((12, 3)))
    after = dataclasses.replace(start(exact), gains=np.full((12, 3), 2.0)).after(before)
    assert after.ignored is before.ignored and after.gains[0, 0] == 2 and after.poses is None
    assert Surface.from_arrays(after.to_arrays()).ignored.tolist() == [7]
    assert after.tells_the_same(dataclasses.replace(after, hull=np.zeros(3)))
    assert not after.tells_the_same(before)


def test_a_fit_goes_on_without_what_is_ignored(bowl_scene, tmp_path, monkeypatch):
    ignored, seen = np.packbits(np.arange(12 * 48 * 48) % 48 < 24), []

    def found(self, fit, surface, steps):
        return dataclasses.replace(surface, ignored=ignored)

    run = Hull.run

    def watched(self, fit, surface, steps):
        seen.append([np.asarray(target.known) for target in fit.scene.targets])
        return run(self, fit, surface, steps)

    monkeypatch.setattr(Occlusion, "run", found)
    monkeypatch.setattr(Hull, "run", watched)
    output = tmp_path / "out"
    assert (
        main(
            [
                str(bowl_scene),
                "-o",
                str(output),
                "--quiet",
                *SHORT,
                *CLOSED,
                "--iterations",
                "1",
                "--occlusion.most",
                "0.1",
            ]
        )
        == 0
    )
    for known in seen[0]:
        assert (known[:, :24] == 0).all() and (known[:, 24:] == 1).all()
    assert json.loads((output / "metrics.json").read_text())["config"]["occlusion"]["most"] == 0.1


def test_masks_that_have_nothing_in_common_are_left_to_the_hull(exact):
    """Half of the masks are empty: there is no hull, and none that disbelieves a tenth."""
    targets = [
        dataclasses.replace(target, rgba=target.rgba * np.float32(index % 2))
        for index, target in enumerate(exact.scene.targets)
    ]
    fit = Fit(dataclasses.replace(exact.scene, targets=targets), exact.config, exact.lattices)
    before = start(fit)
    assert Occlusion(FitConfig().occlusion).run(fit, before, Silent()) is before
