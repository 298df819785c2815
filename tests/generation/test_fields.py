"""Truncated fields and their encodings."""

import numpy as np
import pytest
import trimesh

from gshell_mi.errors import UserError
from gshell_mi.generation.converted import converted, round_trip
from gshell_mi.generation.encodings import BLOCK_VALUES, ENCODINGS, BlockEncoding
from gshell_mi.generation.fields import TRUNCATION_CELLS, TruncatedFields, lattice_edges, normalised
from gshell_mi.generation.sources import Source
from gshell_mi.topology import topology

SIDE = 32


def bowl() -> trimesh.Trimesh:
    """The lower part of a sphere of radius 1, below z = 0.3."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    return trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] < 0.3])


@pytest.fixture(scope="module")
def mesh() -> trimesh.Trimesh:
    return normalised(bowl(), SIDE)[0]


@pytest.fixture(scope="module")
def fields(mesh) -> TruncatedFields:
    return TruncatedFields.of_mesh(mesh, SIDE)


def counts(mesh: trimesh.Trimesh) -> tuple[int, int, int]:
    found = topology(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return found.components, found.boundary_loops, found.nonmanifold_edges


def test_normalised_meshes_are_centred_and_come_back(mesh):
    moved = trimesh.Trimesh(5 * bowl().vertices + [3, 0, -1], bowl().faces, process=False)
    found, back = normalised(moved, SIDE)
    assert np.allclose(found.bounds.mean(axis=0), 0, atol=1e-9)
    assert np.allclose(found.vertices, mesh.vertices)  # place and size are gone
    assert np.allclose(found.vertices @ back[:3, :3].T + back[:3, 3], moved.vertices)


def test_fields_are_truncated_and_stand_for_the_mesh(mesh, fields):
    assert fields.side == SIDE and fields.sdf.shape == (SIDE,) * 3
    assert np.abs(fields.sdf).max() == 1 and np.abs(fields.msdf).max() <= 1
    again = fields.surface()
    assert counts(again) == (1, 1, 0)
    assert round_trip(again, mesh) < 0.3


def test_no_field_leaps_where_the_template_is_not_even_at_its_caps(fields):
    for _, a, b in lattice_edges(SIDE):
        s, other = fields.sdf.ravel()[a], fields.sdf.ravel()[b]
        # The longest edge has sqrt(3) cells, and from_mesh may move a layer by half of one.
        assert np.abs(s - other).max() < 2.7 / TRUNCATION_CELLS
    inside = fields.sdf < 0
    assert (fields.msdf[inside] > 0.3).any() and (fields.msdf[inside] < -0.3).any()  # sheet and cap


def test_a_closed_mesh_stays_closed():
    ball, _ = normalised(trimesh.creation.icosphere(), SIDE)
    fields = TruncatedFields.of_mesh(ball, SIDE)
    assert (fields.msdf[np.abs(fields.sdf) < 0.5] > 0).all()
    assert fields.surface().is_watertight


@pytest.mark.parametrize("name", ENCODINGS)
def test_encodings_come_back_to_the_same_surface(name, mesh, fields):
    code = ENCODINGS[name].encode(fields)
    again = ENCODINGS[name].decode(code, SIDE).surface()
    assert counts(again) == (1, 1, 0)
    assert round_trip(again, mesh) < 0.3


def test_blocks_keep_the_very_surface_and_only_what_is_near_it(fields):
    code = BlockEncoding().encode(fields)
    assert code["values"].shape == (len(code["blocks"]), BLOCK_VALUES)
    assert len(code["blocks"]) < (SIDE // 8) ** 3
    again, direct = BlockEncoding().decode(code, SIDE).surface(), fields.surface()
    assert len(again.faces) == len(direct.faces) and np.allclose(again.vertices, direct.vertices)


def test_the_cubic_layout_holds_signs_and_coefficients_only(fields):
    values = ENCODINGS["cubic"].encode(fields)["values"]
    assert values.shape == (2, 2 * SIDE, 2 * SIDE, 2 * SIDE)
    assert set(np.unique(values[0, ::2, ::2, ::2])) == {-1.0, 1.0}
    assert np.abs(values).max() <= 1
    # A scale of the distances is no part of it.
    doubled = TruncatedFields(fields.sdf / 2, fields.msdf)
    assert np.allclose(ENCODINGS["cubic"].encode(doubled)["values"][0], values[0], atol=1e-5)


def test_blocks_need_a_side_of_eights():
    fields = TruncatedFields(np.ones((12,) * 3, np.float32), np.ones((12,) * 3, np.float32))
    with pytest.raises(UserError, match="do not fill a grid of 12"):
        BlockEncoding().encode(fields)


def test_specks_are_taken_away_and_nothing_else(fields):
    assert counts(fields.without_specks().surface()) == counts(fields.surface()) == (1, 1, 0)
    sdf, msdf = fields.sdf.copy(), fields.msdf.copy()
    on_sheet = np.argwhere((np.abs(sdf) < 0.1) & (msdf > 0.5))[0]
    msdf[tuple(on_sheet)] = -1  # a pin-hole
    sdf[2, 2, 2] = -0.5  # a crumb
    spoilt = TruncatedFields(sdf, msdf)
    assert counts(spoilt.surface()) != (1, 1, 0)
    assert counts(spoilt.without_specks().surface()) == (1, 1, 0)


def test_round_trip_measures_an_offset(mesh):
    ball = trimesh.creation.icosphere(subdivisions=4)
    larger = trimesh.Trimesh(1.01 * ball.vertices, ball.faces, process=False)
    assert round_trip(larger, ball) == pytest.approx(100 * 0.01 / np.sqrt(12), rel=0.1)


def test_objects_that_the_fields_miss_are_refused(tmp_path):
    path = tmp_path / "bowl.ply"
    bowl().export(path)
    row = converted(Source("bowl", "object", str(path)), SIDE, most=0.5)
    assert row.loops == 1 and row.loops_kept and row.chamfer < 0.5
    assert np.abs(row.points).max() <= 1
    with pytest.raises(UserError, match=r"% of its size away from it, more than 0.0001 %"):
        converted(Source("bowl", "object", str(path)), SIDE, most=0.0001)
