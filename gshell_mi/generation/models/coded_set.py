"""A training set as what a flow is matched on."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

#: How often a class is left out in training, so that the model knows the mean over all.
_DROPPED = 0.1


@dataclass
class CodedSet:
    """Codes of objects, and their classes."""

    values: Tensor
    """(n, ...)."""
    kinds: Tensor
    """(n,)."""

    def __len__(self) -> int:
        return len(self.kinds)

    def draw(self, chosen: Tensor, classes: int, generator: torch.Generator) -> dict[str, Tensor]:
        """A batch of the rows ``chosen``, on the generator's device: ``x``, ``noise``, times ``t``, which are
        logit-normal, and ``kinds``, some of which are left out.

        Args:
            classes: how many there are; the number that stands for none.
        """
        device, count = generator.device, len(chosen)
        chosen = chosen.to(self.values.device)
        x = self.values[chosen].to(device).float()
        dropped = torch.rand(count, generator=generator, device=device) < _DROPPED
        return {
            "x": x,
            "noise": torch.randn(x.shape, generator=generator, device=device),
            "t": torch.sigmoid(torch.randn(count, generator=generator, device=device)),
            "kinds": torch.where(dropped, classes, self.kinds[chosen].to(device)),
        }
