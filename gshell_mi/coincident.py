"""Meshes of a scene that lie in one another: whose silhouettes derivatives would count twice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import mitsuba as mi
import numpy as np

from .wording import counted


def coincident_meshes(shapes: Iterable[mi.Shape]) -> list[str]:
    """One sentence for each mesh that has faces at the very place of another mesh's faces.

    To be called where a scene is loaded: reading a mesh inside of a render breaks its derivatives. Repeated
    faces of one mesh are no trouble, see ``integrators.edge_table``.

    >>> import trimesh
    >>> from gshell_mi.compat import triangle_mesh
    >>> ball, other = trimesh.creation.icosphere(1), trimesh.creation.icosphere(1, radius=2)
    >>> meshes = [triangle_mesh(name, b.vertices, b.faces) for name, b in zip("abc", (ball, other, ball))]
    >>> for mesh, name in zip(meshes, "abc"): mesh.set_id(name)
    >>> coincident_meshes(meshes[:2])
    []
    >>> coincident_meshes(meshes)[0][:51]
    "Mesh 'c' has 80 faces that lie in faces of mesh 'a'"
    """
    meshes = [shape for shape in shapes if shape.is_mesh() and shape.face_count() > 0]
    if len(meshes) < 2:
        return []
    corners, owner = [], []
    for number, mesh in enumerate(meshes):
        parameters = mi.traverse(mesh)
        positions = np.array(parameters["vertex_positions"]).reshape(-1, 3)
        corners.append(positions[np.array(parameters["faces"]).reshape(-1, 3)])
        owner.append(np.full(len(corners[-1]), number))
    points = np.concatenate(corners).reshape(-1, 3) + 0.0  # 0.0 and -0.0 are one place
    vertex = np.unique(points, axis=0, return_inverse=True)[1].reshape(-1, 3)
    faces, owner = np.sort(vertex, axis=1), np.concatenate(owner)
    whole = (np.diff(faces, axis=1) > 0).all(axis=1)  # a gshell's padding is no face
    faces, owner = faces[whole], owner[whole]
    _, first, same = np.unique(faces, axis=0, return_index=True, return_inverse=True)
    before = owner[first[same.ravel()]]
    pairs = Counter(zip(owner[before != owner].tolist(), before[before != owner].tolist(), strict=True))
    return [
        f"Mesh '{meshes[own].id()}' has {counted(count, 'face')} that lie in faces of mesh "
        f"'{meshes[other].id()}': derivatives count their silhouettes twice; leave one of the two out."
        for (own, other), count in sorted(pairs.items())
    ]
