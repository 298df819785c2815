"""Where the object is, from cameras and sparse points."""

import struct

import numpy as np
import photographed
import pytest

from gshell_mi.capture.subject import find_subject, sparse_points
from gshell_mi.errors import UserError


def test_the_object_stands_on_its_floor():
    subject = find_subject(photographed.cameras(12), photographed.points())
    np.testing.assert_allclose(subject.up, [0, 1, 0], atol=0.01)
    assert abs(subject.floor[3]) < 0.01
    sides = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1]])
    inside = photographed.CENTER + photographed.RADIUS * sides
    assert ((inside > subject.box[0]) & (inside < subject.box[1])).all()
    assert np.ptp(subject.box, axis=0).max() < 2.0  # the table is three wide


def test_parts_with_nothing_between_them_are_one_object():
    """A dark band without features is no end of the object."""
    points = photographed.points()
    height = points[:, 1]
    parted = points[(height < 0.35) | (height > 0.65)]
    subject = find_subject(photographed.cameras(12), parted)
    assert subject.points[:, 1].min() < 0.35 and subject.box[1, 1] > 1.0


def test_without_points_it_is_what_all_frames_hold():
    subject = find_subject(photographed.cameras(8), np.zeros((0, 3)))
    assert subject.floor is None and len(subject.points) == 0
    np.testing.assert_allclose(subject.box.mean(axis=0), photographed.CENTER, atol=1e-6)


def test_cameras_side_by_side_look_at_nothing_in_common():
    camera = photographed.cameras(1)[0]
    step = np.eye(4)
    step[0, 3] = 0.1
    assert find_subject([camera, camera.moved(step), camera.moved(step @ step)], np.zeros((0, 3))) is None


@pytest.mark.parametrize("binary", [True, False])
def test_points_of_colmap_models(binary, tmp_path):
    points = [(1.0, 2.0, 3.0, 4), (-1.0, 0.5, 0.25, 2), (0.0, 0.0, 9.0, 3)]  # last: the track's length
    if binary:
        data = struct.pack("<Q", len(points))
        for index, (x, y, z, track) in enumerate(points):
            data += struct.pack("<Q3d3BdQ", index, x, y, z, 9, 9, 9, 0.5, track) + b"\0" * 8 * track
        (tmp_path / "points3D.bin").write_bytes(data)
    else:
        lines = [
            f"{index} {x} {y} {z} 9 9 9 0.5 {'1 2 ' * track}" for index, (x, y, z, track) in enumerate(points)
        ]
        (tmp_path / "points3D.txt").write_text("# 3D point list\n" + "\n".join(lines))
    np.testing.assert_array_equal(sparse_points(tmp_path), [[1, 2, 3], [0, 0, 9]])
    assert sparse_points(tmp_path / "none").shape == (0, 3)


def test_points_that_are_no_numbers_are_told(tmp_path):
    (tmp_path / "points3D.txt").write_text("# 3D point list\n0 1.0 two 3.0 9 9 9 0.5 " + "1 2 " * 3)
    with pytest.raises(UserError, match=r"points3D\.txt' is malformed in line 2; export"):
        sparse_points(tmp_path)
