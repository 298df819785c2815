"""What a fit can do but does not by default: losses and parametrisations that were never measured to help.

Importing this registers them by name, as a user's own would be: ``--losses.extra NAME WEIGHT`` and
``--model.field NAME``.

- losses: ``hole_opening``, ``hole_closing``, ``visible_outside``, ``visible_inside``, ``sdf_sign``,
  ``eikonal``, ``normal_variation``, ``albedo_chroma``, ``light_smoothness`` (docs/losses.md)
- parametrisations: ``flexicubes``, ``multiresolution``, ``hashgrid``, ``sinusoidal`` (docs/grids.md)
"""

from ..parametrisation import register_parametrisation
from . import losses
from .flexicubes_weights import FlexiCubesWeights
from .hashgrid import HashGridNetwork
from .multiresolution import MultiresolutionGrid
from .sinusoidal import SinusoidalNetwork

__all__ = ["FlexiCubesWeights", "HashGridNetwork", "MultiresolutionGrid", "SinusoidalNetwork", "losses"]

for name, kind in (
    ("flexicubes", FlexiCubesWeights),
    ("multiresolution", MultiresolutionGrid),
    ("hashgrid", HashGridNetwork),
    ("sinusoidal", SinusoidalNetwork),
):
    register_parametrisation(name, kind)
