"""Initial fields: from primitives, meshes and files."""

from .from_mesh import from_mesh
from .lattice_fields import LatticeFields
from .primitives import sphere

__all__ = ["LatticeFields", "from_mesh", "sphere"]
