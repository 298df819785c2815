"""The reference: a dense 3-D U-Net that predicts the noise.

Ho et al., "Denoising Diffusion Probabilistic Models" (NeurIPS 2020), with the cosine schedule of Nichol and
Dhariwal (2021), as Liu et al. (ICLR 2024, sec. 4) use it; sampled by DDIM (Song et al. 2021).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from monai.networks.nets.diffusion_model_unet import DiffusionModelUNet
from torch import Tensor, nn

from ..model_config import ModelConfig
from .steering import Steering

_TIMES = 1000
_DROPPED = 0.1


@dataclass
class Prepared:
    """A training set as it is stored."""

    values: Tensor
    """(n, 2, N, N, N) float16."""
    kinds: Tensor
    """(n,)."""

    def __len__(self) -> int:
        return len(self.kinds)


class DenseDiffusion(nn.Module):
    """A U-Net on both truncated distances."""

    signal: Tensor

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        base = config.shape["channels"]
        # Attention where 16 or fewer vertices per side are left.
        levels = max(2, int(math.log2(config.side // 8)))
        channels = tuple(base * min(2**level, 4) for level in range(levels))
        attention = tuple(config.side >> level <= 16 and level > 0 for level in range(levels))
        self.network = DiffusionModelUNet(
            spatial_dims=3, in_channels=2, out_channels=2, channels=channels, attention_levels=attention,
            num_res_blocks=1, num_head_channels=base, norm_num_groups=min(8, base),
            num_class_embeds=len(config.classes) + 1)
        at = torch.linspace(0, 1, _TIMES + 1, dtype=torch.float64)
        signal = torch.cos((at + 0.008) / 1.008 * torch.pi / 2).square()
        self.register_buffer("signal", (signal / signal[0])[1:].clamp(min=1e-5).float(), persistent=False)

    def prepare(self, sdf: np.ndarray, msdf: np.ndarray, kinds: list[int]) -> Prepared:
        """A training set (n, N, N, N)."""
        return Prepared(torch.from_numpy(np.stack([sdf, msdf], axis=1)), torch.tensor(kinds))

    def batch(self, data: Prepared, chosen: Tensor) -> dict[str, Tensor]:
        return {"values": data.values[chosen].float(), "kinds": data.kinds[chosen]}

    def forward(self, batch: dict[str, Tensor], generator: torch.Generator) -> Tensor:
        """The mean squared error of the noise."""
        x = batch["values"]
        step = torch.randint(_TIMES, (len(x),), generator=generator).to(x.device)
        noise = torch.randn(x.shape, generator=generator).to(x.device)
        dropped = (torch.rand(len(x), generator=generator) < _DROPPED).to(x.device)
        kinds = torch.where(dropped, len(self.config.classes), batch["kinds"])
        signal = self.signal[step].view(-1, 1, 1, 1, 1)
        found = self.network(signal.sqrt() * x + (1 - signal).sqrt() * noise, step, class_labels=kinds)
        return (found.float() - noise).square().mean()

    @torch.no_grad()
    def sample(self, steering: Steering, told: Callable[[], None] = lambda: None) -> np.ndarray:
        """(B, 2, N, N, N) float32 truncated fields; ``told`` is called after each of ``2 steering.steps``."""
        device, side = self.signal.device, self.config.side
        noise = steering.noise((2, side, side, side), 0).to(device)
        kinds = torch.tensor(steering.kinds, device=device)
        nobody = torch.full_like(kinds, len(self.config.classes))
        guided = steering.guidance != 1 and bool((kinds != nobody).any())
        goal = None if steering.start is None else torch.from_numpy(steering.start).to(device)[None]
        known = None if steering.known is None else torch.from_numpy(steering.known).to(device)
        strength = 1.0 if goal is None else steering.strength
        steps = torch.linspace((_TIMES - 1) * strength, 0, 2 * steering.steps).round().long().tolist()

        def noisy(step: int) -> Tensor:
            if goal is None:
                return noise
            return self.signal[step].sqrt() * goal + (1 - self.signal[step]).sqrt() * noise

        x = noise if strength == 1 else noisy(steps[0]).expand_as(noise)
        for now, then in zip(steps, [*steps[1:], -1], strict=True):
            if known is not None:
                x = torch.where(known, noisy(now), x)
            at = torch.full((len(x),), now, device=device)
            found = self.network(x, at, class_labels=kinds).float()
            if guided:
                without = self.network(x, at, class_labels=nobody).float()
                found = without + steering.guidance * (found - without)
            signal = self.signal[now]
            clean = ((x - (1 - signal).sqrt() * found) / signal.sqrt()).clamp(-1, 1)
            found = (x - signal.sqrt() * clean) / (1 - signal).sqrt()
            after = self.signal[then] if then >= 0 else torch.ones_like(signal)
            x = after.sqrt() * clean + (1 - after).sqrt() * found
            told()
        if known is not None and goal is not None:
            x = torch.where(known, goal, x)
        return x.cpu().numpy()
