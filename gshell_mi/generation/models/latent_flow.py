"""Flow matching on the latents of a convolutional autoencoder.

Lipman et al., "Flow Matching for Generative Modeling" (ICLR 2023), with straight paths from noise at t = 0 to
data at t = 1; the times of training are logit-normal (Esser et al. 2024). Latents instead of the data itself
are due to Rombach et al. (CVPR 2022).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor, nn

from ..encodings import BLOCK
from ..model_config import ModelConfig
from .autoencoder import Autoencoder
from .coded_set import CodedSet
from .steering import Steering
from .training_set import TrainingSet
from .transformer import TokenTransformer

#: Of the transformer's blocks, while training: sets of thousands are small for it.
_DROPOUT = 0.1
#: Objects per step of the flow, for each of the autoencoder's, which has hundreds of times the work with one.
_MORE_LATENTS = 8
#: From what is held to what is made it changes over so many cells.
_BLEND_CELLS = 2.0
#: Fields are encoded and decoded so many at once.
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
        noise = steering.noise((self.channels, *3 * (self.per_side,)), 0).to(device)
        start = goal = held = kept = None
        lost: Tensor | float = 0.0
        if steering.start is not None:
            start = torch.from_numpy(np.ascontiguousarray(steering.start, np.float32)).to(device)[None]
            goal = self.autoencoder.encode(start)
            lost = start - self.autoencoder.decode(goal)
            kept = 1 - steering.strength
        if steering.known is not None:
            if goal is None:
                raise ValueError("nothing is known where there is no start")
            held = self._tokens(self._whole_blocks(steering.known, device).expand_as(goal)) > 0
            away = ndimage.distance_transform_edt(steering.known)
            kept = torch.from_numpy(np.clip(away / _BLEND_CELLS, 0, 1).astype(np.float32)).to(device)
        tokens = self._flow(
            self._tokens(noise), steering, None if goal is None else self._tokens(goal), held, told
        )
        found = []
        for latents in self._latents(tokens).split(_CHUNK):
            fields = self.autoencoder.decode(latents)
            if start is not None and kept is not None:
                # What is held is held exactly; else what was lost is given back as far as all is kept.
                fields = fields + kept * (start - fields if held is not None else lost)
            found.append(fields.clamp(-1, 1).cpu().numpy())
        return np.concatenate(found)

    def _flow(
        self,
        noise: Tensor,
        steering: Steering,
        goal: Tensor | None,
        held: Tensor | None,
        told: Callable[[], None],
    ) -> Tensor:
        """From noise to data by Heun's method, the last step by Euler's.

        Args:
            goal: data to begin near of, or whose ``held`` parts stay.
        """
        kinds = torch.tensor(steering.kinds, device=noise.device)
        nobody = torch.full_like(kinds, len(self.config.classes))
        guided = steering.guidance != 1 and bool((kinds != nobody).any())
        first = 0.0 if goal is None else 1 - steering.strength
        times = torch.linspace(first, 1, steering.steps + 1).tolist()

        def velocity(x: Tensor, t: float) -> Tensor:
            at = torch.full((len(x),), t, device=x.device)
            if not guided:
                return self.flow(x, at, kinds).float()
            both = self.flow(x.repeat(2, 1, 1), at.repeat(2), torch.cat([kinds, nobody])).float()
            with_kind, without = both.chunk(2)
            return without + steering.guidance * (with_kind - without)

        def hold(x: Tensor, t: float) -> Tensor:
            if held is None or goal is None:
                return x
            return torch.where(held, (1 - t) * noise + t * goal, x)

        x = noise if goal is None else (1 - first) * noise + first * goal
        for now, then in itertools.pairwise(times):
            x = hold(x, now)
            if now < 1:
                v = velocity(x, now)
                if then < 1:
                    v = (v + velocity(x + (then - now) * v, then)) / 2
                x = x + (then - now) * v
            told()
        return hold(x, 1.0)

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
