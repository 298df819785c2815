"""From fields on a lattice to triangle meshes."""

from .surface_mesh import SurfaceMesh
from .tetrahedra import extract

__all__ = ["SurfaceMesh", "extract"]
