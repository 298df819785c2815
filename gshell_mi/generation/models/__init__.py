"""The models. Whoever imports this imports ``torch``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..model_config import ModelConfig
from .steering import Steering

if TYPE_CHECKING:
    from .dense_diffusion import DenseDiffusion
    from .latent_flow import LatentFlow
    from .shape_flow import ShapeFlow

__all__ = ["Steering", "make_model"]


def make_model(config: ModelConfig) -> ShapeFlow | LatentFlow | DenseDiffusion:
    """The untrained model of a configuration."""
    if config.model == "unet":
        from .dense_diffusion import DenseDiffusion  # MONAI takes seconds to import

        return DenseDiffusion(config)
    if config.model == "latent":
        from .latent_flow import LatentFlow

        return LatentFlow(config)
    from .shape_flow import ShapeFlow

    return ShapeFlow(config)
