"""A convolutional autoencoder: truncated fields as a few numbers for each block of 8^3 vertices, and back.

Blocks are told from numbers of their neighbourhood, not one by one, so that they join. What of the fields has
no part in the surface, as the distance to a cap, is left out of the loss.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ..fields import TRUNCATION_CELLS

#: Distances are seen up to so many cells. All that extraction reads is nearer: no edge is longer than
#: sqrt(3).
_SEEN_CELLS = 2.5
#: The mSDF is told at vertices so near to the template, in cells: the ends of the edges that cross it.
_NEAR_CELLS = 1.9
#: Farther beyond a rim, in cells, the template is a cap, of which only the sign of the distance counts.
_CAP_CELLS = 1.8
#: A cap's distances need only be so far from 0, by ``_SEEN_CELLS``, and count so much: nobody sees it.
_CAP_MARGIN, _CAP_WEIGHT = 0.3, 0.1
#: Errors below this, by ``_SEEN_CELLS``, are squared: a fortieth of a cell.
_KNEE = 0.01
#: Of the noise on the latents while training, by their deviation: what a sampler may err.
_NOISE = 0.1


class Seen(NamedTuple):
    """What of truncated fields matters; all (B, 2, N, N, N)."""

    values: Tensor
    """Distances by ``_SEEN_CELLS``, in [-1, 1], those that do not matter at an end of the range."""
    band: Tensor
    """Where the values count, bool. Elsewhere it is enough to be at the same end of the range."""
    margin: Tensor
    """So far from 0 that end need only be."""
    weight: Tensor
    """How much it counts."""


def seen(fields: Tensor) -> Seen:
    """Of truncated fields (B, 2, N, N, N)."""
    sdf, msdf = fields.unbind(dim=1)
    cap = msdf < -_CAP_CELLS / TRUNCATION_CELLS
    near = sdf.abs() < _NEAR_CELLS / TRUNCATION_CELLS
    scaled = (fields * (TRUNCATION_CELLS / _SEEN_CELLS)).clamp(-1, 1)
    one = torch.ones_like(sdf)
    values = torch.stack(
        [
            torch.where(cap, torch.where(sdf < 0, -one, one), scaled[:, 0]),
            torch.where(near, scaled[:, 1], one),
        ],
        dim=1,
    )
    return Seen(
        values,
        values.abs() < 1,
        torch.stack([torch.where(cap, _CAP_MARGIN, one), one], dim=1),
        torch.stack([torch.where(cap, _CAP_WEIGHT, one), near.to(one.dtype)], dim=1),
    )


class Residual(nn.Module):
    """Two convolutions beside the identity; it begins as that."""

    def __init__(self, width: int):
        super().__init__()
        self.first = nn.Conv3d(width, width, 3, padding=1)
        self.second = nn.Conv3d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, x: Tensor) -> Tensor:
        # Each place is normalised for itself, so that what is far away has no part in it.
        normal = x * torch.rsqrt(x.square().mean(dim=1, keepdim=True) + 1e-4)
        return x + self.second(F.silu(self.first(F.silu(normal))))


class Autoencoder(nn.Module):
    """From (B, 2, N, N, N) truncated fields to (B, channels, N / 8, N / 8, N / 8) latents, and back.

    Args:
        channels: latents per block.
        widths: of the features per 2^3, 4^3 and 8^3 vertices.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, channels: int, widths: tuple[int, int, int]):
        super().__init__()
        fine, middle, coarse = widths
        self.encoder = nn.Sequential(
            nn.Conv3d(16, fine, 3, padding=1),
            Residual(fine),
            nn.Conv3d(fine, middle, 2, stride=2),
            Residual(middle),
            Residual(middle),
            nn.Conv3d(middle, coarse, 2, stride=2),
            Residual(coarse),
            nn.Conv3d(coarse, channels, 1),
        )
        self.decoder = nn.Sequential(
            nn.Conv3d(channels, coarse, 3, padding=1),
            Residual(coarse),
            Residual(coarse),
            nn.ConvTranspose3d(coarse, middle, 2, stride=2),
            Residual(middle),
            Residual(middle),
            nn.ConvTranspose3d(middle, fine, 2, stride=2),
            Residual(fine),
            Residual(fine),
            nn.Conv3d(fine, 16, 3, padding=1),
        )
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("deviation", torch.ones(channels))

    def encode(self, fields: Tensor) -> Tensor:
        """(B, C, n, n, n) latents, of mean 0 and deviation 1 over a training set."""
        return self._standard(self.encoder(_folded(seen(fields).values)), self.mean, self.deviation)

    def decode(self, latents: Tensor) -> Tensor:
        """(B, 2, N, N, N) truncated fields with the same surface, nearly."""
        return _unfolded(self.decoder(latents)).float().clamp(-1, 1) * (_SEEN_CELLS / TRUNCATION_CELLS)

    def forward(self, fields: Tensor, noise: Tensor) -> Tensor:
        """The mean error, in ``_SEEN_CELLS``, of both distances in the band and of their slopes.

        Args:
            noise: (B, C, n, n, n), normal.
        """
        true = seen(fields)
        raw = self.encoder(_folded(true.values))
        axes = (0, 2, 3, 4)
        mean, deviation = raw.float().mean(dim=axes), raw.float().std(dim=axes) + 1e-4
        if self.training:
            with torch.no_grad():
                self.mean.lerp_(mean, 0.01)
                self.deviation.lerp_(deviation, 0.01)
        else:
            mean, deviation = self.mean, self.deviation
        latents = self._standard(raw, mean, deviation) + _NOISE * noise
        return _error(_unfolded(self.decoder(latents)).float(), true)

    @staticmethod
    def _standard(raw: Tensor, mean: Tensor, deviation: Tensor) -> Tensor:
        return (raw - mean.view(1, -1, 1, 1, 1)) / deviation.view(1, -1, 1, 1, 1)


def _error(found: Tensor, true: Seen) -> Tensor:
    values, band, margin, weight = true
    off = torch.where(band, found - values, F.relu(margin - values.sign() * found))
    total = (weight * _huber(off)).sum()
    for axis in (2, 3, 4):
        length = values.shape[axis] - 1
        both = band.narrow(axis, 1, length) & band.narrow(axis, 0, length)
        total = total + (both * _huber(off.diff(dim=axis))).sum()
    return total / band.sum().clamp(min=1)


def _huber(x: Tensor) -> Tensor:
    return F.huber_loss(x, torch.zeros_like(x), reduction="none", delta=_KNEE) / _KNEE


def _folded(x: Tensor) -> Tensor:
    """(B, 2, N, N, N) as (B, 16, N / 2, N / 2, N / 2)."""
    batch, fields, n = x.shape[:3]
    split = x.view(batch, fields, n // 2, 2, n // 2, 2, n // 2, 2)
    found = split.permute(0, 1, 3, 5, 7, 2, 4, 6).reshape(batch, 8 * fields, n // 2, n // 2, n // 2)
    return found.contiguous(memory_format=torch.channels_last_3d) if x.is_cuda else found


def _unfolded(x: Tensor) -> Tensor:
    batch, channels, n = x.shape[:3]
    split = x.view(batch, channels // 8, 2, 2, 2, n, n, n)
    return split.permute(0, 1, 5, 2, 6, 3, 7, 4).reshape(batch, channels // 8, 2 * n, 2 * n, 2 * n)
