"""A strip that is bent to a hook: its two ends face each other, close by but far along the strip."""

import numpy as np
import pytest
import trimesh

from gshell_mi.conversion.bridges import bridges
from gshell_mi.conversion.mesh_distance import MeshFeet

GAP = 0.1


def hook(columns: int = 60) -> trimesh.Trimesh:
    """Two strips of length 1 with a gap between them, joined by a half circle."""
    along = np.linspace(-1 - np.pi * GAP / 4, 1 + np.pi * GAP / 4, columns)
    angle = np.clip(along / (GAP / 2), -np.pi / 2, np.pi / 2)
    x = np.clip(np.abs(along) - np.pi * GAP / 4, 0, None) - GAP / 2 * np.cos(angle)
    y = GAP / 2 * np.sin(angle)
    vertices = np.concatenate([np.stack([x, y, np.full(columns, z)], axis=1) for z in (0, 0.2)])
    low = np.arange(columns - 1)
    faces = np.concatenate(
        [
            np.stack([low, low + 1, low + columns + 1], axis=1),
            np.stack([low, low + columns + 1, low + columns], axis=1),
        ]
    )
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.mark.parametrize(
    ("x", "reach", "expected"),
    [
        (0.9, 0.3, True),  # 1.8 apart along the strip
        (0.5, 0.3, True),
        (0.9, 3.0, False),
        (0.02, 0.3, False),  # beside the bend
    ],
)
def test_edges_across_the_gap(x, reach, expected):
    mesh = hook()
    points = np.array([[x, side * GAP / 2, 0.1] for side in (-1, 1)])
    every = np.tile(np.arange(len(mesh.faces)), (2, 1))
    feet = MeshFeet(mesh)(points, every)
    assert len(bridges(mesh, feet, np.array([[0, 1]]), reach)) == expected


def test_edges_along_a_layer_are_none():
    mesh = hook()
    points = np.array([[0.3, GAP / 2, 0.1], [0.6, GAP / 2, 0.1]])
    feet = MeshFeet(mesh)(points, np.tile(np.arange(len(mesh.faces)), (2, 1)))
    assert bridges(mesh, feet, np.array([[0, 1]]), 0.01).shape == (0, 2)
