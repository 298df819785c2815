"""A cup's mouth leads into a hollow, and is no opening; that of a box of cloth is one."""

import mitsuba as mi
import numpy as np
import trimesh
from cup import HALF, WALL, block, cup, fit_of, surface_of
from scipy.spatial import cKDTree

from gshell_mi.fit.carving.vessels import hollowed_vessels
from gshell_mi.fit.template import template_of
from gshell_mi.topology import topology
from gshell_mi.triangles import positive_part

RESOLUTION = 32
CELL = 2 / RESOLUTION


def box_of_cloth() -> trimesh.Trimesh:
    """The cup's block without its upper side, and without thickness."""
    box = block([-HALF] * 3, [HALF] * 3)
    box.update_faces(box.face_normals[:, 1] < 0.9)
    return box


def beside_each_other(first: trimesh.Trimesh, second: trimesh.Trimesh) -> trimesh.Trimesh:
    """Both at half the size."""
    moved = [
        shape.copy().apply_scale(0.5).apply_translation([x, 0, 0])
        for shape, x in ((first, -0.5), (second, 0.5))
    ]
    return trimesh.util.concatenate(moved)


def block_distance(points: np.ndarray, half: float, x: float = 0.0) -> np.ndarray:
    return np.abs(points - [x, 0, 0]).max(axis=1) - half


def opened_from_above(points: np.ndarray, half: float, wall: float, x: float = 0.0) -> np.ndarray:
    """(n,) negative at the upper side of a block within its walls."""
    side = np.abs(points[:, [0, 2]] - [x, 0]).max(axis=1) - (half - wall)
    return np.maximum(side, half - 0.5 * CELL - points[:, 1])


def vessels(shape: trimesh.Trimesh, fields, resolution: int = RESOLUTION):
    """What comes of a surface on the lattice: ``fields`` maps points (n, 3) to sdf and msdf."""
    subject = mi.load_dict({"type": "gshell", "resolution": resolution})
    surface = surface_of(*fields(subject.lattice.points(mi.Float).numpy().T))
    hollowed = hollowed_vessels(fit_of(subject, shape), surface)
    return hollowed and template_of(subject, hollowed)


def block_open_above(points):
    return block_distance(points, HALF), opened_from_above(points, HALF, WALL)


def test_a_cups_mouth_is_no_opening_and_its_inside_where_it_is():
    found = vessels(cup(), block_open_above)
    assert found.solid.all()
    counts = topology(found.vertices, found.faces)
    assert (counts.components, counts.boundary_loops, counts.pinholes) == (1, 0, 0)
    inner = np.abs(found.start).max(axis=1) < HALF - 0.5 * WALL
    truth, _ = trimesh.sample.sample_surface(cup(), 40000, seed=1)
    assert inner.sum() > 300 and np.median(cKDTree(truth).query(found.start[inner])[0]) < 0.7 * CELL


def test_an_opening_of_cloth_stays():
    assert vessels(box_of_cloth(), block_open_above) is None


def test_an_opening_stays_if_the_judge_rejects_the_hollow(rejecting):
    assert vessels(cup(), block_open_above) is None


def test_what_is_closed_stays():
    def closed(points):
        return block_distance(points, HALF), np.ones(len(points))

    assert vessels(cup(), closed) is None


def test_a_dent_is_no_hollow(accepting):
    """However well it explains the images: nobody is asked."""
    low = HALF - 3.2 * CELL

    def slab(points):
        return np.maximum(block_distance(points, HALF), low - points[:, 1]), block_open_above(points)[1]

    shape = block([-HALF, low, -HALF], [HALF] * 3)
    assert vessels(shape, slab) is None


def test_only_the_cups_opening_goes_where_there_is_another():
    half, wall = 0.5 * HALF, 0.5 * WALL

    def both(points):
        return (
            np.minimum(block_distance(points, half, -0.5), block_distance(points, half, 0.5)),
            np.minimum(
                opened_from_above(points, half, wall, -0.5), opened_from_above(points, half, wall, 0.5)
            ),
        )

    found = vessels(beside_each_other(cup(), box_of_cloth()), both, resolution=48)
    assert found.solid[found.vertices[:, 0] < 0].all()
    assert found.vertices[~found.solid, 1].min() > half - 2 / 48
    surface = topology(*positive_part(found.vertices, found.faces, found.logits))
    assert (surface.components, surface.boundary_loops) == (2, 1)
