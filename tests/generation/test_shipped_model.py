"""The model of garments that comes with the package."""

import json

import numpy as np
import pytest
import trimesh

pytest.importorskip("torch")

from gshell_mi.generate.__main__ import main
from gshell_mi.generation.model_config import SHIPPED
from gshell_mi.generation.request import _sample
from gshell_mi.topology import topology

LOOPS = {"cape": {1, 2}, "dress": {2, 3, 4}, "hat": {1}, "skirt": {2}, "top": {2, 3, 4}, "trousers": {3}}


def test_it_is_small_and_says_what_it_is():
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 12e6
    card = (SHIPPED / "README.md").read_text()
    told = json.loads((SHIPPED / "model.json").read_text())
    assert f"seed {told['seed']}" in card and f"{told['objects']:,}" in card
    assert all(word in card for word in ("1-NNA", "coverage", "loops", "licence"))


def test_it_is_taken_where_none_is_named_and_draws_garments(tmp_path, monkeypatch, variant):
    monkeypatch.setattr("gshell_mi.generation.sampled.sampled_fields", _sample)
    monkeypatch.chdir(tmp_path)
    assert main(["-n", "12", "--device", "cpu", "--quiet", "--variant", variant]) == 0
    told = json.loads((tmp_path / "generated" / "samples.json").read_text())
    assert told["seconds_per_sample"] < 10  # tenths of one, where nobody else computes
    rows = told["samples"]
    assert [row["class"] for row in rows[:6]] == list(LOOPS)
    assert sum(row["loops"] in LOOPS[row["class"]] for row in rows) >= 9
    for row in rows:
        mesh = trimesh.load(tmp_path / "generated" / row["file"], process=False)
        assert topology(np.asarray(mesh.vertices), np.asarray(mesh.faces)).nonmanifold_edges == 0
        assert np.ptp(mesh.vertices, axis=0).max() > 1  # it fills the cube
