"""Triangle meshes as they come out of files, made fit for distances and signs."""

from pathlib import Path

import numpy as np
import trimesh

from ..errors import UserError
from ..topology import vertex_components


def loaded_mesh(source: str | Path | trimesh.Trimesh, name: str) -> trimesh.Trimesh:
    """The mesh of a file, or a copy: welded, no degenerate faces, no pinches, outward faces if closed.

    Raises:
        UserError: the file cannot be read or holds no triangles; ``name`` is what it is called.
    """
    if isinstance(source, trimesh.Trimesh):
        mesh = source.copy()
    else:
        try:
            mesh = trimesh.load(source, force="mesh")
        except Exception as error:
            raise UserError(f"{name}: cannot be read as a triangle mesh ({error})") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise UserError(f"{name}: holds no triangles")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh = without_pinches(mesh)
    if mesh.is_watertight and mesh.volume < 0:
        mesh.invert()
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
    _, chosen, faces = np.unique(vertex_components(same, corner.size)[1], return_index=True,
                                 return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[mesh.faces.ravel()[chosen]], faces.reshape(-1, 3), process=False)
