"""How a model is trained; known to processes without ``torch``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TrainConfig:
    """How a model is trained."""

    model: str = "shape"
    """shape: flow matching on whole shapes' components; latent: on an autoencoder's latents; unet: the dense
    reference."""
    size: str = "S"
    """XS, S (CPU), M or L (GPU)."""
    minutes: float = 90.0
    """How long to train, all runs of this training together."""
    steps: int | None = None
    """Number of steps instead of minutes; the model is then the same on every run on a CPU."""
    batch: int = 32
    """Objects per step, and per process under torchrun."""
    rate: float = 5e-4
    """Learning rate after the warm-up."""
    autoencoder: Path | None = None
    """Folder of a trained model of this size whose autoencoder is taken; only the flow is trained then."""
    mirror: bool = True
    """Objects also count with left and right exchanged; --no-mirror: as they are."""
    seed: int = 0
    """Of weights, order and noise."""
    device: str = "auto"
    """cpu, cuda, or auto: cuda if there is one."""
    pictures: int = 4
    """How often samples are drawn as it goes."""
