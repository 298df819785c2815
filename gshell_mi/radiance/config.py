"""Settings of radiance volumes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ..bounds import Between


@dataclass(frozen=True)
class TrainingConfig:
    """How a radiance volume is trained."""

    iterations: int = 700
    """Steps."""
    batch: Annotated[int, Between(1)] = 131072
    """Rays per step over all pixels, of which those far from the masks are left out."""
    density_lr: float = 0.3
    """Adam's step for the logits of the densities; falls tenfold over the last level."""
    radiance_lr: float = 0.03
    """Adam's step for the radiance, as a fraction of the targets' mean."""
    direction_lr: float = 0.03
    """The same for what depends on the direction; 0: nothing does."""
    mask: float = 1.0
    """Weight of the coverage's squared error beside that of the radiance."""
    distortion: float = 0.01
    """Weight of how far apart along a ray is what it sees, in lengths of the lattice's cube."""
