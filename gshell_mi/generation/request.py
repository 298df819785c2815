"""What is asked of a model; known to processes without ``torch``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .own_process import in_own_process


@dataclass(frozen=True)
class Request:
    """What is to be sampled."""

    kinds: list[int | None]
    """(n,) classes by number; None for any."""
    seeds: list[tuple[int, int, float]]
    """(n,) see ``models.Steering``."""
    guidance: float
    steps: int
    batch: int
    device: str
    start: np.ndarray | None = None
    """(2, N, N, N), see ``models.Steering``."""
    strength: float = 1.0
    known: np.ndarray | None = None
    """(N, N, N) bool, see ``models.Steering``."""
    quiet: bool = True


def sampled_fields(folder: Path, request: Request) -> tuple[np.ndarray, float]:
    """``sampling.sample_fields`` in a process of its own."""
    return in_own_process(_sample, folder, request)


def _sample(folder: Path, request: Request) -> tuple[np.ndarray, float]:
    from .sampling import sample_fields

    return sample_fields(folder, request)


def autoencoded(folder: Path, fields: np.ndarray) -> tuple[np.ndarray, int]:
    """Fields (n, 2, N, N, N) after a way through a model's autoencoder, and how many numbers each is there.
    Imports ``torch``."""
    import torch

    from .training import load_model

    model = load_model(folder, torch.device("cpu"))
    with torch.no_grad():
        latents = [model.autoencoder.encode(torch.from_numpy(pair[None]).float()) for pair in fields]
        again = [model.autoencoder.decode(one)[0].numpy() for one in latents]
    return np.stack(again), latents[0].numel()
