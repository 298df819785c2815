"""Flow matching on the blocks near the surface: first where they are, then what they hold.

Lipman et al., "Flow Matching for Generative Modeling" (ICLR 2023), with straight paths from noise at t = 0 to
data at t = 1; the times of training are logit-normal (Esser et al. 2024).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from ..encodings import BLOCK, BLOCK_VALUES, BlockEncoding, Principal, from_blocks
from ..fields import TruncatedFields
from ..model_config import ModelConfig
from .steering import Steering
from .transformer import TokenTransformer

#: How often a class is left out in training, so that the model knows the mean over all.
_DROPPED = 0.1
#: A block is known where all is that is so near the surface, by the truncation.
_NEAR = 0.5
#: Blocks of which principal components are taken.
_MOST_BLOCKS = 40_000


@dataclass
class Prepared:
    """A training set as tokens."""

    layout: Tensor
    """(n, blocks of the grid) bool: which are near the surface."""
    tokens: list[Tensor]
    """n times (B, components) float16."""
    kinds: Tensor
    """(n,)."""

    def __len__(self) -> int:
        return len(self.kinds)


class BlockFlow(nn.Module):
    """Two transformers: ``layout`` for which blocks there are, ``content`` for what is in them."""

    mean: Tensor
    basis: Tensor
    scale: Tensor

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.per_side = config.side // BLOCK
        # Blocks are told in cubes of two per side where they come in pairs, which makes fewer tokens.
        self.group = 2 if self.per_side % 2 == 0 else 1
        shape = {name: config.shape[name] for name in ("width", "depth", "heads")}
        classes = len(config.classes)
        self.layout = TokenTransformer(self.group**3, self.per_side // self.group, classes, **shape)
        self.content = TokenTransformer(config.components, self.per_side, classes, **shape)
        self.register_buffer("mean", torch.zeros(BLOCK_VALUES))
        self.register_buffer("basis", torch.zeros(BLOCK_VALUES, config.components))
        self.register_buffer("scale", torch.ones(()))

    # -- training -------------------------------------------------------------------------------------

    def prepare(self, sdf: np.ndarray, msdf: np.ndarray, kinds: list[int]) -> Prepared:
        """A training set (n, N, N, N) as tokens; fits the principal components to it, unless they are."""
        encoding = BlockEncoding()
        codes = [encoding.encode(TruncatedFields(s.astype(np.float32), m.astype(np.float32)))
                 for s, m in zip(sdf, msdf, strict=True)]
        if not bool(self.basis.any()):
            values = np.concatenate([code["values"] for code in codes])
            chosen = np.random.default_rng(0).permutation(len(values))[:_MOST_BLOCKS]
            found = Principal.of(values[chosen], self.config.components)
            self.mean.copy_(torch.from_numpy(found.mean))
            self.basis.copy_(torch.from_numpy(found.basis))
            self.scale.fill_(found.scale)
        codec = self._codec()
        layout = np.zeros((len(codes), self.per_side**3), bool)
        for row, code in zip(layout, codes, strict=True):
            row[code["blocks"]] = True
        tokens = [torch.from_numpy(codec.encode(code["values"]).astype(np.float16)) for code in codes]
        return Prepared(torch.from_numpy(layout), tokens, torch.tensor(kinds))

    def batch(self, data: Prepared, chosen: Tensor) -> dict[str, Tensor]:
        """The rows ``chosen``, filled up to equal numbers of tokens."""
        layout, count = data.layout[chosen], len(chosen)
        most = int(layout.sum(dim=1).max())
        tokens = torch.zeros(count, most, self.config.components)
        place = torch.zeros(count, most, dtype=torch.long)
        present = torch.zeros(count, most, dtype=torch.bool)
        for row, index in enumerate(chosen.tolist()):
            held = data.tokens[index]
            tokens[row, : len(held)] = held.float()
            place[row, : len(held)] = layout[row].nonzero()[:, 0]
            present[row, : len(held)] = True
        return {"layout": layout, "tokens": tokens, "place": place, "present": present,
                "kinds": data.kinds[chosen]}

    def forward(self, batch: dict[str, Tensor], generator: torch.Generator) -> Tensor:
        """The mean squared error of both velocities, times two."""
        layout = self._grouped(2.0 * batch["layout"].float() - 1)
        place, present = self._layout_places(len(layout), layout.device)
        loss = self._loss(self.layout, layout, place, present, batch["kinds"], generator)
        return loss + self._loss(self.content, batch["tokens"], batch["place"], batch["present"],
                                 batch["kinds"], generator)

    def _loss(self, network: TokenTransformer, x: Tensor, place: Tensor, present: Tensor, kinds: Tensor,
              generator: torch.Generator) -> Tensor:
        # Drawn on the host, so that devices agree.
        t = torch.sigmoid(torch.randn(len(x), generator=generator)).to(x.device)
        noise = torch.randn(x.shape, generator=generator).to(x.device)
        dropped = (torch.rand(len(x), generator=generator) < _DROPPED).to(x.device)
        kinds = torch.where(dropped, len(self.config.classes), kinds)
        at = t[:, None, None]
        found = network((1 - at) * noise + at * x, place, present, t, kinds)
        error = (found.float() - (x - noise)).square().mean(dim=2)
        return (error * present).sum() / present.sum()

    # -- sampling -------------------------------------------------------------------------------------

    @torch.no_grad()
    def sample(self, steering: Steering, told: Callable[[], None] = lambda: None) -> np.ndarray:
        """(B, 2, N, N, N) float32 truncated fields.

        Args:
            told: called after each step, of which there are ``2 steering.steps``.
        """
        device, count = self.mean.device, len(steering.kinds)
        start = known_layout = known_blocks = near = None
        if steering.start is not None:
            table, near = self._table(steering.start)
            start = (torch.from_numpy(table).to(device), torch.from_numpy(near).to(device))
        if steering.known is not None:
            if steering.start is None or near is None:
                raise ValueError("nothing is known where there is no start")
            far = np.abs(steering.start[0]) > _NEAR
            blocks = self._wholly(steering.known | far) & near
            known_blocks = torch.from_numpy(blocks).to(device)
            known_layout = self._grouped(known_blocks[None].float())[0] > 0
        place, present = self._layout_places(count, device)
        noise = self._grouped(steering.noise((self.per_side**3,), 0).to(device))
        goal = None if start is None else self._grouped(2.0 * start[1][None].float() - 1)
        layout = self._flow(self.layout, noise, place, present, steering, goal, known_layout, told)
        layout = self._ungrouped(layout)
        active = layout > 0
        active[~active.any(dim=1), layout.mean(dim=0).argmax()] = True  # no sample is empty
        if known_blocks is not None:
            active |= known_blocks

        most = int(active.sum(dim=1).max())
        # The active blocks of each row first, in order.
        place = torch.argsort((~active).to(torch.int8), dim=1, stable=True)[:, :most]
        present = torch.gather(active, 1, place)
        noise = steering.noise((self.per_side**3, self.config.components), 1).to(device)
        noise = torch.stack([row[where] for row, where in zip(noise, place, strict=True)])
        goal = None if start is None else start[0][place]
        known = None if known_blocks is None else known_blocks[place][:, :, None]
        tokens = self._flow(self.content, noise, place, present, steering, goal, known, told)
        codec, side = self._codec(), self.config.side
        result = np.empty((count, 2, side, side, side), np.float32)
        for row in range(count):
            there = present[row]
            values = codec.decode(tokens[row][there].cpu().numpy())
            fields = from_blocks(place[row][there].cpu().numpy(), np.clip(values, -1, 1), side)
            result[row] = fields.sdf, fields.msdf
        return result

    def _flow(self, network: TokenTransformer, noise: Tensor, place: Tensor, present: Tensor,
              steering: Steering, goal: Tensor | None, known: Tensor | None,
              told: Callable[[], None]) -> Tensor:
        """From noise to data by Heun's method, the last step by Euler's.

        Args:
            goal: data to begin near of, or whose ``known`` parts are held fixed.
        """
        kinds = torch.tensor(steering.kinds, device=noise.device)
        nobody = torch.full_like(kinds, len(self.config.classes))
        guided = steering.guidance != 1 and bool((kinds != nobody).any())
        first = 0.0 if goal is None else 1 - steering.strength
        times = torch.linspace(first, 1, steering.steps + 1).tolist()

        def velocity(x: Tensor, t: float) -> Tensor:
            at = torch.full((len(x),), t, device=x.device)
            if not guided:
                return network(x, place, present, at, kinds).float()
            both = network(x.repeat(2, 1, 1), place.repeat(2, 1), present.repeat(2, 1), at.repeat(2),
                           torch.cat([kinds, nobody])).float()
            with_kind, without = both.chunk(2)
            return without + steering.guidance * (with_kind - without)

        def held(x: Tensor, t: float) -> Tensor:
            if known is None or goal is None:
                return x
            return torch.where(known, (1 - t) * noise + t * goal, x)

        x = noise if goal is None else (1 - first) * noise + first * goal
        for now, then in itertools.pairwise(times):
            x = held(x, now)
            v = velocity(x, now)
            if then < 1:
                v = (v + velocity(x + (then - now) * v, then)) / 2
            x = x + (then - now) * v
            told()
        return held(x, 1.0)

    # -- layouts and blocks ---------------------------------------------------------------------------

    def _codec(self) -> Principal:
        return Principal(self.mean.cpu().numpy(), self.basis.cpu().numpy(), float(self.scale))

    def _layout_places(self, count: int, device: torch.device) -> tuple[Tensor, Tensor]:
        places = torch.arange((self.per_side // self.group) ** 3, device=device).expand(count, -1)
        return places, torch.ones_like(places, dtype=torch.bool)

    def _grouped(self, layout: Tensor) -> Tensor:
        """(B, blocks) as (B, groups, blocks per group)."""
        coarse, group = self.per_side // self.group, self.group
        split = layout.view(-1, coarse, group, coarse, group, coarse, group)
        return split.permute(0, 1, 3, 5, 2, 4, 6).reshape(len(layout), coarse**3, group**3)

    def _ungrouped(self, layout: Tensor) -> Tensor:
        coarse, group = self.per_side // self.group, self.group
        split = layout.view(-1, coarse, coarse, coarse, group, group, group)
        return split.permute(0, 1, 4, 2, 5, 3, 6).reshape(len(layout), self.per_side**3)

    def _table(self, fields: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The tokens of all blocks (blocks, components), and which are near the surface."""
        code = BlockEncoding().encode(TruncatedFields(*fields))
        active = np.zeros(self.per_side**3, bool)
        active[code["blocks"]] = True
        split = fields.reshape(2, *(x for _ in range(3) for x in (self.per_side, BLOCK)))
        values = split.transpose(1, 3, 5, 0, 2, 4, 6).reshape(self.per_side**3, BLOCK_VALUES)
        return self._codec().encode(values).astype(np.float32), active

    def _wholly(self, known: np.ndarray) -> np.ndarray:
        """(blocks,) those that are known everywhere."""
        split = known.reshape(*(x for _ in range(3) for x in (self.per_side, BLOCK)))
        blocks = split.transpose(0, 2, 4, 1, 3, 5).reshape(self.per_side**3, -1)
        return np.asarray(blocks.all(axis=1))
