"""Which way faces look, by piece."""

import numpy as np
import trimesh

from gshell_mi.conversion.orientation import oriented

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.3)


def moved(mesh, x, *, inverted=False):
    copy = mesh.copy()
    copy.apply_translation([x, 0, 0])
    if inverted:
        copy.invert()
    return copy


def volumes(mesh):
    return sorted(part.volume for part in mesh.split(only_watertight=False))


def test_each_closed_piece_looks_outwards():
    both = trimesh.util.concatenate([moved(BALL, 0), moved(BALL, 1, inverted=True)])
    np.testing.assert_allclose(volumes(oriented(both)), BALL.volume)


def test_a_hollow_stays_one():
    small = BALL.copy()
    small.apply_scale(0.5)
    small.invert()
    hollow = trimesh.util.concatenate([BALL, small])
    np.testing.assert_allclose(volumes(oriented(hollow)), [small.volume, BALL.volume])
    turned = hollow.copy()
    turned.invert()
    np.testing.assert_allclose(volumes(oriented(turned)), [small.volume, BALL.volume])


def test_an_open_piece_keeps_its_side():
    """That of most of its area, even if that is the inside."""
    bowl = trimesh.Trimesh(BALL.vertices, BALL.faces[BALL.triangles_center[:, 1] < 0][:, ::-1], process=False)
    np.testing.assert_array_equal(oriented(bowl).faces, bowl.faces)


def test_a_moebius_strip_keeps_one_seam():
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    middle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    across = np.cos(angle / 2)[:, None] * middle + np.sin(angle / 2)[:, None] * [0, 0, 1]
    vertices = np.concatenate([middle - 0.2 * across, middle + 0.2 * across])
    faces = []
    for k in range(60):
        a, b, c, d = (k, k + 60, k + 1, k + 61) if k < 59 else (59, 119, 60, 0)  # half a turn
        faces += [[a, b, c], [b, d, c]]
    faces = np.array(faces)
    turned = np.random.default_rng(0).random(len(faces)) < 0.4
    faces[turned] = faces[turned, ::-1]
    found = oriented(trimesh.Trimesh(vertices, faces, process=False)).faces
    sides = np.concatenate([found[:, [0, 1]], found[:, [1, 2]], found[:, [2, 0]]])
    repeated = len(sides) - len(np.unique(sides, axis=0))  # two faces on one side of an edge
    assert repeated == 1
