"""Settings that the joint stage and the detail stage share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from ...bounds import Between
from ...memory import LONGEST_PATH


@dataclass(frozen=True)
class RenderConfig:
    """How images are made that targets are compared with."""

    views: Annotated[int, Between(1, 1000)] = 3
    """Views that a step renders; it follows the mean of their losses. What a step takes beside rendering is
    shared by them."""
    spp: Annotated[int, Between(1)] = 2
    """Samples per pixel of the gradient render."""
    primal_spp: Annotated[int, Between(1)] = 6
    """Samples per pixel of the image that the loss compares; independent of the gradient's samples."""
    max_depth: Annotated[int, Between(2, LONGEST_PATH)] = 5
    """Longest path: 2 is direct light, 3 adds one interreflection. That of the exported scene is 5."""
    gradient_depth: Annotated[int, Between(2, LONGEST_PATH)] = 3
    """Longest path that is differentiated; what longer ones add to an image counts as constant."""
    reparam_depth: Annotated[int, Between(1, 3)] = 1
    """Path segments whose visibility is differentiated: 1 is what the camera sees, 2 adds shadows, and is
    slower."""


@dataclass(frozen=True)
class ModelConfig:
    """What is sought: how geometry, material and light are described."""

    field: str = "explicit"
    """What the geometry is optimised as: the lattice's values themselves, or a parametrisation that is
    registered under this name (gshell_mi.extras has some)."""
    even_start: bool = True
    """Start from one base colour, the median of those that the images show, if the light is sought.
    With --model.no-even-start, or a known light: from what they show, shading and all."""
    light_height: Annotated[int, Between(3)] = 32
    """Rows of the optimised environment map; it has twice as many columns."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses; 0 leaves one out."""

    image: Literal["log_l1", "smape", "relative_l2", "l1"] = "log_l1"
    """What compares a render with its target."""
    mask: float = 4.0
    """Weight of the mask loss."""
    depth: float = 0.01
    """Weight of the depth loss, in cells; only used with depth maps."""
    material_smoothness: float = 0.01
    """Weight of the difference between the material at a point and at a point nearby."""
    light_grey: float = 0.005
    """Weight of the grey-world prior of the light."""
    flexicubes_deviation: float = 0.01
    """Weight of the FlexiCubes regulariser, in cells; only used with that grid."""
    extra: dict[str, float] = field(default_factory=dict)
    """Names and weights of further losses that are registered (gshell_mi.extras has some), such as
    ``eikonal 0.002``."""
