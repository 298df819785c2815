"""What a sample shall be like."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch


@dataclass(frozen=True)
class Steering:
    """What steers a batch of B samples."""

    kinds: list[int]
    """(B,) classes by number; the number of classes stands for none."""
    seeds: list[tuple[int, int, float]]
    """(B,) two seeds, and where between them the noise is taken from: 0 is the first."""
    guidance: float = 1.0
    """Weight of the class (Ho and Salimans 2022); 1 is the plain conditional model."""
    steps: int = 32
    """Steps of the integration."""
    start: np.ndarray | None = None
    """(2, N, N, N) truncated fields to begin from; None for noise."""
    strength: float = 1.0
    """How much of the way is gone anew from ``start``: 0 none, 1 all."""
    known: np.ndarray | None = None
    """(N, N, N) bool: where ``start`` is held fixed."""

    def noise(self, shape: tuple[int, ...]) -> torch.Tensor:
        """(B, *shape) normal noise on the host: the same for the same seeds, whatever else is in the batch.

        Between two seeds it turns from one to the other, so that it stays normal.
        """
        found = []
        for first, second, part in self.seeds:
            a, b = (
                torch.from_numpy(np.random.default_rng(seed).standard_normal(shape, dtype=np.float32))
                for seed in (first, second)
            )
            angle = part * torch.pi / 2
            found.append(np.cos(angle) * a + np.sin(angle) * b if part else a)
        return torch.stack(found).float()
