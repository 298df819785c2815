"""The models. Whoever imports this imports ``torch``."""

from __future__ import annotations

from ..model_config import ModelConfig
from .block_flow import BlockFlow
from .dense_diffusion import DenseDiffusion
from .steering import Steering

__all__ = ["BlockFlow", "DenseDiffusion", "Steering", "make_model"]


def make_model(config: ModelConfig) -> BlockFlow | DenseDiffusion:
    """The untrained model of a configuration."""
    return {"blocks": BlockFlow, "unet": DenseDiffusion}[config.model](config)
