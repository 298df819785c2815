"""Triangle meshes as they come out of files, made fit for distances and signs."""

from pathlib import Path

import numpy as np
import trimesh

from ..errors import UserError
from ..mesh_files import check_triangles, read_triangles
from ..topology import vertex_components
from .orientation import oriented

#: Vertices that agree in so many decimals, where the mesh is as large as the cube [-1, 1]^3, are one.
_DECIMALS = 6


def loaded_mesh(
    source: str | Path | trimesh.Trimesh, name: str, to_world: np.ndarray | None = None
) -> trimesh.Trimesh:
    """The mesh of a file, or a copy, in lattice units.

    It is welded, has no repeated faces, whichever way they face, no degenerate ones and no pinches; its
    pieces are oriented evenly, each as most of its area was, and closed ones outwards.

    Args:
        source: a file that trimesh reads, or a mesh.
        name: what it is called in messages.
        to_world: 4 x 4 matrix from lattice units to those of the mesh; identity by default.

    Raises:
        UserError: the file cannot be read, holds no triangles with an area, or positions that are NaN,
            infinite or missing.
    """
    try:
        if isinstance(source, trimesh.Trimesh):
            vertices, faces = check_triangles(
                np.asarray(source.vertices, float), np.asarray(source.faces, np.int64)
            )
        else:
            vertices, faces = read_triangles(source)
    except ValueError as error:
        raise UserError(f"{name}: {error}; mend it or export it again") from error
    if to_world is not None:
        matrix = np.linalg.inv(np.asarray(to_world, float))
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        if np.linalg.det(matrix[:3, :3]) < 0:
            faces = faces[:, ::-1]
    # Files may have any units. A power of two loses no digit.
    size = 2.0 ** np.ceil(np.log2(np.ptp(vertices, axis=0).max() / 2))
    mesh = trimesh.Trimesh(vertices / size, faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=_DECIMALS)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.update_faces(np.unique(np.sort(mesh.faces, axis=1), axis=0, return_index=True)[1])
    if len(mesh.faces) == 0:
        raise UserError(f"{name}: holds no triangles with an area")
    mesh = oriented(without_pinches(mesh))
    mesh.vertices = mesh.vertices * size
    return mesh


def without_pinches(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same faces, with a vertex of its own for each fan of faces that meets others in a point only.

    So may cloth that touches itself come out of a file, where equal positions are one vertex.
    """
    corner = np.arange(3 * len(mesh.faces)).reshape(-1, 3)
    side = np.stack([corner, np.roll(corner, -1, axis=1)], axis=-1).reshape(-1, 2)
    ends = mesh.faces.ravel()[side]
    side = np.take_along_axis(side, ends.argsort(axis=1), axis=1)
    _, first, edge = np.unique(np.sort(ends, axis=1), axis=0, return_index=True, return_inverse=True)
    # Faces that share an edge share its ends.
    same = np.stack([side, side[first[edge.reshape(-1)]]], axis=-1).reshape(-1, 2)
    _, chosen, faces = np.unique(
        vertex_components(same, corner.size)[1], return_index=True, return_inverse=True
    )
    return trimesh.Trimesh(mesh.vertices[mesh.faces.ravel()[chosen]], faces.reshape(-1, 3), process=False)
