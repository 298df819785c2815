"""The contract of a fit scene, and how missing targets come from its reference."""

import os
import shutil
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from bowl import SIZE, VIEWS, write_scene

from gshell_mi import UserError
from gshell_mi.scene import load_fit_scene

IDS = [f"view_{i:03}" for i in range(VIEWS)]


@pytest.fixture
def scene(bowl_scene, tmp_path) -> Path:
    """A copy of the bowl's fit scene with its targets, to be changed."""
    shutil.copytree(bowl_scene.parent, tmp_path / "in")
    return tmp_path / "in" / bowl_scene.name


@pytest.fixture
def referenced(tmp_path, monkeypatch) -> Path:
    """The fit scene with a reference in place of targets."""
    monkeypatch.setattr("gshell_mi.scene.REFERENCE_SPP", 1)
    return write_scene(tmp_path)


def change(scene: Path, old: str, new: str) -> None:
    text = scene.read_text()
    assert text.count(old) == 1
    scene.write_text(text.replace(old, new))


def test_loads_what_the_contract_names(scene):
    fit = load_fit_scene(scene)
    assert (fit.name, fit.path) == ("bowl", scene)
    assert fit.subject.id() == "subject" and fit.subject.lattice.resolution == 20
    assert fit.light.id() == "light" and fit.light.is_environment()
    assert [sensor.id() for sensor in fit.sensors] == IDS
    assert [target.path for target in fit.targets] == [scene.parent / "bowl" / f"{name}.exr" for name in IDS]
    assert all(target.rgba.shape == (SIZE, SIZE, 4) for target in fit.targets)


def test_views_are_held_out(scene):
    fit, every = load_fit_scene(scene, hold_out=5), load_fit_scene(scene)
    held_out = ["view_000", "view_005", "view_010"]
    assert [view.sensor.id() for view in fit.held_out] == held_out and every.held_out == []
    assert [sensor.id() for sensor in fit.sensors] == [name for name in IDS if name not in held_out]
    for view in (*fit.training, *fit.held_out):
        assert view.target.path.stem == view.sensor.id()
    assert fit.target_files == every.target_files and len(fit.target_files) == VIEWS


@pytest.mark.parametrize(("hold_out", "left"), [(1, 0), (2, 6), (12, 11), (99, 11)])
def test_two_views_are_left_at_least(scene, hold_out, left):
    if left:
        assert len(load_fit_scene(scene, hold_out=hold_out).sensors) == left
    else:
        with pytest.raises(UserError, match=r"--hold-out 1 leaves 0 of the 12 views of .*; give a greater"):
            load_fit_scene(scene, hold_out=hold_out)


def test_the_path_may_be_a_string(scene):
    assert load_fit_scene(str(scene)).path == scene


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'type="gshell" id="subject"> <integer name="resolution" value="20"/>',
            'type="sphere">',
            "has no gshell shapes; a fit needs exactly one",
        ),
        ("</shape>", '</shape> <shape type="gshell"/>', "has 2 gshell shapes"),
        ('id="light"', 'id="lamp"', "no environment emitter with the id 'light'"),
        (
            'type="constant" id="light"',
            'type="point" id="light"',
            "no environment emitter with the id 'light'",
        ),
        ('type="constant" id="light"', 'type="sunsky" id="light"', "'light'; add .*constant.* or an envmap"),
        ('"view_007"', '"view_002"', "view_002"),
        ('type="constant"', 'type="unheard_of"', "cannot be loaded by Mitsuba: .*unheard_of"),
        ("</scene>", "", "cannot be loaded by Mitsuba"),
    ],
)
def test_what_it_refuses(scene, old, new, message):
    change(scene, old, new)
    with pytest.raises(UserError, match=message) as told:
        load_fit_scene(scene)
    assert str(scene) in str(told.value) and "\n" not in str(told.value)


def test_other_shapes_and_lights_may_be_there(scene):
    extra = '<shape type="rectangle"/> <emitter type="point" id="lamp"/>'
    change(scene, "</scene>", extra + "</scene>")
    fit = load_fit_scene(scene)
    assert fit.subject.id() == "subject" and fit.light.id() == "light"


