"""The reference: a dense 3-D U-Net that predicts the noise.

Ho et al., "Denoising Diffusion Probabilistic Models" (NeurIPS 2020), with the cosine schedule of Nichol and
Dhariwal (2021), as Liu et al. (ICLR 2024, sec. 4) use it; sampled by DDIM (Song et al. 2021).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from monai.networks.nets.diffusion_model_unet import DiffusionModelUNet
from torch import Tensor, nn

from ..model_config import ModelConfig
from .steering import Steering
from .training_set import TrainingSet

_TIMES = 1000
_DROPPED = 0.1


class DenseDiffusion(nn.Module):
    """A U-Net on both truncated distances."""

    #: What is trained, and its share of the time.
    stages = (("unet", 1.0),)

    signal: Tensor

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        base = config.shape.channels
        # Attention where 16 or fewer vertices per side are left.
        levels = max(2, int(math.log2(config.side // 8)))
        channels = tuple(base * min(2**level, 4) for level in range(levels))
        attention = tuple(config.side >> level <= 16 and level > 0 for level in range(levels))
        self.network = DiffusionModelUNet(
            spatial_dims=3,
            in_channels=2,
            out_channels=2,
            channels=channels,
            attention_levels=attention,
            num_res_blocks=1,
            num_head_channels=base,
            norm_num_groups=min(8, base),
            num_class_embeds=len(config.classes) + 1,
        )
        at = torch.linspace(0, 1, _TIMES + 1, dtype=torch.float64)
        signal = torch.cos((at + 0.008) / 1.008 * torch.pi / 2).square()
        self.register_buffer("signal", (signal / signal[0])[1:].clamp(min=1e-5).float(), persistent=False)

    def part(self, stage: str) -> nn.Module:
        """What a stage trains."""
        return self.network

    def rate(self, stage: str, rate: float) -> float:
        """A stage's learning rate."""
        return rate

    def batch_size(self, stage: str, batch: int) -> int:
        """Objects per step of a stage."""
        return batch

    def prepare(self, stage: str, data: TrainingSet) -> TrainingSet:
        """What a stage draws its batches from."""
        return data

    def draw(
        self, stage: str, data: TrainingSet, chosen: Tensor, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """A batch of the rows ``chosen``, with all its chance, on the generator's device."""
        device, count = generator.device, len(chosen)
        x = data.fields(chosen, device)
        dropped = torch.rand(count, generator=generator, device=device) < _DROPPED
        return {
            "x": x,
            "noise": torch.randn(x.shape, generator=generator, device=device),
            "step": torch.randint(_TIMES, (count,), generator=generator, device=device),
            "kinds": torch.where(dropped, len(self.config.classes), data.kinds[chosen].to(device)),
        }

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        """The mean squared error of the noise."""
        noise, step = batch["noise"], batch["step"]
        signal = self.signal[step].view(-1, 1, 1, 1, 1)
        found = self.network(
            signal.sqrt() * batch["x"] + (1 - signal).sqrt() * noise, step, class_labels=batch["kinds"]
        )
        return (found.float() - noise).square().mean()

    @torch.no_grad()
    def sample(self, steering: Steering, told: Callable[[], None] = lambda: None) -> np.ndarray:
        """(B, 2, N, N, N) float32 truncated fields; ``told`` is called ``steering.steps`` times."""
        device, side = self.signal.device, self.config.side
        noise = steering.noise((2, side, side, side)).to(device)
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
        number = 0
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
            if (number := number + 1) % 2 == 0:
                told()
        if known is not None and goal is not None:
            x = torch.where(known, goal, x)
        return x.cpu().numpy()
