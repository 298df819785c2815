"""What is asked of a model; known to processes without ``torch``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import UserError
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


def coded(folder: Path, fields: np.ndarray) -> tuple[np.ndarray, int]:
    """Fields (n, 2, N, N, N) after a way through a model's own code, and its numbers of each. Imports torch.

    Raises:
        UserError: the model has none.
    """
    import torch

    from .model_folder import load_model

    model = load_model(folder, torch.device("cpu"))
    if model.config.model == "unet":
        raise UserError(f"The model in '{folder}' sees the fields themselves; give one of another kind.")
    with torch.no_grad():
        found = [model.coded(torch.from_numpy(pair[None]).float()) for pair in fields]
    return np.concatenate([again.numpy() for again, _ in found]), found[0][1]
