"""Garments by number: what their classes promise."""

import numpy as np
import pytest

from gshell_mi.errors import UserError
from gshell_mi.generation.garments import CLASSES, draw, garment
from gshell_mi.generation.garments.kinds import KINDS
from gshell_mi.topology import topology


@pytest.mark.parametrize("kind", CLASSES)
def test_garments_are_open_manifolds_with_the_loops_of_their_class(kind):
    drawn = garment(kind, 1)
    found = topology(drawn.mesh.vertices, drawn.mesh.faces)
    assert (found.components, found.boundary_loops, found.pinholes) == (1, drawn.loops, 0)
    assert found.nonmanifold_edges == 0 and drawn.mesh.is_winding_consistent
    assert found.boundary_loops == KINDS[kind].loops(drawn.parameters)
    assert np.abs(drawn.mesh.vertices).max() < 1.5


def test_a_seed_is_one_garment_and_another_seed_another():
    first, again, other = garment("hat", 5), garment("hat", 5), garment("hat", 6)
    assert np.array_equal(first.mesh.vertices, again.mesh.vertices)
    assert first.parameters != other.parameters


def test_trousers_have_a_waist_and_two_cuffs_and_hats_one_brim():
    assert garment("trousers", 2).loops == 3
    assert garment("hat", 2).loops == 1
    # The waist is above the cuffs: the loops lie at two heights.
    mesh = garment("trousers", 2).mesh
    outline = mesh.outline()
    heights = sorted(np.mean(outline.vertices[entity.points][:, 1]) for entity in outline.entities)
    assert len(heights) == 3 and heights[2] - heights[1] > 2 * (heights[1] - heights[0])


def test_torsos_lose_loops_as_their_style_says():
    draw = KINDS["top"].draw
    styles = [draw(np.random.default_rng(seed)) for seed in range(200)]
    loops = {KINDS["top"].loops(style) for style in styles}
    assert loops == {2, 3, 4}
    assert all(KINDS["top"].loops(style) == 2 for style in styles if style["strapless"])


def test_a_garment_that_never_comes_out_right_is_told(monkeypatch):
    monkeypatch.setattr(draw, "_sewn", lambda *_: None)
    with pytest.raises(
        UserError, match="no hat of seed 3 came out right in 20 attempts; choose another seed"
    ):
        garment("hat", 3)


def test_an_unknown_class_is_told():
    with pytest.raises(UserError, match="class 'sock' is none of those of garments; choose one of skirt"):
        garment("sock", 0)
