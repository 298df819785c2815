"""What lies in a model's folder: its card and its weights. Imports ``torch``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from safetensors.torch import load_file

from ..errors import UserError
from ..files import replacing
from .data_set import DataSet
from .model_config import ModelConfig
from .models import make_model
from .train_config import TrainConfig

if TYPE_CHECKING:
    from .models.dense_diffusion import DenseDiffusion
    from .models.latent_flow import LatentFlow
    from .models.shape_flow import ShapeFlow


def check_same(output: Path, made: ModelConfig, config: TrainConfig, data: DataSet) -> None:
    """Raises a UserError if the folder holds another model than is to be trained."""
    if not (output / "model.json").is_file():
        return
    old = ModelConfig.read(output / "model.json")
    told = json.loads((output / "model.json").read_text(encoding="utf-8"))
    if old != made or told.get("data") != data.config["digest"] or told.get("seed") != config.seed:
        raise UserError(
            f"'{output}' holds a model of another kind, size, seed or data set; choose another place with -o."
        )


def write_card(output: Path, made: ModelConfig, config: TrainConfig, data: DataSet) -> None:
    """Writes ``model.json``: what the model is, and what it is trained on."""
    card = {
        "config": made.to_dict(),
        "seed": config.seed,
        "data": data.config["digest"],
        "objects": sum(not record.held_out for record in data.records),
        "minutes": config.minutes,
        "steps": config.steps,
        "batch": config.batch,
        "rate": config.rate,
    }
    with replacing(output / "model.json") as partial:
        partial.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def load_model(folder: Path, device: torch.device) -> ShapeFlow | LatentFlow | DenseDiffusion:
    """The trained model of a folder.

    Raises:
        UserError: there is none, or its files are damaged or do not fit together.
    """
    made = ModelConfig.read(folder / "model.json")
    path = folder / "weights.safetensors"
    if not path.is_file():
        raise UserError(f"'{folder}' has no weights yet; train it with python -m gshell_mi.train.")
    model = make_model(made)
    try:
        model.load_state_dict(
            {
                name: value.float() if value.is_floating_point() else value
                for name, value in load_file(path).items()
            }
        )
    except Exception as error:
        raise UserError(
            f"'{path}' does not hold the weights of the model that model.json describes "
            f"({type(error).__name__}); train it again."
        ) from error
    return model.to(device).eval()
