"""Fits whose geometry is not the lattice's values themselves."""

import json

import numpy as np
import pytest
import trimesh
from bowl import SHORT, write_fit_scene
from topology import assert_manifold, loop_count

from gshell_mi import TetLattice
from gshell_mi.extras import network
from gshell_mi.extras.hashgrid import HashGridNetwork
from gshell_mi.fields import LatticeFields
from gshell_mi.fit.__main__ import main
from gshell_mi.fit.joint.joint import JointStage

RESOLUTION = 12
FITTING_STEPS = 250


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """The bowl, given as fields that are right but for a radius that is too large."""
    folder = tmp_path_factory.mktemp("field")
    path = write_fit_scene(folder)
    points = TetLattice(RESOLUTION).vertex_positions()
    sdf = np.linalg.norm(points, axis=1) - 0.65
    fields = LatticeFields(sdf, (0.02 - points[:, 1]).astype(np.float32), np.zeros(3 * len(sdf), np.float32))
    fields.save(folder / "start.npz")
    xml = path.read_text()
    shape = xml[xml.index("<shape") : xml.index("</shape>")]
    path.write_text(
        xml.replace(shape, '<shape type="gshell" id="subject"><string name="filename" value="start.npz"/>')
    )
    return path


@pytest.fixture(autouse=True)
def short_fits(monkeypatch):
    monkeypatch.setattr(HashGridNetwork, "fitting_steps", FITTING_STEPS)
    monkeypatch.setattr(network, "_BATCH", 1024)
    monkeypatch.setattr(network, "_PADDING", 1024)


def fit(scene, output, field, *arguments):
    return main(
        [
            str(scene),
            "-o",
            str(output),
            "--quiet",
            *SHORT,
            "--joint.warmup",
            "0",
            "--model.field",
            field,
            *arguments,
        ]
    )


def log(output):
    if not (output / "log.jsonl").exists():
        return []
    return [json.loads(line) for line in (output / "log.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("field", ["multiresolution", "hashgrid"])
def test_the_bowl_stays_a_bowl(field, scene, tmp_path):
    output = tmp_path / "out"
    assert fit(scene, output, field) == 0
    found = trimesh.load(output / "mesh.ply", process=False)
    assert_manifold(found.vertices, found.faces)
    assert loop_count(found.faces) == 1
    assert [step["stage"] for step in log(output)] == ["joint"] * 12


def test_a_network_goes_on_as_if_nothing_had_been(scene, tmp_path, monkeypatch):
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    assert fit(scene, whole, "hashgrid", "--checkpoint-seconds", "0") == 0

    def stop_at(last, kind, name):
        step = getattr(kind, name)

        def call(self, iteration, *rest):
            if iteration == last:
                raise KeyboardInterrupt
            return step(self, iteration, *rest)

        with monkeypatch.context() as patch:
            patch.setattr(kind, name, call)
            resume = ["--resume"] if (stopped / "checkpoint.npz").exists() else []
            assert fit(scene, stopped, "hashgrid", "--checkpoint-seconds", "0", *resume) == 130

    # Once in its fit to the start, which is done anew, and once after that.
    stop_at(20, HashGridNetwork, "fit_step")
    assert not log(stopped)
    stop_at(5, JointStage, "step")
    assert fit(scene, stopped, "hashgrid", "--checkpoint-seconds", "0", "--resume") == 0
    assert [(step["stage"], step["iteration"]) for step in log(stopped)] == [
        (step["stage"], step["iteration"]) for step in log(whole)
    ]
    meshes = [trimesh.load(folder / "mesh.ply", process=False) for folder in (whole, stopped)]
    assert abs(len(meshes[0].vertices) - len(meshes[1].vertices)) < 20
    # Equal runs differ by 0.3 %, as additions have no fixed order; without the optimiser's state it is 1 %.
    assert meshes[0].area == pytest.approx(meshes[1].area, rel=6e-3)


def test_an_unknown_field_is_refused(scene, tmp_path, capfd):
    assert fit(scene, tmp_path / "out", "wavelets") == 2
    assert "field 'wavelets' is not available; choose one of explicit, flexicubes," in capfd.readouterr().err
