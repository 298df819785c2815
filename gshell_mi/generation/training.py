"""The training of a model, which goes on where a kill left it. Imports ``torch``."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from safetensors import safe_open
from safetensors.torch import load_file, save
from torch import distributed

from ..bars import Bars
from ..errors import UserError
from ..files import replacing
from ..interrupt import check_interrupt, interrupts_held_back
from ..own_folder import OwnFolder, own_folder
from ..wording import counted
from .data_set import DataSet
from .model_config import ModelConfig
from .model_folder import check_same, load_model, write_card
from .models import Steering, make_model
from .models.training_set import TrainingSet
from .own_process import in_own_process
from .processes import Processes
from .train_config import TrainConfig

if TYPE_CHECKING:
    from .models.dense_diffusion import DenseDiffusion
    from .models.latent_flow import LatentFlow
    from .models.shape_flow import ShapeFlow

_CHECKPOINT = "checkpoint.safetensors"
#: Seconds between checkpoints.
_SAVE_EVERY = 60.0
_WARM_UP = 100  # steps
#: The last part of the training, over which the rate falls to 0.
_COOL_DOWN = 0.3
_EMA = 0.9995
#: How many samples are drawn as it goes, and with how many steps.
_DRAWN, _DRAWN_STEPS = 8, 16
#: How often in a stage the held-out objects are tried, in so many batches at most.
_CHECKS, _CHECKED = 20, 4
#: On a GPU losses come back so many at once, so that it need not wait.
_LOGGED = 50


def train(data_set: Path, output: Path, config: TrainConfig, *, quiet: bool = True) -> str:
    """Trains a model, or goes on with it; returns what to tell about it.

    Args:
        data_set: the folder that ``make_data_set`` wrote.
        output: the model's folder.

    Raises:
        UserError: the set is missing or damaged, the folder is another's or holds another model, or the
            device has not enough memory.
    """
    run = Processes.start(config.device)
    try:
        data = DataSet.open(data_set)
        made = ModelConfig(config.model, config.size, data.side, tuple(data.classes))
        tested = run.first and any(record.held_out for record in data.records)
        training, *tests = _loaded(data, config, run.device, *((False, True) if tested else (False,)))
        if not run.first:
            return _Training(config, made, run, None).run(training, None, quiet=True)
        output.mkdir(parents=True, exist_ok=True)
        with own_folder(output, "model") as folder:
            check_same(output, made, config, data)
            folder.claim("model.json", "weights.safetensors", _CHECKPOINT, "log.jsonl")
            write_card(output, made, config, data)
            return _Training(config, made, run, folder).run(
                training, tests[0] if tests else None, quiet=quiet
            )
    except torch.OutOfMemoryError as error:
        raise UserError(
            f"The device has not enough memory for batches of {config.batch}; give a smaller "
            f"--batch or --size, and the training goes on from its last checkpoint."
        ) from error
    finally:
        run.end()


def _loaded(data: DataSet, config: TrainConfig, device: torch.device, *splits: bool) -> list[TrainingSet]:
    """Splits of a set, of which True is what is held out."""
    found = []
    for held_out, (records, sdf, msdf, _) in zip(splits, data.load_splits(*splits), strict=True):
        kinds = [data.classes.index(record.kind) for record in records]
        found.append(TrainingSet(sdf, msdf, kinds, mirror=config.mirror and not held_out, device=device))
    return found


@dataclass(frozen=True)
class _Spent:
    """What a training has taken so far."""

    step: int = 0
    seconds: float = 0.0

    def plus(self, other: _Spent) -> _Spent:
        return _Spent(self.step + other.step, self.seconds + other.seconds)


class _Training:
    """The state of a training: of one stage after the other, each with its own optimizer and mean weights."""

    def __init__(self, config: TrainConfig, made: ModelConfig, run: Processes, folder: OwnFolder | None):
        torch.manual_seed(config.seed)
        self.config, self.made, self.processes, self.folder = config, made, run, folder
        self.model = make_model(made).to(run.device)
        if run.device.type == "cuda":
            self.model.to(memory_format=torch.channels_last_3d)
            torch.backends.cudnn.benchmark = True
        self.stages = self.model.stages
        if config.autoencoder is not None:
            _take_autoencoder(self.model, config.autoencoder)
            self.stages = (("flow", 1.0),)
        self.stage = 0
        self.earlier = _Spent()
        """Of the stages that are done."""
        self.spent = _Spent()
        """Of this stage."""
        self.best, self.best_weights = math.inf, {}
        self.waiting: list[tuple[dict, torch.Tensor]] = []
        """Lines of the log whose loss has not come from the device yet."""

    def run(self, data: TrainingSet, tests: TrainingSet | None, *, quiet: bool) -> str:
        self._begin_stage()
        self._resume()
        columns = (
            TextColumn("training"),
            BarColumn(),
            TextColumn("{task.percentage:.0f} %"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[told]}"),
        )
        with Bars(*columns, quiet=quiet) as progress:
            bar = progress.add_task("", total=1.0, told="")
            while True:
                self._train_stage(
                    data, tests, lambda told: progress.update(bar, completed=self._share_of_all(), told=told)
                )
                self._take_best()
                if self.stage + 1 == len(self.stages):
                    break
                self.earlier = self.earlier.plus(self.spent)
                self.stage, self.spent = self.stage + 1, _Spent()
                self._begin_stage()
        self._save()
        told = f"{counted(self._all.step, 'step')} in {self._all.seconds / 60:.1f} minutes"
        return told if math.isinf(self.best) else f"{told}, loss of the held-out objects {self.best:.4f}"

    # -- stages ---------------------------------------------------------------------------------------

    @property
    def name(self) -> str:
        return self.stages[self.stage][0]

    @property
    def part(self) -> torch.nn.Module:
        return self.model.part(self.name)

    @property
    def _all(self) -> _Spent:
        return self.earlier.plus(self.spent)

    def _begin_stage(self) -> None:
        self.model.requires_grad_(False)
        self.part.requires_grad_(True)
        self.ema = {name: value.detach().clone() for name, value in self.part.named_parameters()}
        self.best, self.best_weights = math.inf, {}
        self.rate = self.model.rate(self.name, self.config.rate)
        self.optimizer = torch.optim.AdamW(
            self.part.parameters(),
            lr=self.rate,
            betas=(0.9, 0.99),
            weight_decay=0.01,
            fused=self.processes.device.type == "cuda",
        )

    def _train_stage(self, data: TrainingSet, tests: TrainingSet | None, told: Callable[[str], None]) -> None:
        self.model.eval()
        prepared = self.model.prepare(self.name, data)
        held_out = None if tests is None else self.model.prepare(self.name, tests)
        self.part.train()
        forward: Callable[..., torch.Tensor] = self.model
        if self.processes.count > 1:
            forward = torch.nn.parallel.DistributedDataParallel(self.model)
        if self.processes.device.type == "cuda":
            forward = torch.compile(forward, dynamic=False)  # pyright: ignore[reportAssignmentType]
        saved = time.perf_counter()
        checked, drawn = (math.floor(self._share() * n) for n in (_CHECKS, self.config.pictures))
        while not self.processes.agreed(self._share() >= 1):
            try:
                check_interrupt()
                with interrupts_held_back():
                    began = time.perf_counter()
                    loss = self._take_step(forward, prepared)
                    self.spent = self.spent.plus(_Spent(1, time.perf_counter() - began))
                    self.waiting.append(
                        (
                            {
                                "stage": self.name,
                                "step": self._all.step,
                                "seconds": round(self._all.seconds, 3),
                            },
                            loss,
                        )
                    )
                if self.folder is None:
                    continue
                if self.processes.device.type == "cpu" or len(self.waiting) >= _LOGGED:
                    told(f"{self.name}, step {self.spent.step}, loss {self._log():.4f}")
                if held_out is not None and math.floor(self._share() * _CHECKS) > checked:
                    checked = math.floor(self._share() * _CHECKS)
                    self._check(held_out)
                if time.perf_counter() - saved > _SAVE_EVERY:
                    self._save()
                    saved = time.perf_counter()
                if self.stage + 1 == len(self.stages) and (
                    math.floor(self._share() * self.config.pictures) > drawn
                ):
                    drawn += 1
                    self._draw()
            except KeyboardInterrupt:
                self._save()
                raise
        self._log()

    def _share(self) -> float:
        """How much of the stage is done, from 0 to 1."""
        part = self.stages[self.stage][1]
        if self.config.steps is not None:
            return min(1.0, self.spent.step / max(round(part * self.config.steps), 1))
        return min(1.0, self.spent.seconds / max(60 * part * self.config.minutes, 1e-9))

    def _share_of_all(self) -> float:
        shares = [share for _, share in self.stages]
        return sum(shares[: self.stage]) + shares[self.stage] * self._share()

    def _take_step(self, forward: Callable[..., torch.Tensor], prepared) -> torch.Tensor:
        # All chance is drawn anew for each step from its number, so that a resumed run sees the same.
        device = self.processes.device
        number = (self.config.seed * 1_000_003 + self._all.step) * self.processes.count + self.processes.rank
        torch.manual_seed(number)
        generator = torch.Generator(device).manual_seed(number)
        chosen = torch.randint(len(prepared), (self.model.batch_size(self.name, self.config.batch),))
        batch = self.model.draw(self.name, prepared, chosen, generator)
        share = self._share()
        rate = self.rate * min(1.0, (self.spent.step + 1) / _WARM_UP) * min(1.0, (1 - share) / _COOL_DOWN)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        with self._half():
            loss = forward(batch)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.part.parameters(), 1.0)
        self.optimizer.step()
        # Short trainings forget sooner.
        keep = min(_EMA, (self.spent.step + 1) / (self.spent.step + 10))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.ema.values()), list(self.part.parameters()), 1 - keep)
        return loss.detach()

    def _half(self):
        on_gpu = self.processes.device.type == "cuda"
        return torch.autocast("cuda", torch.bfloat16) if on_gpu else nullcontext()

    @contextmanager
    def _mean_weights(self) -> Iterator[None]:
        """The mean weights in the model's place, for a look at it."""
        kept = {name: value.detach().clone() for name, value in self.part.named_parameters()}
        self._put(self.ema)
        self.model.eval()
        try:
            yield
        finally:
            self._put(kept)
            self.part.train()

    @torch.no_grad()
    def _put(self, weights: dict[str, torch.Tensor]) -> None:
        for name, value in self.part.named_parameters():
            value.copy_(weights[name])

    @torch.no_grad()
    def _check(self, held_out) -> None:
        """Keeps the mean weights that know held-out objects best: small sets are soon known by heart."""
        size = self.model.batch_size(self.name, self.config.batch)
        found = []
        with self._mean_weights(), self._half():
            for number, chosen in enumerate(torch.arange(len(held_out)).split(size)[:_CHECKED]):
                generator = torch.Generator(self.processes.device).manual_seed(number)
                found.append(self.model(self.model.draw(self.name, held_out, chosen, generator)))
        loss = float(torch.stack(found).mean())
        if self.folder is not None:
            self._log()
            self._write_log({"stage": self.name, "step": self._all.step, "held_out": round(loss, 6)})
        if loss < self.best:
            self.best = loss
            self.best_weights = {name: value.clone() for name, value in self.ema.items()}

    def _take_best(self) -> None:
        self._put(self.best_weights or self.ema)
        self.ema = {name: value.detach().clone() for name, value in self.part.named_parameters()}
        if self.processes.count > 1:
            for value in self.part.state_dict().values():
                distributed.broadcast(value, 0)

    # -- files ----------------------------------------------------------------------------------------

    def _save(self) -> None:
        if self.folder is None:
            return
        self._log()
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"ema.{name}": value for name, value in self.ema.items()}
        tensors |= {f"best.{name}": value for name, value in self.best_weights.items()}
        for name, parameter in self.part.named_parameters():
            for key, value in self.optimizer.state.get(parameter, {}).items():
                tensors[f"adam.{key}.{name}"] = torch.as_tensor(value)
        told = {"stage": str(self.stage), "best": repr(self.best)}
        for name, spent in (("earlier", self.earlier), ("spent", self.spent)):
            told |= {f"{name}.step": str(spent.step), f"{name}.seconds": repr(spent.seconds)}
        tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
        with replacing(self.folder.path / _CHECKPOINT) as partial:
            partial.write_bytes(save(tensors, told))
        with self._mean_weights():
            half = {
                name: _halved(value.detach().cpu()).contiguous()
                for name, value in self.model.state_dict().items()
            }
        with replacing(self.folder.path / "weights.safetensors") as partial:
            partial.write_bytes(save(half))

    def _resume(self) -> None:
        path = None if self.folder is None else self.folder.path / _CHECKPOINT
        if path is not None and path.is_file():
            try:
                with safe_open(path, "pt") as file:
                    told = file.metadata()
                self._restore(load_file(path), told)
            except Exception as error:  # the readers raise whatever they stumble over
                raise UserError(
                    f"'{path}' cannot be read ({type(error).__name__}); remove it to train from the start."
                ) from error
        self._cut_log()
        if self.processes.count > 1:
            self._share_state()

    def _restore(self, tensors: dict[str, torch.Tensor], told: dict[str, str]) -> None:
        device = self.processes.device
        self.stage, best = int(told["stage"]), float(told["best"])
        self.earlier, self.spent = (
            _Spent(int(told[f"{name}.step"]), float(told[f"{name}.seconds"])) for name in ("earlier", "spent")
        )
        self._begin_stage()
        self.best = best
        self.model.load_state_dict({name: tensors[f"model.{name}"] for name in self.model.state_dict()})
        self.best_weights = {
            name: tensors[f"best.{name}"].to(device) for name in self.ema if f"best.{name}" in tensors
        }
        self.ema = {name: tensors[f"ema.{name}"].to(device) for name in self.ema}
        for name, parameter in self.part.named_parameters():
            state = {
                key: tensors[f"adam.{key}.{name}"]
                for key in ("step", "exp_avg", "exp_avg_sq")
                if f"adam.{key}.{name}" in tensors
            }
            if state:
                self.optimizer.state[parameter] = {
                    key: value.to(device) if key != "step" or device.type == "cuda" else value
                    for key, value in state.items()
                }

    def _share_state(self) -> None:
        """Gives the first process's state to the others."""
        told = [self.stage, self.earlier, self.spent, self.optimizer.state_dict()]
        distributed.broadcast_object_list(told, 0)
        if not self.processes.first:
            self.stage, self.earlier, self.spent = told[:3]
            self._begin_stage()
            self.optimizer.load_state_dict(told[3])
        for value in self.model.state_dict().values():
            distributed.broadcast(value, 0)

    def _log(self) -> float:
        """Writes the lines that wait; returns the last loss."""
        if not self.waiting:
            return math.nan
        losses = torch.stack([loss for _, loss in self.waiting]).tolist()
        for (line, _), loss in zip(self.waiting, losses, strict=True):
            self._write_log(line | {"loss": round(loss, 6)})
        self.waiting.clear()
        return losses[-1]

    def _write_log(self, line: dict) -> None:
        if self.folder is None:
            return
        with open(self.folder.path / "log.jsonl", "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def _cut_log(self) -> None:
        """Takes out the lines of steps that are taken again, and those that a kill has torn."""
        path = None if self.folder is None else self.folder.path / "log.jsonl"
        if path is None or not path.is_file():
            return
        text = path.read_text(encoding="utf-8", errors="replace")
        lines = [line for line in text.splitlines() if _step_of(line) <= self._all.step]
        with replacing(path) as partial:
            partial.write_text("".join(line + "\n" for line in lines), encoding="utf-8")

    def _draw(self) -> None:
        """A page of samples of the mean weights."""
        if self.folder is None:
            return
        kinds = [i % len(self.made.classes) for i in range(_DRAWN)]
        with self._mean_weights():
            fields = self.model.sample(
                Steering(kinds, [(i, i, 0.0) for i in range(_DRAWN)], steps=_DRAWN_STEPS)
            )
        name = f"samples/{self._all.step:07d}.png"
        self.folder.claim(name)
        (self.folder.path / "samples").mkdir(exist_ok=True)
        from .drawn import draw_fields

        in_own_process(
            draw_fields,
            self.folder.path / name,
            fields,
            [self.made.classes[k] for k in kinds],
            variant="llvm_ad_rgb",
        )


def _step_of(line: str) -> float:
    """The step that a line of the log tells of; infinite if it is damaged."""
    try:
        step = json.loads(line)["step"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return math.inf
    return step if isinstance(step, int) else math.inf


def _halved(value: torch.Tensor) -> torch.Tensor:
    return value.half() if value.is_floating_point() else value


def _take_autoencoder(model: ShapeFlow | LatentFlow | DenseDiffusion, folder: Path) -> None:
    from .models.latent_flow import LatentFlow

    other = load_model(folder, torch.device("cpu"))
    if not (
        isinstance(model, LatentFlow)
        and isinstance(other, LatentFlow)
        and other.config.shape == model.config.shape
    ):
        raise UserError(
            f"The autoencoder of '{folder}' is none for a model of this kind and size; give "
            "another --size, or leave --autoencoder out."
        )
    model.autoencoder.load_state_dict(other.autoencoder.state_dict())
