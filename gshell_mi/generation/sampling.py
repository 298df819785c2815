"""Samples of a trained model, as fields. Imports ``torch``."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import torch
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

from ..bars import Bars
from ..errors import UserError
from .model_folder import load_model
from .models import Steering
from .request import Request


def sample_fields(folder: Path, request: Request) -> tuple[np.ndarray, float]:
    """(n, 2, N, N, N) truncated fields, and the seconds that they took.

    Raises:
        UserError: there is no such model, or the device is missing or has not enough memory.
    """
    device = request.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("PyTorch finds no GPU; use --device cpu, or install PyTorch with CUDA.")
    model = load_model(folder, torch.device(device))
    none = len(model.config.classes)
    kinds = [none if kind is None else kind for kind in request.kinds]
    started, found = time.perf_counter(), []
    columns = (
        TextColumn("sampling"),
        BarColumn(),
        TextColumn("{task.percentage:.0f} %"),
        TimeRemainingColumn(),
    )
    with Bars(*columns, quiet=request.quiet) as progress:
        batches = range(0, len(kinds), request.batch)
        bar = progress.add_task("", total=request.steps * len(batches))
        for first in batches:
            part = slice(first, first + request.batch)
            steering = Steering(
                kinds[part],
                request.seeds[part],
                request.guidance,
                request.steps,
                request.start,
                request.strength,
                request.known,
            )
            try:
                found.append(model.sample(steering, lambda: progress.advance(bar)))
            except torch.OutOfMemoryError as error:
                raise UserError(
                    f"The device has not enough memory for {request.batch} samples at once; give "
                    f"a smaller --batch."
                ) from error
    return np.concatenate(found), time.perf_counter() - started
