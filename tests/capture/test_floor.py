"""What the floor tells of where an object is."""

from dataclasses import replace

import numpy as np
import photographed
import pytest

from gshell_mi.capture.camera import Distortion
from gshell_mi.capture.floor import _directions, floor_evidence
from gshell_mi.capture.segmentation import View, cut_out
from gshell_mi.capture.subject import Subject, find_subject

pytest.importorskip("cv2", reason="needs the extra 'masks'")


@pytest.fixture(scope="module")
def plain():
    """Cameras, photographs and true masks of a ball without any texture."""
    cameras = photographed.cameras(16)
    images, masks = zip(*(photographed.photograph(camera, plain=True) for camera in cameras), strict=True)
    return cameras, images, masks


@pytest.fixture(scope="module")
def subject(plain) -> Subject:
    """Found from points on the table alone; the plain ball has none."""
    points = photographed.points()
    few = np.flatnonzero(points[:, 1] > 0.1)[::3]
    table = points[points[:, 1] < 1e-6]
    found = find_subject(plain[0], np.concatenate([table, points[few]]))
    return replace(found, points=found.points[:0])


def test_floor_is_told_from_what_is_before_it(plain, subject):
    cameras, images, masks = plain
    evidence = np.stack(floor_evidence(images, cameras, subject))
    table, ball = np.stack(masks) == 0, np.stack(masks) == 1
    # The rest of either has too little of a pattern behind it, or lies at an outline.
    assert (evidence[table] < 0).mean() > 0.3 and (evidence[table] > 0).mean() < 0.02
    assert (evidence[ball] > 0).mean() > 0.2 and (evidence[ball] < 0).mean() < 0.05
    assert set(np.unique(evidence)) <= {-1, 0, 1}


def test_without_a_floor_nothing_is_told(plain, subject):
    cameras, images, _ = plain
    evidence = floor_evidence(images, cameras, replace(subject, floor=None))
    assert [image.shape for image in evidence] == [image.shape[:2] for image in images]
    assert not np.any(evidence)


def test_a_plain_object_is_cut_from_its_table(plain, subject):
    cameras, images, masks = plain
    cuts = cut_out([View(image, camera) for image, camera in zip(images, cameras, strict=True)], subject)
    assert min(photographed.overlap(cut, mask >= 0.5) for cut, mask in zip(cuts, masks, strict=True)) > 0.95


def test_directions_are_those_that_the_lens_shows(plain):
    camera = replace(plain[0][3], distortion=Distortion(k1=-0.2, k2=0.05, p1=1e-3))
    directions = _directions(camera)
    column, row = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    back = camera.project(camera.center + 2 * directions.reshape(-1, 3)).reshape(240, 320, 2)
    np.testing.assert_allclose(back, np.stack([column, row], axis=-1), atol=0.05)