def test_a_mesh_twice_at_one_place_is_told(scene):
    """Of different materials, as Mitsuba makes one mesh of those of equal ones."""
    assert load_fit_scene(scene).notes == []
    cubes = "".join(
        f'<shape type="cube" id="{name}"> <bsdf type="diffuse"> <rgb name="reflectance" '
        f'value="{value}"/> </bsdf> </shape>'
        for name, value in (("a", 0.2), ("b", 0.7))
    )
    change(scene, "</scene>", cubes + "</scene>")
    (note,) = load_fit_scene(scene).notes
    assert note.partition(": ")[0] in {
        f"Mesh '{a}' has 12 faces that lie in faces of mesh '{b}'" for a, b in ("ab", "ba")
    }


def test_targets_that_nowhere_reach_full_coverage_are_told(scene):
    for path in scene.with_suffix("").glob("*.exr"):
        mi.Bitmap(np.array(mi.Bitmap(str(path))) * np.float32(0.5)).write(str(path))
    (note,) = load_fit_scene(scene).notes
    assert note.startswith("No target has an alpha above 0.50, so the object counts as half transparent")


def test_another_folder_of_targets(scene, tmp_path):
    shutil.copytree(scene.with_suffix(""), tmp_path / "other")
    marked = np.full((SIZE, SIZE, 4), 0.25, np.float32)
    mi.Bitmap(marked).write(str(tmp_path / "other" / "view_003.exr"))
    fit = load_fit_scene(scene, tmp_path / "other")
    assert {target.path.parent for target in fit.targets} == {tmp_path / "other"}
    np.testing.assert_array_equal(fit.targets[3].rgba, marked)


def test_nothing_is_rendered_into_another_folder(referenced, tmp_path):
    (tmp_path / "other").mkdir()
    with pytest.raises(UserError, match=r"view_000\.exr' is missing"):
        load_fit_scene(referenced, tmp_path / "other")
    assert not list((tmp_path / "other").iterdir())


def test_renders_only_what_is_missing(referenced):
    folder = referenced.with_suffix("")
    mine = np.full((SIZE, SIZE, 4), 0.25, np.float32)
    mi.Bitmap(mine).write(str(folder / "view_003.exr"))
    before = (folder / "view_003.exr").read_bytes()
    calls = []
    fit = load_fit_scene(referenced, on_reference=lambda done, count: calls.append((done, count)))
    assert calls == [(done, VIEWS - 1) for done in range(VIEWS)]
    assert (folder / "view_003.exr").read_bytes() == before
    np.testing.assert_array_equal(fit.targets[3].rgba, mine)
    assert {path.name for path in folder.iterdir()} == {f"{name}.exr" for name in IDS} | {
        "reference.xml",
        "truth.ply",
    }
    for target in fit.targets[:3] + fit.targets[4:]:
        assert target.has_alpha
        assert mi.Bitmap(str(target.path)).component_format() == mi.Struct.Type.Float16
        assert 0.05 < target.rgba[..., 3].mean() < 0.9, "the object before nothing"

    calls.clear()
    load_fit_scene(referenced, on_reference=lambda *call: calls.append(call))
    assert not calls, "they are kept"


def test_an_interrupted_rendering_leaves_whole_targets_only(referenced, monkeypatch):
    """Killed between writing a file and moving it to its place; the next run does the rest."""
    replace, folder = os.replace, referenced.with_suffix("")

    def die(source, destination):
        if Path(destination).stem == "view_002":
            raise KeyboardInterrupt
        replace(source, destination)

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", die)
        with pytest.raises(KeyboardInterrupt):
            load_fit_scene(referenced)
    assert sorted(path.name for path in folder.glob("view_*")) == ["view_000.exr", "view_001.exr"]
    first = (folder / "view_000.exr").read_bytes()
    assert len(load_fit_scene(referenced).targets) == VIEWS
    assert (folder / "view_000.exr").read_bytes() == first
    assert not list(folder.glob(".*"))


def test_a_target_that_cannot_be_written(referenced, monkeypatch):
    def full(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(UserError, match=r"view_000.exr' cannot be written \(No space left on device\)"):
        load_fit_scene(referenced)
    assert {path.name for path in referenced.with_suffix("").iterdir()} == {"reference.xml", "truth.ply"}
