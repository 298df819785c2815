"""Training: it learns, it is seeded, and a kill costs nothing but time."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("monai")

import torch
from safetensors.torch import load_file
from trained import train_tiny

from gshell_mi.errors import UserError
from gshell_mi.generation.data_set import DataSet
from gshell_mi.generation.fields import TRUNCATION_CELLS
from gshell_mi.generation.model_config import ModelConfig
from gshell_mi.generation.models import Steering, make_model
from gshell_mi.generation.models.autoencoder import seen
from gshell_mi.generation.models.shape_flow import leading_eigenvectors
from gshell_mi.generation.models.training_set import TrainingSet
from gshell_mi.train.__main__ import main

torch.set_num_threads(1)


def losses(output, stage=None):
    lines = [json.loads(line) for line in (output / "log.jsonl").read_text().splitlines()]
    return [line["loss"] for line in lines if "loss" in line and stage in (None, line["stage"])]


def same_weights(a, b) -> bool:
    first, second = (load_file(folder / "weights.safetensors") for folder in (a, b))
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize(
    ("model", "stages"),
    [("shape", {"flow": 300}), ("latent", {"autoencoder": 48, "flow": 32}), ("unet", {"unet": 80})],
)
def test_the_loss_falls(model, stages, tiny_set, tmp_path):
    train_tiny(tiny_set, tmp_path / "m", sum(stages.values()), model=model, rate=3e-3)
    for stage, steps in stages.items():
        found = losses(tmp_path / "m", stage)
        assert len(found) == steps
        assert np.mean(found[-10:]) < 0.8 * np.mean(found[:5])


def test_a_seed_is_one_model_and_a_run_in_two_parts_the_same(tiny_set, tmp_path):
    train_tiny(tiny_set, tmp_path / "whole", 6)
    # The rate depends on the length of the whole, so the first part is that of a run cut off.
    script = (
        "import sys, pathlib, torch\n"
        "torch.set_num_threads(1)\n"  # as here: sums of other threads are rounded otherwise
        "from gshell_mi.generation import training\n"
        "step = training._Training._take_step\n"
        "def cut(self, *given):\n"
        "    if self._all.step == 3: raise KeyboardInterrupt\n"
        "    return step(self, *given)\n"
        "training._Training._take_step = cut\n"
        "from trained import train_tiny\n"
        "train_tiny(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), 6)\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script, tiny_set, tmp_path / "parts"],
        cwd=Path(__file__).parents[1],
        capture_output=True,
    )
    assert ended.returncode != 0 and len(losses(tmp_path / "parts")) == 3
    train_tiny(tiny_set, tmp_path / "parts", 6)
    assert losses(tmp_path / "parts") == losses(tmp_path / "whole")
    assert same_weights(tmp_path / "parts", tmp_path / "whole")
    train_tiny(tiny_set, tmp_path / "other", 6, seed=1)
    assert not same_weights(tmp_path / "other", tmp_path / "whole")


def test_a_log_of_steps_after_the_checkpoint_and_what_is_torn_is_cut(tiny_set, tmp_path):
    train_tiny(tiny_set, tmp_path / "m", 4)
    with open(tmp_path / "m" / "log.jsonl", "a") as file:
        file.write('{"step": 5, "loss": 0}\n3\n{"step": "2"}\n{"loss": 0}\n{"step": 2, "lo')  # torn by a kill
    train_tiny(tiny_set, tmp_path / "m", 4)
    assert len(losses(tmp_path / "m")) == 4
    (tmp_path / "m" / "checkpoint.safetensors").unlink()
    train_tiny(tiny_set, tmp_path / "m", 4)
    assert len(losses(tmp_path / "m")) == 4  # from the start


def test_a_damaged_checkpoint_is_told(tiny_set, tmp_path):
    train_tiny(tiny_set, tmp_path / "m", 1)
    (tmp_path / "m" / "checkpoint.safetensors").write_bytes(b"nonsense")
    with pytest.raises(UserError, match=r"checkpoint.safetensors' cannot be read"):
        train_tiny(tiny_set, tmp_path / "m", 1)


def test_an_autoencoder_is_taken_from_another_model(tiny_set, tmp_path):
    train_tiny(tiny_set, tmp_path / "m", 5, model="latent")
    train_tiny(tiny_set, tmp_path / "n", 5, model="latent", autoencoder=tmp_path / "m", seed=1)
    first, second = (load_file(tmp_path / name / "weights.safetensors") for name in "mn")
    assert all(torch.equal(first[name], second[name]) for name in first if name.startswith("autoencoder."))
    assert len(losses(tmp_path / "n", "flow")) == 5 and not losses(tmp_path / "n", "autoencoder")
    with pytest.raises(UserError, match="is none for a model of this kind and size"):
        train_tiny(tiny_set, tmp_path / "o", 5, model="shape", autoencoder=tmp_path / "m")


def test_another_model_in_the_folder_is_left_alone(tiny_set, tmp_path):
    train_tiny(tiny_set, tmp_path / "m", 1)
    with pytest.raises(UserError, match="holds a model of another kind, size, seed or data set"):
        train_tiny(tiny_set, tmp_path / "m", 1, model="unet")


def untrained(data, model):
    torch.manual_seed(0)
    return make_model(ModelConfig(model, "XS", data.side, tuple(data.classes))).eval()


@pytest.mark.parametrize("model", ["shape", "latent"])
def test_nothing_is_drawn_anew_at_strength_0(model, tiny_set):
    data = DataSet.open(tiny_set)
    _, sdf, msdf, _ = data.load(held_out=False)
    whole = np.stack([sdf[0], msdf[0]]).astype(np.float32)
    # What the model cannot tell is given back, so that not even a trained one is needed.
    found = untrained(data, model).sample(Steering([0], [(0, 0, 0.0)], start=whole, strength=0.0, steps=2))[0]
    assert np.abs(found - whole).max() < 1e-5


def test_points_stand_for_the_shapes_they_were_made_of(tiny_set):
    data = DataSet.open(tiny_set)
    _, sdf, msdf, _ = data.load(held_out=False)
    fields = TrainingSet(sdf, msdf, [0] * len(sdf), mirror=False, device=torch.device("cpu"))
    model = untrained(data, "shape")
    points = model.prepare("flow", fields)
    assert np.allclose(points.values[:, : len(sdf) - 1].square().mean(dim=0), 1, atol=0.05)
    whole = fields.fields(torch.arange(len(sdf)), torch.device("cpu"))
    sheet = (whole[:, 0].abs() < 0.5) & (whole[:, 1] > 0)
    found = model._fields(points.values)
    assert (found - whole).abs().movedim(1, -1)[sheet].max() < 0.03  # components are rounded
    # Another set has the same components.
    assert torch.equal(model.prepare("flow", fields).values, points.values)


def test_a_part_of_a_shape_tells_the_rest_where_shapes_have_one_parameter(tiny_set):
    sides = np.linspace(0.3, 0.7, 9)
    at = np.linspace(-1, 1, 16)
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    sdf = np.stack([np.clip(np.sqrt(x * x + y * y + z * z) - r, -1, 1) for r in sides]).astype(np.float16)
    fields = TrainingSet(sdf, np.ones_like(sdf), [0] * 9, mirror=False, device=torch.device("cpu"))
    model = untrained(DataSet.open(tiny_set), "shape")
    model.prepare("flow", fields)
    known = np.zeros((16, 16, 16), bool)
    known[:, :, 10:] = True
    start = np.stack([sdf[4], np.ones_like(sdf[4])]).astype(np.float32)
    found = model.sample(Steering([0], [(5, 5, 0.0)], start=start, known=known, steps=4))[0]
    assert np.abs(found - start)[0].max() < 0.05
    free = model.sample(Steering([0], [(5, 5, 0.0)], steps=4))[0]
    assert np.abs(free - start)[0].max() > 0.1


def test_tokens_are_cubes_of_latents(tiny_set):
    model = untrained(DataSet.open(tiny_set), "latent")
    latents = torch.randn(2, model.channels, 2, 2, 2)
    tokens = model._tokens(latents)
    assert tokens.shape == (2, 1, 8 * model.channels)
    assert torch.equal(model._latents(tokens), latents)


def test_the_second_half_of_a_mirrored_set_is_the_first_with_left_and_right_exchanged():
    rng = np.random.default_rng(0)
    sdf, msdf = rng.normal(size=(2, 3, 4, 4, 4)).astype(np.float16)
    device = torch.device("cpu")
    found = TrainingSet(sdf, msdf, [0, 1, 1], mirror=True, device=device)
    assert len(found) == 6 and found.kinds.tolist() == [0, 1, 1, 0, 1, 1]
    both = found.fields(torch.tensor([2, 5]), device)
    assert np.array_equal(both[0, 0], sdf[2]) and np.array_equal(both[1, 1], msdf[2][:, :, ::-1])
    assert len(TrainingSet(sdf, msdf, [0, 1, 1], mirror=False, device=device)) == 3


def test_what_has_no_part_in_the_surface_is_not_seen():
    cells = torch.tensor([-0.5, 0.5, 0.5, 2.3, 4.0])  # to the template
    rims = torch.tensor([1.0, 1.0, -3.0, 1.0, 1.0])  # to the rims; the third is a cap
    fields = torch.stack([cells, rims])[None, :, :, None, None].expand(1, 2, 5, 5, 5) / TRUNCATION_CELLS
    values, band, margin, weight = (part[0, :, :, 0, 0] for part in seen(fields))
    assert torch.allclose(values[0], torch.tensor([-0.2, 0.2, 1.0, 0.92, 1.0]))
    assert band[0].tolist() == [True, True, False, True, False]
    assert margin[0, 2] < 1 and weight[0, 2] < 1 and weight[0, 0] == 1
    assert weight[1].tolist() == [1, 1, 1, 0, 0]  # far from the template the mSDF says nothing


def test_noise_belongs_to_the_seed_and_turns_from_one_to_the_other():
    one = Steering([0], [(3, 3, 0.0)]).noise((50_000,))
    both = Steering([0, 0, 0], [(3, 4, 0.0), (3, 4, 0.5), (3, 4, 1.0)]).noise((50_000,))
    assert torch.equal(one[0], both[0])
    assert torch.allclose(both[2], Steering([0], [(4, 4, 0.0)]).noise((50_000,))[0], atol=1e-6)
    assert abs(float(both[1].std()) - 1) < 0.02


@pytest.mark.parametrize("model", ["shape", "latent"])
def test_what_is_known_is_held(model, tiny_set):
    data = DataSet.open(tiny_set)
    _, sdf, msdf, _ = data.load(held_out=False)
    whole = np.stack([sdf[0], msdf[0]]).astype(np.float32)
    known = np.zeros((16, 16, 16), bool)
    known[:, :, 8:] = True
    found = untrained(data, model).sample(Steering([0], [(0, 0, 0.0)], start=whole, known=known, steps=2))[0]
    assert np.abs(found - whole)[..., 10:].max() < 1e-5
    # The rest is an untrained model's noise.
    assert np.abs(found - whole)[0][~known & (np.abs(whole[0]) < 0.5)].mean() > 0.1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["{tmp}/no", "-o", "{tmp}/m"], "does not exist; check the path"),
        (["{tmp}", "-o", "{tmp}/m"], "is no data set; make one with"),
        (["{tmp}"], "Nothing says where the model goes"),
        (["{tmp}", "-o", "{tmp}/m", "--model", "gan"], "--model 'gan' is not known; choose one of shape,"),
        (["{tmp}", "-o", "{tmp}/m", "--size", "XXL"], "--size 'XXL' is not known"),
        (["{tmp}", "-o", "{tmp}/m", "--minutes", "0"], "--minutes must be more than 0"),
        (["{tmp}", "-o", "{tmp}/m", "--batch", "-1"], "--batch must be more than 0"),
    ],
)
def test_mistakes_are_told(arguments, sentence, tmp_path, capsys):
    assert main([argument.replace("{tmp}", str(tmp_path)) for argument in arguments]) == 2
    assert sentence in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_a_missing_gpu_is_told(tiny_set, tmp_path, capsys):
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    assert main([str(tiny_set), "-o", str(tmp_path / "m"), "--device", "cuda"]) == 2
    assert "PyTorch finds no GPU; use --device cpu" in capsys.readouterr().err


@pytest.mark.slow
def test_a_killed_training_goes_on(tiny_set, tmp_path):
    command = [
        sys.executable,
        "-m",
        "gshell_mi.train",
        str(tiny_set),
        "-o",
        str(tmp_path / "m"),
        "--size",
        "XS",
        "--steps",
        "100000",
        "--batch",
        "2",
        "--pictures",
        "0",
        "--device",
        "cpu",
        "--quiet",
    ]
    process = subprocess.Popen(command)
    log = tmp_path / "m" / "log.jsonl"
    while not log.exists():
        assert process.poll() is None
        time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    assert process.wait() == 130
    before = len(losses(tmp_path / "m"))
    saved = load_file(tmp_path / "m" / "checkpoint.safetensors")
    assert before > 0 and any(name.startswith("adam.exp_avg.") for name in saved)


def test_leading_eigenvectors_of_a_large_matrix_are_those_of_all():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(200, 60)) * np.geomspace(1, 0.05, 60)
    matrix = rows @ rows.T
    found = leading_eigenvectors(matrix, 12)
    every = np.linalg.eigh(matrix)[1][:, ::-1][:, :12]
    assert np.allclose(np.abs((found * every).sum(axis=0)), 1, atol=1e-9)
    assert np.array_equal(found, leading_eigenvectors(matrix, 12))
