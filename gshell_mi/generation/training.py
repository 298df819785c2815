"""The training of a model, which goes on where a kill left it. Imports ``torch``."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from safetensors import safe_open
from safetensors.torch import load_file, save
from torch import distributed

from ..errors import UserError
from ..files import replacing
from ..interrupt import check_interrupt, interrupts_held_back
from ..own_folder import OwnFolder, own_folder
from ..wording import counted
from .data_set import DataSet
from .model_config import ModelConfig
from .models import Steering, make_model
from .own_process import in_own_process
from .train_config import TrainConfig

if TYPE_CHECKING:
    from .models.block_flow import BlockFlow
    from .models.dense_diffusion import DenseDiffusion

_CHECKPOINT = "checkpoint.safetensors"
#: Seconds between checkpoints.
_SAVE_EVERY = 60.0
_WARM_UP = 100  # steps
#: The last part of the training, over which the rate falls to 0.
_COOL_DOWN = 0.3
_EMA = 0.9995
#: How many samples are drawn as it goes, and with how many steps.
_DRAWN, _DRAWN_STEPS = 8, 16


def train(data_set: Path, output: Path, config: TrainConfig, *, quiet: bool = True) -> str:
    """Trains a model, or goes on with it; returns what to tell about it.

    Args:
        data_set: the folder that ``make_data_set`` wrote.
        output: the model's folder.

    Raises:
        UserError: the set is missing or damaged, the folder is another's or holds another model, or the
            device has not enough memory.
    """
    run = _Processes.start(config.device)
    try:
        data = DataSet.open(data_set)
        records, sdf, msdf, _ = data.load(held_out=False)
        made = ModelConfig(config.model, config.size, data.side, tuple(data.classes), config.components)
        if not run.first:
            return _Training(config, made, run, None).run(records, sdf, msdf, quiet=True)
        output.mkdir(parents=True, exist_ok=True)
        with own_folder(output, "model") as folder:
            _check_same(output, made, config, data)
            folder.claim("model.json", "weights.safetensors", _CHECKPOINT, "log.jsonl")
            _write_card(output, made, config, data, len(records))
            return _Training(config, made, run, folder).run(records, sdf, msdf, quiet=quiet)
    except torch.OutOfMemoryError as error:
        raise UserError(f"The device has not enough memory for batches of {config.batch}; give a smaller "
                        f"--batch or --size, and the training goes on from its last checkpoint.") from error
    finally:
        run.end()


@dataclass(frozen=True)
class _Processes:
    """The processes that ``torchrun`` started, or this one alone."""

    rank: int
    count: int
    device: torch.device

    @classmethod
    def start(cls, device: str) -> _Processes:
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


class _Training:
    """The state of a training."""

    def __init__(self, config: TrainConfig, made: ModelConfig, run: _Processes, folder: OwnFolder | None):
        torch.manual_seed(config.seed)
        self.config, self.made, self.processes, self.folder = config, made, run, folder
        self.model = make_model(made)
        self.step, self.seconds = 0, 0.0

    def run(self, records: list, sdf: np.ndarray, msdf: np.ndarray, *, quiet: bool) -> str:
        kinds = [self.made.classes.index(record.kind) for record in records]
        prepared = self.model.prepare(sdf, msdf, kinds)
        del sdf, msdf
        device = self.processes.device
        self.model.to(device)
        self.ema = {name: value.detach().clone() for name, value in self.model.state_dict().items()}
        self.optimizer = torch.optim.AdamW(self.model.parameters(), lr=self.config.rate, betas=(0.9, 0.99),
                                           weight_decay=0.01)
        self._resume()
        forward: Callable[..., torch.Tensor] = self.model
        if self.processes.count > 1:
            forward = torch.nn.parallel.DistributedDataParallel(self.model)
        if device.type == "cuda":
            forward = torch.compile(forward, dynamic=True)  # pyright: ignore[reportAssignmentType]
        columns = (TextColumn("training"), BarColumn(), TextColumn("{task.percentage:.0f} %"),
                   TimeRemainingColumn(), TextColumn("{task.fields[loss]}"))
        saved, smooth = time.perf_counter(), None
        with Progress(*columns, console=Console(stderr=True), disable=quiet) as progress:
            bar = progress.add_task("", total=1.0, loss="")
            progress.update(bar, completed=self._share())
            drawn = math.floor(self._share() * self.config.pictures)
            while not self.processes.agreed(self._share() >= 1):
                try:
                    check_interrupt()
                    with interrupts_held_back():
                        began = time.perf_counter()
                        loss = self._take_step(forward, prepared)
                        self.step += 1
                        self.seconds += time.perf_counter() - began
                        self._log({"step": self.step, "seconds": round(self.seconds, 3),
                                   "loss": round(loss, 6)})
                except KeyboardInterrupt:
                    self._save()
                    raise
                smooth = loss if smooth is None else 0.98 * smooth + 0.02 * loss
                progress.update(bar, completed=self._share(), loss=f"step {self.step}, loss {smooth:.4f}")
                if self.folder is None:
                    continue
                if time.perf_counter() - saved > _SAVE_EVERY:
                    self._save()
                    saved = time.perf_counter()
                if math.floor(self._share() * self.config.pictures) > drawn:
                    drawn += 1
                    self._draw()
        if self.folder is not None:
            self._save()
        return f"{counted(self.step, 'step')} in {self.seconds / 60:.1f} minutes" + (
            "" if smooth is None else f", loss {smooth:.4f}")

    def _share(self) -> float:
        """How much of the training is done, from 0 to 1."""
        if self.config.steps is not None:
            return min(1.0, self.step / max(self.config.steps, 1))
        return min(1.0, self.seconds / max(60 * self.config.minutes, 1e-9))

    def _take_step(self, forward: Callable[..., torch.Tensor], prepared) -> float:
        # All chance is drawn anew for each step from its number, so that a resumed run sees the same.
        number = (self.config.seed * 1_000_003 + self.step) * self.processes.count + self.processes.rank
        generator = torch.Generator().manual_seed(number)
        chosen = torch.randint(len(prepared), (self.config.batch,), generator=generator)
        device = self.processes.device
        batch = {name: value.to(device, non_blocking=True)
                 for name, value in self.model.batch(prepared, chosen).items()}
        share = self._share()
        rate = self.config.rate * min(1.0, (self.step + 1) / _WARM_UP) * min(1.0, (1 - share) / _COOL_DOWN)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        half = torch.autocast("cuda", torch.bfloat16) if device.type == "cuda" else nullcontext()
        with half:
            loss = forward(batch, generator)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        self.optimizer.step()
        # Short trainings forget sooner.
        keep = min(_EMA, (self.step + 1) / (self.step + 10))
        with torch.no_grad():
            for name, value in self.model.state_dict().items():
                if value.is_floating_point():
                    self.ema[name].lerp_(value, 1 - keep)
        return float(loss.detach())

    # -- files ----------------------------------------------------------------------------------------

    def _save(self) -> None:
        if self.folder is None:
            return
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"ema.{name}": value for name, value in self.ema.items()}
        for name, parameter in self.model.named_parameters():
            for key, value in self.optimizer.state.get(parameter, {}).items():
                tensors[f"adam.{key}.{name}"] = torch.as_tensor(value)
        told = {"step": str(self.step), "seconds": repr(self.seconds)}
        tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
        with replacing(self.folder.path / _CHECKPOINT) as partial:
            partial.write_bytes(save(tensors, told))
        half = {name: value.detach().cpu().half().contiguous() for name, value in self.ema.items()}
        with replacing(self.folder.path / "weights.safetensors") as partial:
            partial.write_bytes(save(half, told))

    def _resume(self) -> None:
        path = None if self.folder is None else self.folder.path / _CHECKPOINT
        if path is not None and path.is_file():
            try:
                with safe_open(path, "pt") as file:
                    told = file.metadata()
                self._restore(load_file(path), told)
            except Exception as error:  # the readers raise whatever they stumble over
                raise UserError(f"'{path}' cannot be read ({type(error).__name__}); remove it to train from "
                                f"the start.") from error
            self._cut_log()
        if self.processes.count > 1:
            self._share_state()

    def _restore(self, tensors: dict[str, torch.Tensor], told: dict[str, str]) -> None:
        device = self.processes.device
        self.model.load_state_dict({name: tensors[f"model.{name}"] for name in self.model.state_dict()})
        self.ema = {name: tensors[f"ema.{name}"].to(device) for name in self.ema}
        for name, parameter in self.model.named_parameters():
            prefix = "adam."
            state = {key: tensors[f"{prefix}{key}.{name}"] for key in ("step", "exp_avg", "exp_avg_sq")
                     if f"{prefix}{key}.{name}" in tensors}
            if state:
                self.optimizer.state[parameter] = {
                    key: value if key == "step" else value.to(device) for key, value in state.items()}
        self.step, self.seconds = int(told["step"]), float(told["seconds"])

    def _share_state(self) -> None:
        """Gives the first process's state to the others."""
        told = [self.step, self.seconds, self.optimizer.state_dict()]
        distributed.broadcast_object_list(told, 0)
        self.step, self.seconds = told[0], told[1]
        if not self.processes.first:
            self.optimizer.load_state_dict(told[2])
        for value in self.model.state_dict().values():
            distributed.broadcast(value, 0)

    def _log(self, line: dict) -> None:
        if self.folder is None:
            return
        with open(self.folder.path / "log.jsonl", "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def _cut_log(self) -> None:
        """Takes out the lines of steps that are taken again."""
        path = None if self.folder is None else self.folder.path / "log.jsonl"
        if path is None or not path.is_file():
            return
        lines = path.read_text(encoding="utf-8").splitlines()[: self.step]
        with replacing(path) as partial:
            partial.write_text("".join(line + "\n" for line in lines), encoding="utf-8")

    def _draw(self) -> None:
        """A page of samples of the mean weights."""
        if self.folder is None:
            return
        kept = {name: value.detach().clone() for name, value in self.model.state_dict().items()}
        self.model.load_state_dict(self.ema)
        self.model.eval()
        kinds = [i % len(self.made.classes) for i in range(_DRAWN)]
        fields = self.model.sample(Steering(kinds, [(i, i, 0.0) for i in range(_DRAWN)], steps=_DRAWN_STEPS))
        self.model.train()
        self.model.load_state_dict(kept)
        name = f"samples/{self.step:07d}.png"
        self.folder.claim(name)
        (self.folder.path / "samples").mkdir(exist_ok=True)
        from .drawn import draw_fields

        in_own_process(draw_fields, self.folder.path / name, fields, [self.made.classes[k] for k in kinds],
                       variant="llvm_ad_rgb")


def _check_same(output: Path, made: ModelConfig, config: TrainConfig, data: DataSet) -> None:
    if not (output / "model.json").is_file():
        return
    old = ModelConfig.read(output / "model.json")
    told = json.loads((output / "model.json").read_text(encoding="utf-8"))
    if old != made or told.get("data") != data.config["digest"] or told.get("seed") != config.seed:
        raise UserError(f"'{output}' holds a model of another kind, size, seed or data set; choose another "
                        f"place with -o.")


def _write_card(output: Path, made: ModelConfig, config: TrainConfig, data: DataSet, objects: int) -> None:
    card = {"config": made.to_dict(), "seed": config.seed, "data": data.config["digest"], "objects": objects,
            "minutes": config.minutes, "steps": config.steps, "batch": config.batch, "rate": config.rate}
    with replacing(output / "model.json") as partial:
        partial.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def load_model(folder: Path, device: torch.device) -> BlockFlow | DenseDiffusion:
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
        model.load_state_dict({name: value.float() for name, value in load_file(path).items()})
    except Exception as error:
        raise UserError(f"'{path}' does not hold the weights of the model that model.json describes "
                        f"({type(error).__name__}); train it again.") from error
    return model.to(device).eval()
