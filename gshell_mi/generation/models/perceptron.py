"""A perceptron over points, steered by a time and a class."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .transformer import time_features


class Perceptron(nn.Module):
    """The velocity of points, given the time and a class.

    Args:
        values: numbers per point.
        classes: one more is added, which stands for none.
        width: of the hidden layers.
        layers: residual layers, each scaled and shifted by the condition.
    """

    def __init__(self, values: int, classes: int, width: int, layers: int, dropout: float = 0.0):
        super().__init__()
        self.width = width
        self.into = nn.Linear(values, width)
        self.kind = nn.Embedding(classes + 1, width)
        self.condition = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.layers = nn.ModuleList(
            nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Dropout(dropout), nn.Linear(width, width))
            for _ in range(layers)
        )
        self.modulation = nn.Parameter(torch.zeros(layers, 2, width))
        self.shared = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, values)
        nn.init.normal_(self.kind.weight, std=0.02)
        for layer in (self.shared, self.out):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor, t: Tensor, kind: Tensor) -> Tensor:
        """(B, values) velocities.

        Args:
            x: (B, values).
            t: (B,) in [0, 1].
            kind: (B,).
        """
        condition = F.silu(self.condition(time_features(t, self.width)) + self.kind(kind))
        shared = self.shared(condition).view(len(x), 2, self.width)
        h = self.into(x) + condition
        for layer, modulation in zip(self.layers, self.modulation, strict=True):
            shift, scale = (shared + modulation).unbind(dim=1)
            h = h + layer(F.layer_norm(h, (self.width,)) * (1 + scale) + shift)
        return self.out(F.layer_norm(h, (self.width,)))
