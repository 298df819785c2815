"""The processes that train one model. Imports ``torch``."""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch
from torch import distributed

from ..errors import UserError


@dataclass(frozen=True)
class Processes:
    """The processes that ``torchrun`` started, or this one alone."""

    rank: int
    count: int
    device: torch.device

    @classmethod
    def start(cls, device: str) -> Processes:
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        if device == "cuda" and not torch.cuda.is_available():
            raise UserError("PyTorch finds no GPU; use --device cpu, or install PyTorch with CUDA.")
        rank, count = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
        if device == "cuda":
            device = f"cuda:{os.environ.get('LOCAL_RANK', 0)}"
            torch.cuda.set_device(device)
        if count > 1:
            distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
        return cls(rank, count, torch.device(device))

    @property
    def first(self) -> bool:
        return self.rank == 0

    def end(self) -> None:
        if self.count > 1 and distributed.is_initialized():
            distributed.destroy_process_group()

    def agreed(self, flag: bool) -> bool:
        """What the first process says."""
        if self.count == 1:
            return flag
        told = torch.tensor([float(flag)], device=self.device)
        distributed.broadcast(told, 0)
        return bool(told.item())
