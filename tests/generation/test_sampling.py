"""Sampling and scoring by their commands, with a model that knows next to nothing."""

import json

import numpy as np
import pytest
import trimesh

pytest.importorskip("torch")
pytest.importorskip("monai")

from gshell_mi.generate.__main__ import main
from gshell_mi.generate.evaluate import main as evaluate
from gshell_mi.generation.request import _sample
from gshell_mi.generation.sampled import near_points
from gshell_mi.topology import topology


@pytest.fixture
def here(monkeypatch):
    """Samples in this process: another takes seconds to import torch."""
    monkeypatch.setattr("gshell_mi.generation.sampled.sampled_fields", _sample)


@pytest.fixture(scope="module")
def samples(tiny_model, tmp_path_factory, variant):
    output = tmp_path_factory.mktemp("samples") / "out"
    assert (
        main(
            [
                str(tiny_model),
                "-o",
                str(output),
                "-n",
                "4",
                "--steps",
                "3",
                "--device",
                "cpu",
                "--quiet",
                "--variant",
                variant,
            ]
        )
        == 0
    )
    return output


def test_samples_are_manifold_meshes_with_their_counts(samples):
    told = json.loads((samples / "samples.json").read_text())["samples"]
    assert [row["class"] for row in told] == ["bowl", "box", "bowl", "box"]
    assert any(row["faces"] for row in told)
    for row in told:
        if row["faces"]:
            mesh = trimesh.load(samples / row["file"], process=False)
            found = topology(np.asarray(mesh.vertices), np.asarray(mesh.faces))
            assert found.nonmanifold_edges == 0
            assert (found.boundary_loops, found.components) == (row["loops"], row["components"])
    assert (samples / "sheet.png").is_file()


def test_a_seed_gives_the_same_sample_whatever_else_is_asked(samples, tiny_model, tmp_path, variant, here):
    assert (
        main(
            [
                str(tiny_model),
                "-o",
                str(tmp_path / "out"),
                "-n",
                "1",
                "--seed",
                "2",
                "--class",
                "bowl",
                "--steps",
                "3",
                "--device",
                "cpu",
                "--format",
                "glb",
                "--quiet",
                "--variant",
                variant,
            ]
        )
        == 0
    )
    first, again = (np.load(folder / "fields.npz")["fields"] for folder in (samples, tmp_path / "out"))
    assert np.allclose(first[2].astype(float), again[0].astype(float), atol=0.02)
    told = json.loads((tmp_path / "out" / "samples.json").read_text())["samples"][0]
    assert told["file"].endswith(".glb")
    if told["faces"]:
        assert len(trimesh.load(tmp_path / "out" / told["file"], force="mesh").faces) == told["faces"]


def test_an_interpolation_is_a_film(tiny_model, tmp_path, variant, here):
    assert (
        main(
            [
                str(tiny_model),
                "-o",
                str(tmp_path / "out"),
                "-n",
                "3",
                "--interpolate",
                "1",
                "2",
                "--steps",
                "2",
                "--device",
                "cpu",
                "--quiet",
                "--variant",
                variant,
            ]
        )
        == 0
    )
    assert (tmp_path / "out" / "interpolation.mp4").stat().st_size > 500


def test_near_a_mesh_at_strength_0_is_that_mesh_in_its_place(tiny_model, tmp_path, variant, here):
    ball = trimesh.creation.icosphere(subdivisions=3)
    bowl = trimesh.Trimesh(3 * ball.vertices + [5, 0, 0], ball.faces[ball.triangles_center[:, 2] < 0.5])
    bowl.export(tmp_path / "bowl.ply")
    assert (
        main(
            [
                str(tiny_model),
                "-o",
                str(tmp_path / "out"),
                "-n",
                "1",
                "--near",
                str(tmp_path / "bowl.ply"),
                "--strength",
                "0",
                "--steps",
                "2",
                "--device",
                "cpu",
                "--quiet",
                "--variant",
                variant,
            ]
        )
        == 0
    )
    found = trimesh.load(tmp_path / "out" / "meshes" / "0000.ply", process=False)
    assert np.abs(np.linalg.norm(found.vertices - [5, 0, 0], axis=1) - 3).mean() < 0.1


def test_what_is_near_a_seen_point_is_held_and_what_is_near_an_unseen_one_is_not():
    points = np.array([[-0.5, 0, 0, 1], [0.5, 0, 0, 0]])
    held = near_points(points, 17, 2.0)
    assert held[8, 8, 4] and not held[8, 8, 12]
    assert not held[0, 0, 16]  # nothing of the surface is there, so something may come


def test_samples_are_scored_against_the_held_out_part(samples, tiny_set, tmp_path, capsys):
    assert (
        evaluate(
            [
                str(samples),
                str(tiny_set),
                "--points",
                "64",
                "--emd",
                "2",
                "--json",
                str(tmp_path / "scores.json"),
                "--quiet",
            ]
        )
        == 0
    )
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert 0 <= scores["coverage"] <= 1 and 0 <= scores["nearest_neighbour_accuracy"] <= 1
    assert scores["mmd"] > 0 and scores["samples"] == scores["true"] > 0
    assert "nearest_neighbour_accuracy" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["{tmp}/no"], "does not exist; check the path"),
        (["{tmp}"], "holds no model; train one with"),
        (
            ["{model}", "--class", "sock"],
            "class 'sock' is none that the model knows; choose one of bowl, box",
        ),
        (["{model}", "-n", "0"], "--count must be more than 0"),
        (["{model}", "--format", "stl"], "--format 'stl' is not known"),
        (["{model}", "--strength", "2"], "--strength must be from 0 to 1"),
        (["{model}", "--near", "{tmp}", "--complete", "{tmp}"], "exclude each other"),
        (["{model}", "--seed", "-1"], "Seeds must not be negative"),
    ],
)
def test_mistakes_are_told(arguments, sentence, tiny_model, tmp_path, capsys, variant):
    given = [
        argument.replace("{tmp}", str(tmp_path)).replace("{model}", str(tiny_model)) for argument in arguments
    ]
    assert main([*given, "-o", str(tmp_path / "out"), "--variant", variant]) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_weights_of_another_model_are_told(tiny_model, tmp_path, capsys, variant, here):
    card = json.loads((tiny_model / "model.json").read_text())
    card["config"]["size"] = "S"
    (tmp_path / "m").mkdir()
    (tmp_path / "m" / "model.json").write_text(json.dumps(card))
    (tmp_path / "m" / "weights.safetensors").write_bytes((tiny_model / "weights.safetensors").read_bytes())
    assert main([str(tmp_path / "m"), "-o", str(tmp_path / "out"), "--quiet", "--variant", variant]) == 2
    assert "does not hold the weights of the model that model.json describes" in capsys.readouterr().err


def test_scores_of_what_are_no_samples_are_told(tiny_set, tmp_path, capsys):
    assert evaluate([str(tmp_path), str(tiny_set)]) == 2
    assert "holds no samples; make some with" in capsys.readouterr().err


def test_a_foreign_file_is_told_before_anything_is_sampled(
    tiny_model, tmp_path, variant, monkeypatch, capsys
):
    monkeypatch.setattr("gshell_mi.generation.sampled.sampled_fields", None)
    (tmp_path / "sheet.png").write_text("mine")
    assert main([str(tiny_model), "-o", str(tmp_path), "--quiet", "--variant", variant]) == 2
    assert "sheet.png' is in the way" in capsys.readouterr().err
