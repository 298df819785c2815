"""Data sets: what is in them, what is refused, and what a kill costs."""

import json
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest
import trimesh

from gshell_mi.dataset.__main__ import main
from gshell_mi.errors import UserError
from gshell_mi.generation import data_set, making
from gshell_mi.generation.data_set import DataSet
from gshell_mi.generation.making import make_data_set
from gshell_mi.generation.sources import garment_sources, mesh_sources

SIDE = 16


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """Two classes of meshes, with one that has no faces and one that is no mesh."""
    place = tmp_path_factory.mktemp("meshes")
    for kind in ("balls", "boxes"):
        (place / kind).mkdir()
    for index in range(4):
        trimesh.creation.icosphere(radius=1 + index).export(place / "balls" / f"{index}.ply")
        trimesh.creation.box([2, 1, 1 + index / 4]).export(place / "boxes" / f"{index}.obj")
    (place / "boxes" / "damaged.ply").write_bytes(b"ply\nnonsense")
    trimesh.PointCloud(np.eye(3)).export(place / "balls" / "points.ply")
    return place


def make(meshes, output, **options):
    return make_data_set(output, [meshes], side=SIDE, held_out=0.3, most=5.0, **options)


@pytest.fixture(scope="module")
def made(meshes, tmp_path_factory):
    output = tmp_path_factory.mktemp("made") / "set"
    make(meshes, output)
    return output


def test_sources_are_named_and_classed_by_their_folders(meshes):
    found = mesh_sources([meshes])
    assert {source.kind for source in found} == {"balls", "boxes"}
    assert [source.name for source in found][:2] == ["balls/0.ply", "balls/1.ply"]


def test_garments_take_the_classes_in_turn():
    kinds = [source.kind for source in garment_sources(12, 0)]
    assert kinds[:6] == kinds[6:] and len(set(kinds)) == 6


def test_a_set_holds_fields_points_and_what_is_known(made):
    data = DataSet.open(made)
    records, sdf, msdf, points = data.load(held_out=False)
    assert sdf.shape == msdf.shape == (len(records), SIDE, SIDE, SIDE) and points.shape[1:] == (2048, 3)
    assert len(data.records) == 8 and set(data.classes) == {"balls", "boxes"}
    assert all(record.loops == 0 for record in records)
    # Balls are round: all their points are as far from the middle.
    ball = next(i for i, record in enumerate(records) if record.kind == "balls")
    radius = np.linalg.norm(points[ball].astype(float), axis=1)
    assert radius.std() < 0.02 * radius.mean()


def test_the_split_is_by_name_and_complete(made):
    data = DataSet.open(made)
    split = [{record.name for record in data.load(held_out=held_out)[0]} for held_out in (False, True)]
    assert not split[0] & split[1] and len(split[0] | split[1]) == 8


def test_both_splits_take_one_pass(made, monkeypatch):
    data, read, of_file = DataSet.open(made), [], data_set.read_shard
    monkeypatch.setattr(data_set, "read_shard", lambda path, side: read.append(path) or of_file(path, side))
    both = data.load_splits(False, True)
    assert read == [data.shard_path(number) for number in range(data.config["shards"])]
    for split, held_out in zip(both, (False, True), strict=True):
        alone = data.load(held_out=held_out)
        assert split.records == alone.records
        assert all(np.array_equal(a, b) for a, b in zip(split[1:], alone[1:], strict=True))


def test_what_is_refused_is_listed_with_the_reason(made):
    rejected = json.loads((made / "statistics.json").read_text())["rejected"]
    reasons = {row["name"]: row["reason"] for row in rejected}
    assert set(reasons) == {"boxes/damaged.ply", "balls/points.ply"}
    assert any(words in reasons["balls/points.ply"] for words in ("holds no triangles", "cannot be read"))
    assert (made / "sheet.png").stat().st_size > 1000


def test_a_run_that_was_cut_off_goes_on_and_makes_the_same(meshes, made, tmp_path, monkeypatch):
    monkeypatch.setattr(making, "SHARD", 4)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    make(meshes, whole)
    calls = []

    def cut_off(*arguments, **options):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return convert(*arguments, **options)

    convert = making._convert_shard
    monkeypatch.setattr(making, "_convert_shard", cut_off)
    with pytest.raises(KeyboardInterrupt):
        make(meshes, parts)
    with pytest.raises(UserError, match="is not finished: 1 of 3 shards are missing; run the same"):
        DataSet.open(parts)
    first = (parts / "shards/00000.npz").stat().st_mtime_ns
    monkeypatch.setattr(making, "_convert_shard", convert)
    make(meshes, parts)
    assert (parts / "shards/00000.npz").stat().st_mtime_ns == first
    for a, b in zip(DataSet.open(whole).shards(), DataSet.open(parts).shards(), strict=True):
        assert a.records == b.records and np.array_equal(a.sdf, b.sdf) and np.array_equal(a.msdf, b.msdf)


def test_a_damaged_shard_is_told(meshes, tmp_path):
    make(meshes, tmp_path / "set")
    path = tmp_path / "set" / "shards" / "00000.npz"
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(UserError, match=r"Shard '.*00000.npz' cannot be read .*; remove it and run the same"):
        DataSet.open(tmp_path / "set").load(held_out=False)


def test_a_process_that_was_killed_is_told(monkeypatch):
    class Broken(ThreadPoolExecutor):
        def submit(self, *_):
            raise BrokenProcessPool

    monkeypatch.setattr(making, "ProcessPoolExecutor", lambda count, *_, **__: Broken(count))
    with pytest.raises(UserError, match="was ended from outside, perhaps for want of memory"):
        making._run([(None, [])] * 2, 2, "llvm_ad_rgb", lambda _: None)


def test_another_set_in_the_folder_is_left_alone(meshes, made):
    with pytest.raises(UserError, match="holds a data set of other sources or settings"):
        make_data_set(made, [meshes], side=24)
    assert len(DataSet.open(made).records) == 8


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "Nothing says where the data set goes"),
        (["-o", "{tmp}/set"], "There is nothing to make a data set of"),
        (["{tmp}/no", "-o", "{tmp}/set"], "does not exist; check the path"),
        (["{tmp}", "-o", "{tmp}/set"], "holds no mesh"),
        (["-o", "{tmp}/set", "--garments", "3", "--side", "20"], "--side must be a multiple of 8"),
        (["-o", "{tmp}/set", "--garments", "3", "--held-out", "1"], "--held-out must be at least 0"),
        (["-o", "{tmp}/set", "--garments", "3", "--processes", "0"], "--processes must be at least 1"),
        (["-o", "{tmp}/set", "--garments", "3", "--seed", "-1"], "--seed must not be negative, but is -1"),
        (["-o", "{tmp}/set", "--garments", "1000000000000"], "--garments must be at most"),
        (["-o", "{tmp}/set", "--garments", "3", "--max-chamfer", "nan"], "--max-chamfer must be more than 0"),
    ],
)
def test_mistakes_are_told(arguments, sentence, tmp_path, capsys, variant):
    given = [argument.replace("{tmp}", str(tmp_path)) for argument in arguments]
    assert main([*given, "--variant", variant]) == 2
    assert sentence in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_a_set_of_nothing_usable_is_told(tmp_path, capsys, variant):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "damaged.ply").write_bytes(b"ply\n")
    assert main([str(tmp_path / "in"), "-o", str(tmp_path / "set"), "--quiet", "--variant", variant]) == 2
    assert "None of 1 object could be used: damaged.ply" in capsys.readouterr().err
