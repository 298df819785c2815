"""A tiny data set and a model trained on it for a few steps, shared by the tests."""

import pytest
import trimesh
from trained import train_tiny

from gshell_mi.generation.making import make_data_set


@pytest.fixture(scope="session")
def tiny_set(tmp_path_factory):
    """Ten open bowls and ten closed boxes, on 16^3 vertices."""
    place = tmp_path_factory.mktemp("tiny")
    for kind in ("bowl", "box"):
        (place / "in" / kind).mkdir(parents=True)
    for index in range(10):
        ball = trimesh.creation.icosphere(subdivisions=3)
        cut = ball.faces[ball.triangles_center[:, 2] < 0.4 + 0.03 * index]
        trimesh.Trimesh(ball.vertices, cut).export(place / "in" / "bowl" / f"{index}.ply")
        trimesh.creation.box([1, 1, 1 + 0.05 * index]).export(place / "in" / "box" / f"{index}.ply")
    make_data_set(place / "set", [place / "in"], side=16, held_out=0.3, most=5.0)
    return place / "set"


@pytest.fixture(scope="session")
def tiny_model(tiny_set, tmp_path_factory):
    """A transformer of the smallest size after a few steps: it knows next to nothing."""
    output = tmp_path_factory.mktemp("model") / "model"
    train_tiny(tiny_set, output, 20)
    return output
