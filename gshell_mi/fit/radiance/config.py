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


@dataclass(frozen=True)
class VolumeConfig(TrainingConfig):
    """Radiance volume: another start, for what no hull shows."""

    iterations: int = 700
    """Steps of the radiance volume; the joint stage starts from what of its surface explains unseen views
    better. 0 leaves it out."""
    side: Annotated[int, Between(4)] = 256
    """Voxels per side of its last level, rounded up to whole bricks of the first."""
    resolution: Annotated[int, Between(4)] = 128
    """Cells per side of the lattice, at least, if the fit starts from it and --resolution does not say."""
    detail_resolution: Annotated[int, Between(4)] = 128
    """Cells per side, at least, that the detail stage ends on then, in blocks around the surface."""
