"""A set of fields as training reads it: in the device's memory where it fits."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

#: Of a GPU's free memory, the most that the set may take.
_MOST = 0.25


class TrainingSet:
    """Truncated fields, and their mirror images if these count as other objects.

    Args:
        sdf: (n, N, N, N) float16.
        msdf: (n, N, N, N) float16.
        kinds: n classes by number.
        mirror: whether each object also comes with left and right exchanged; there are 2 n then.
        device: where batches will go.
    """

    kinds: Tensor
    """(objects,)."""

    def __init__(
        self, sdf: np.ndarray, msdf: np.ndarray, kinds: list[int], *, mirror: bool, device: torch.device
    ):
        home = torch.device("cpu")
        if device.type == "cuda" and sdf.nbytes + msdf.nbytes < _MOST * torch.cuda.mem_get_info(device)[0]:
            home = device
        self._sdf, self._msdf = torch.from_numpy(sdf).to(home), torch.from_numpy(msdf).to(home)
        self._objects = len(kinds)
        self.kinds = torch.tensor(kinds * (1 + mirror))

    def __len__(self) -> int:
        return len(self.kinds)

    def fields(self, chosen: Tensor, device: torch.device) -> Tensor:
        """(B, 2, N, N, N) float32 of the rows ``chosen``."""
        rows = (chosen % self._objects).to(self._sdf.device)
        found = torch.stack([self._sdf[rows], self._msdf[rows]], dim=1).to(device).float()
        mirrored = (chosen >= self._objects).to(device).view(-1, 1, 1, 1, 1)
        return torch.where(mirrored, found.flip(4), found)

    def parts(self, count: int, device: torch.device) -> Iterator[Tensor]:
        """All fields in turn, ``count`` at once."""
        for rows in torch.arange(len(self)).split(count):
            yield self.fields(rows, device)
