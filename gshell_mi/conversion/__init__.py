"""From meshes to lattice fields: the way back from extraction."""

from .from_mesh import from_mesh

__all__ = ["from_mesh"]
