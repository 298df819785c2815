"""A seeded, parametric generator of open garments."""

from .draw import CLASSES, Garment, garment

__all__ = ["CLASSES", "Garment", "garment"]
