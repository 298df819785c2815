"""A transformer over tokens that fill a cube."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F


def time_features(t: Tensor, width: int) -> Tensor:
    """(B, width) sines and cosines of times (B,) in [0, 1]."""
    rates = torch.exp(-math.log(1000) * torch.arange(width // 2, device=t.device) / (width // 2))
    angles = 1000 * t[:, None] * rates
    return torch.cat([angles.sin(), angles.cos()], dim=1)


class Block(nn.Module):
    """Attention and a perceptron, each scaled, shifted and gated by the condition (Peebles and Xie 2023).

    What the condition says is the same for all blocks but for a table each (Chen et al. 2024), which saves a
    third of the weights.
    """

    def __init__(self, width: int, heads: int, dropout: float):
        super().__init__()
        self.heads = heads
        self.into = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.perceptron = nn.Sequential(
            nn.Linear(width, 4 * width),
            nn.GELU(approximate="tanh"),
            nn.Dropout(dropout),
            nn.Linear(4 * width, width),
        )
        self.dropout = nn.Dropout(dropout)
        self.modulation = nn.Parameter(torch.zeros(6, width))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        batch, tokens, width = x.shape
        modulation = (condition + self.modulation)[:, :, None].unbind(dim=1)
        shift_a, scale_a, gate_a, shift_p, scale_p, gate_p = modulation
        normal = F.layer_norm(x, (width,)) * (1 + scale_a) + shift_a
        q, k, v = self.into(normal).view(batch, tokens, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        seen = F.scaled_dot_product_attention(q, k, v)
        x = x + gate_a * self.dropout(self.out(seen.transpose(1, 2).reshape(batch, tokens, width)))
        normal = F.layer_norm(x, (width,)) * (1 + scale_p) + shift_p
        return x + gate_p * self.dropout(self.perceptron(normal))


class TokenTransformer(nn.Module):
    """The velocity of tokens that fill a cube, given the time and a class.

    Args:
        values: numbers per token.
        per_side: tokens per side of the cube.
        classes: one more is added, which stands for none.
        dropout: of what each half of a block adds, while training.
    """

    def __init__(
        self,
        values: int,
        per_side: int,
        classes: int,
        width: int,
        depth: int,
        heads: int,
        dropout: float = 0.0,
    ):
        super().__init__()
        self.width, self.per_side = width, per_side
        self.into = nn.Linear(values, width)
        self.place = nn.Parameter(torch.zeros(per_side**3, width))
        self.kind = nn.Embedding(classes + 1, width)
        self.condition = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.blocks = nn.ModuleList(Block(width, heads, dropout) for _ in range(depth))
        self.shared = nn.Linear(width, 6 * width)
        self.modulation = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, values)
        nn.init.normal_(self.place, std=0.02)
        nn.init.normal_(self.kind.weight, std=0.02)
        for layer in (self.shared, self.modulation, self.out):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor, t: Tensor, kind: Tensor) -> Tensor:
        """(B, T, values) velocities.

        Args:
            x: (B, T, values), the tokens in the order of their places.
            t: (B,) in [0, 1].
            kind: (B,).
        """
        h = self.into(x) + self.place
        condition = F.silu(self.condition(time_features(t, self.width)) + self.kind(kind))
        shared = self.shared(condition).view(len(x), 6, self.width)
        for block in self.blocks:
            h = block(h, shared)
        shift, scale = self.modulation(condition)[:, None].chunk(2, dim=2)
        return self.out(F.layer_norm(h, (self.width,)) * (1 + scale) + shift)
