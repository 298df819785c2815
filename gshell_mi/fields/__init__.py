"""Initial fields: from primitives and files."""

from .lattice_fields import LatticeFields
from .primitives import sphere

__all__ = ["LatticeFields", "sphere"]
