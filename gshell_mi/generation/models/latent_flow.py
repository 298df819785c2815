"""Flow matching on the latents of a convolutional autoencoder.

Lipman et al., "Flow Matching for Generative Modeling" (ICLR 2023), with straight paths from noise at t = 0 to
data at t = 1; the times of training are logit-normal (Esser et al. 2024). Latents instead of the data itself
are due to Rombach et al. (CVPR 2022).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from ..encodings import BLOCK
from ..model_config import ModelConfig
from .autoencoder import Autoencoder
from .coded_set import CodedSet
from .flow import Velocity, blended, guided, integrated, start_of
from .steering import Steering
from .training_set import TrainingSet
from .transformer import TokenTransformer

#: Of the transformer's blocks, while training: sets of thousands are small for it.
_DROPOUT = 0.1
#: Objects per step of the flow, for each of the autoencoder's, which has hundreds of times the work with one.
_MORE_LATENTS = 8
#: Fields are encoded so many at once.
_CHUNK = 16


class LatentFlow(nn.Module):
    """An autoencoder, and a transformer that turns noise into its latents."""

    #: What is trained, one after the other, and each one's share of the time.
    stages = (("autoencoder", 0.6), ("flow", 0.4))

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.per_side = config.side // BLOCK
        # A token is a cube of two blocks per side where they come in pairs.
        self.group = 2 if self.per_side % 2 == 0 else 1
        shape = config.shape
        self.channels = shape.latents
        self.autoencoder = Autoencoder(shape.latents, shape.features)
        self.flow = TokenTransformer(
            shape.latents * self.group**3,
            self.per_side // self.group,
            len(config.classes),
            shape.width,
            shape.depth,
            shape.heads,
            _DROPOUT,
        )

    # -- training -------------------------------------------------------------------------------------

    def part(self, stage: str) -> nn.Module:
        """What a stage trains."""
        return self.autoencoder if stage == "autoencoder" else self.flow

    def rate(self, stage: str, rate: float) -> float:
        """A stage's learning rate."""
        return 2 * rate if stage == "autoencoder" else rate

    def batch_size(self, stage: str, batch: int) -> int:
        """Objects per step of a stage."""
        return batch if stage == "autoencoder" else _MORE_LATENTS * batch

    @torch.no_grad()
    def prepare(self, stage: str, data: TrainingSet) -> TrainingSet | CodedSet:
        """What a stage draws its batches from."""
        if stage == "autoencoder":
            return data
        kept = [
            self._tokens(self.autoencoder.encode(part)).half()
            for part in data.parts(_CHUNK, self.autoencoder.mean.device)
        ]
        return CodedSet(torch.cat(kept), data.kinds.to(kept[0].device))

    def draw(
        self, stage: str, data: TrainingSet | CodedSet, chosen: Tensor, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """A batch of the rows ``chosen``, with all its chance, on the generator's device."""
        if isinstance(data, TrainingSet):
            device, size = generator.device, (len(chosen), self.channels, *3 * (self.per_side,))
            return {
                "fields": data.fields(chosen, device),
                "noise": torch.randn(size, generator=generator, device=device),
            }
        return data.draw(chosen, len(self.config.classes), generator)

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        """The autoencoder's error, or the mean squared one of the velocity."""
        if "fields" in batch:
            return self.autoencoder(batch["fields"], batch["noise"])
        x, noise = batch["x"], batch["noise"]
        at = batch["t"][:, None, None]
        found = self.flow((1 - at) * noise + at * x, batch["t"], batch["kinds"])
        return (found.float() - (x - noise)).square().mean()

    def coded(self, fields: Tensor) -> tuple[Tensor, int]:
        """Fields after a way through the latents, and the numbers of each."""
        latents = self.autoencoder.encode(fields)
        return self.autoencoder.decode(latents), latents[0].numel()

    # -- sampling -------------------------------------------------------------------------------------

    @torch.no_grad()
    def sample(self, steering: Steering, told: Callable[[], None] = lambda: None) -> np.ndarray:
        """(B, 2, N, N, N) float32 truncated fields.

        What the autoencoder loses of ``steering.start`` is given back to the part that is kept of it.

        Args:
            told: called after each of ``steering.steps``.
        """
        device = self.autoencoder.mean.device
        noise = steering.noise((self.channels, *3 * (self.per_side,))).to(device)
        start = start_of(steering, device)
        goal = None if start is None else self.autoencoder.encode(start)
        tokens = integrated(
            guided(self.flow, steering, len(self.config.classes), device),
            self._tokens(noise),
            None if goal is None else self._tokens(goal),
            steering,
            told,
            self._holding(noise, goal, steering.known),
        )
        return blended(self.autoencoder.decode, self._latents(tokens), steering, start, goal)

    def _holding(self, noise: Tensor, goal: Tensor | None, known: np.ndarray | None) -> Velocity:
        """What puts the blocks that are known everywhere into tokens at a time, on the way from noise to
        ``goal``."""
        if known is None or goal is None:
            return lambda x, t: x
        held = self._tokens(self._whole_blocks(known, noise.device).expand_as(goal)) > 0
        begin, end = self._tokens(noise), self._tokens(goal)
        return lambda x, t: torch.where(held, (1 - t) * begin + t * end, x)

    # -- latents and tokens ---------------------------------------------------------------------------

    def _tokens(self, latents: Tensor) -> Tensor:
        """(B, C, n, n, n) as (B, tokens, C group^3)."""
        coarse, group = self.per_side // self.group, self.group
        split = latents.reshape(len(latents), self.channels, coarse, group, coarse, group, coarse, group)
        return split.permute(0, 2, 4, 6, 1, 3, 5, 7).reshape(len(latents), coarse**3, -1)

    def _latents(self, tokens: Tensor) -> Tensor:
        coarse, group = self.per_side // self.group, self.group
        split = tokens.view(len(tokens), coarse, coarse, coarse, self.channels, group, group, group)
        return split.permute(0, 4, 1, 5, 2, 6, 3, 7).reshape(
            len(tokens), self.channels, *3 * (self.per_side,)
        )

    def _whole_blocks(self, known: np.ndarray, device: torch.device) -> Tensor:
        """(1, 1, n, n, n): 1 for the blocks that are known everywhere."""
        n = self.per_side
        split = known.reshape(n, BLOCK, n, BLOCK, n, BLOCK)
        return torch.from_numpy(split.all(axis=(1, 3, 5)).astype(np.float32)).to(device)[None, None]
