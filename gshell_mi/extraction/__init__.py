"""From fields on a lattice to triangle meshes."""

from .extract import extract
from .surface_mesh import SurfaceMesh

__all__ = ["SurfaceMesh", "extract"]
