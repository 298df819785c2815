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
from gshell_mi.generation.model_config import ModelConfig
from gshell_mi.generation.models import Steering, make_model
from gshell_mi.train.__main__ import main

torch.set_num_threads(1)


def losses(output):
    return [json.loads(line)["loss"] for line in (output / "log.jsonl").read_text().splitlines()]


def same_weights(a, b) -> bool:
    first, second = (load_file(folder / "weights.safetensors") for folder in (a, b))
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("model", ["blocks", "unet"])
def test_the_loss_falls(model, tiny_set, tmp_path):
    train_tiny(tiny_set, tmp_path / "m", 60, model=model, rate=3e-3)
    found = losses(tmp_path / "m")
    assert len(found) == 60
    assert np.mean(found[-10:]) < 0.8 * np.mean(found[:10])


def test_a_seed_is_one_model_and_a_run_in_two_parts_the_same(tiny_set, tmp_path):
    train_tiny(tiny_set, tmp_path / "whole", 6)
    # The rate depends on the length of the whole, so the first part is that of a run cut off.
    script = ("import sys, pathlib\n"
              "from gshell_mi.generation import training\n"
              "step = training._Training._take_step\n"
              "def cut(self, *given):\n"
              "    if self.step == 3: raise KeyboardInterrupt\n"
              "    return step(self, *given)\n"
              "training._Training._take_step = cut\n"
              "from trained import train_tiny\n"
              "train_tiny(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), 6)\n")
    ended = subprocess.run([sys.executable, "-c", script, tiny_set, tmp_path / "parts"],
                           cwd=Path(__file__).parents[1], capture_output=True)
    assert ended.returncode != 0 and len(losses(tmp_path / "parts")) == 3
    train_tiny(tiny_set, tmp_path / "parts", 6)
    assert losses(tmp_path / "parts") == losses(tmp_path / "whole")
    assert same_weights(tmp_path / "parts", tmp_path / "whole")
    train_tiny(tiny_set, tmp_path / "other", 6, seed=1)
    assert not same_weights(tmp_path / "other", tmp_path / "whole")


def test_a_log_of_steps_after_the_checkpoint_is_cut(tiny_set, tmp_path):
    train_tiny(tiny_set, tmp_path / "m", 4)
    with open(tmp_path / "m" / "log.jsonl", "a") as file:
        file.write('{"step": 5, "loss": 0}\n')
    train_tiny(tiny_set, tmp_path / "m", 4)
    assert len(losses(tmp_path / "m")) == 4


def test_a_damaged_checkpoint_is_told(tiny_set, tmp_path):
    train_tiny(tiny_set, tmp_path / "m", 1)
    (tmp_path / "m" / "checkpoint.safetensors").write_bytes(b"nonsense")
    with pytest.raises(UserError, match=r"checkpoint.safetensors' cannot be read"):
        train_tiny(tiny_set, tmp_path / "m", 1)


def test_another_model_in_the_folder_is_left_alone(tiny_set, tmp_path):
    train_tiny(tiny_set, tmp_path / "m", 1)
    with pytest.raises(UserError, match="holds a model of another kind, size, seed or data set"):
        train_tiny(tiny_set, tmp_path / "m", 1, model="unet")


def test_tokens_stand_for_the_fields_they_were_made_of(tiny_set):
    data = DataSet.open(tiny_set)
    records, sdf, msdf, _ = data.load(held_out=False)
    model = make_model(ModelConfig("blocks", "XS", 16, tuple(data.classes), 256))
    prepared = model.prepare(sdf, msdf, [data.classes.index(record.kind) for record in records])
    whole = np.stack([sdf[0], msdf[0]]).astype(np.float32)
    # Nothing is drawn anew at strength 0, so what comes out is what the tokens keep.
    steering = Steering([0], [(0, 0, 0.0)], start=whole, strength=0.0, steps=2)
    found = model.sample(steering)[0]
    near = np.abs(whole[0]) < 0.5
    active = prepared.layout[0].numpy().reshape(2, 2, 2).repeat(8, 0).repeat(8, 1).repeat(8, 2)
    assert np.abs(found - whole)[0][near & active].mean() < 0.02


def test_noise_belongs_to_the_seed_and_turns_from_one_to_the_other():
    one = Steering([0], [(3, 3, 0.0)]).noise((50_000,), 0)
    both = Steering([0, 0, 0], [(3, 4, 0.0), (3, 4, 0.5), (3, 4, 1.0)]).noise((50_000,), 0)
    assert torch.equal(one[0], both[0])
    assert torch.allclose(both[2], Steering([0], [(4, 4, 0.0)]).noise((50_000,), 0)[0], atol=1e-6)
    assert abs(float(both[1].std()) - 1) < 0.02
    assert not torch.equal(Steering([0], [(3, 3, 0.0)]).noise((50_000,), 1)[0], one[0])


def test_known_blocks_are_held(tiny_set):
    data = DataSet.open(tiny_set)
    records, sdf, msdf, _ = data.load(held_out=False)
    model = make_model(ModelConfig("blocks", "XS", 16, tuple(data.classes), 256))
    model.prepare(sdf, msdf, [0] * len(records))
    whole = np.stack([sdf[0], msdf[0]]).astype(np.float32)
    known = np.zeros((16, 16, 16), bool)
    known[:, :, 8:] = True
    found = model.sample(Steering([0], [(0, 0, 0.0)], start=whole, known=known, steps=2))[0]
    held = known & (np.abs(whole[0]) < 0.5)
    assert np.abs(found - whole)[0][held].mean() < 0.05
    # The rest is an untrained model's noise.
    assert np.abs(found - whole)[0][~known & (np.abs(whole[0]) < 0.5)].mean() > 0.1


@pytest.mark.parametrize(("arguments", "sentence"), [
    (["{tmp}/no", "-o", "{tmp}/m"], "does not exist; check the path"),
    (["{tmp}", "-o", "{tmp}/m"], "is no data set; make one with"),
    (["{tmp}"], "Nothing says where the model goes"),
    (["{tmp}", "-o", "{tmp}/m", "--model", "gan"], "--model 'gan' is not known; choose one of blocks, unet"),
    (["{tmp}", "-o", "{tmp}/m", "--size", "XXL"], "--size 'XXL' is not known"),
    (["{tmp}", "-o", "{tmp}/m", "--minutes", "0"], "--minutes must be more than 0"),
    (["{tmp}", "-o", "{tmp}/m", "--batch", "-1"], "--batch must be more than 0"),
])
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
    command = [sys.executable, "-m", "gshell_mi.train", str(tiny_set), "-o", str(tmp_path / "m"),
               "--size", "XS", "--steps", "100000", "--batch",
               "2", "--pictures", "0", "--device", "cpu", "--quiet"]
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
