"""Scores of images, meshes and relit renderings against references, as papers report them."""

from .image_scores import IMAGE_SCORES, image_scores, read_image
from .mesh_scores import mesh_scores
from .relighting import albedo_scale

__all__ = ["IMAGE_SCORES", "albedo_scale", "image_scores", "mesh_scores", "read_image"]
