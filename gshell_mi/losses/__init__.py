"""Losses as named functions of Dr.Jit arrays; each returns one number (a width-1 ``mi.Float``).

``docs/losses.md`` has their formulas and when to raise which weight.

- ``image``: what a render and a target differ by
- ``opacity``: what the opacity of the openings stage should decide
- ``mesh``: smoothness along a mesh, of values and of the surface itself
- ``sdf``, ``msdf``: regularisers of the fields on the lattice
- ``light``: priors of an environment map
"""

from .image import IMAGE_LOSSES, chroma_difference, depth_l1, l1, log_l1, mask_l2, relative_l2, smape, tonemap
from .light import grey_world, light_smoothness
from .mesh import edge_smoothness, normal_variation
from .msdf import hole_closing, hole_opening, visible_inside, visible_outside
from .opacity import binary_entropy_bound, transparency
from .sdf import eikonal, sign_cross_entropy

__all__ = [
    "IMAGE_LOSSES",
    "binary_entropy_bound",
    "chroma_difference",
    "depth_l1",
    "edge_smoothness",
    "eikonal",
    "grey_world",
    "hole_closing",
    "hole_opening",
    "l1",
    "light_smoothness",
    "log_l1",
    "mask_l2",
    "normal_variation",
    "relative_l2",
    "sign_cross_entropy",
    "smape",
    "tonemap",
    "transparency",
    "visible_inside",
    "visible_outside",
]
