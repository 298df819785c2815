"""The models. Whoever imports this imports ``torch``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..model_config import ModelConfig
from .steering import Steering

if TYPE_CHECKING:
    from .block_flow import BlockFlow
    from .dense_diffusion import DenseDiffusion

__all__ = ["Steering", "make_model"]


def make_model(config: ModelConfig) -> BlockFlow | DenseDiffusion:
    """The untrained model of a configuration."""
    if config.model == "unet":
        from .dense_diffusion import DenseDiffusion  # MONAI takes seconds to import

        return DenseDiffusion(config)
    from .block_flow import BlockFlow

    return BlockFlow(config)
