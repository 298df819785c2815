"""Scores of images, meshes and relit renderings against references, as papers report them."""

from .image_scores import (
    IMAGE_SCORES,
    VIEW_SCORES,
    Scores,
    image_scores,
    mean_scores,
    read_image,
    view_scores,
)
from .mesh_scores import mesh_scores
from .relighting import albedo_scale

__all__ = [
    "IMAGE_SCORES",
    "VIEW_SCORES",
    "Scores",
    "albedo_scale",
    "image_scores",
    "mean_scores",
    "mesh_scores",
    "read_image",
    "view_scores",
]
