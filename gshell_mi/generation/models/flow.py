"""Samples of models that learn by flow matching: from noise to codes of fields, and to the fields.

Lipman et al., "Flow Matching for Generative Modeling" (ICLR 2023), with straight paths from noise at t = 0 to
data at t = 1.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor, nn

from .steering import Steering

#: From what is held to what is made it changes over so many cells.
_BLEND_CELLS = 2.0
#: Fields are decoded so many at once.
_CHUNK = 16

#: Of codes (B, ...) at a time.
Velocity = Callable[[Tensor, float], Tensor]


def start_of(steering: Steering, device: torch.device) -> Tensor | None:
    """(1, 2, N, N, N): the fields to begin from; None for noise."""
    if steering.start is None:
        if steering.known is not None:
            raise ValueError("nothing is known where there is no start")
        return None
    return torch.from_numpy(np.ascontiguousarray(steering.start, np.float32)).to(device)[None]


def guided(flow: nn.Module, steering: Steering, classes: int, device: torch.device) -> Velocity:
    """The velocity that a network gives, with the class as heavy as ``steering`` says.

    Args:
        flow: of codes, times (B,) and classes (B,).
        classes: how many there are; the number that stands for none.
    """
    kinds = torch.tensor(steering.kinds, device=device)
    nobody = torch.full_like(kinds, classes)
    weighted = steering.guidance != 1 and bool((kinds != nobody).any())

    def velocity(x: Tensor, t: float) -> Tensor:
        at = torch.full((len(x),), t, device=x.device)
        found = flow(x, at, kinds).float()
        if not weighted:
            return found
        without = flow(x, at, nobody).float()
        return without + steering.guidance * (found - without)

    return velocity


def integrated(
    velocity: Velocity,
    noise: Tensor,
    goal: Tensor | None,
    steering: Steering,
    told: Callable[[], None],
    hold: Velocity = lambda x, t: x,
) -> Tensor:
    """From noise to data by Heun's method, the last step by Euler's.

    Args:
        noise: (B, ...).
        goal: data to begin near of, as far as ``steering.strength`` leaves it; None for noise.
        told: called after each of ``steering.steps``.
        hold: puts what is known into codes at a time.
    """
    first = 0.0 if goal is None else 1 - steering.strength
    x = noise if goal is None else (1 - first) * noise + first * goal
    for now, then in itertools.pairwise(torch.linspace(first, 1, steering.steps + 1).tolist()):
        x = hold(x, now)
        if now < 1:
            v = velocity(x, now)
            if then < 1:
                v = (v + velocity(x + (then - now) * v, then)) / 2
            x = x + (then - now) * v
        told()
    return hold(x, 1.0)


def blended(
    decode: Callable[[Tensor], Tensor],
    codes: Tensor,
    steering: Steering,
    start: Tensor | None,
    goal: Tensor | None,
) -> np.ndarray:
    """(B, 2, N, N, N) fields of codes. What is known is held exactly; else what the code loses of ``start``
    is given back as far as all is kept.

    Args:
        goal: the code of ``start``.
    """
    kept, lost = 0.0, 0.0
    if start is not None and goal is not None:
        kept, lost = 1 - steering.strength, start - decode(goal)
    if steering.known is not None:
        away = ndimage.distance_transform_edt(steering.known)
        kept = torch.from_numpy(np.clip(away / _BLEND_CELLS, 0, 1).astype(np.float32)).to(codes.device)
    found = []
    for part in codes.split(_CHUNK):
        fields = decode(part)
        if start is not None:
            fields = fields + kept * (lost if steering.known is None else start - fields)
        found.append(fields.clamp(-1, 1).cpu().numpy())
    return np.concatenate(found)
