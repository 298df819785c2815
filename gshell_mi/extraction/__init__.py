"""From fields on a lattice to triangle meshes."""

from .extract import extract
from .narrow_band import NarrowBand
from .surface_mesh import SurfaceMesh

__all__ = ["NarrowBand", "SurfaceMesh", "extract"]
