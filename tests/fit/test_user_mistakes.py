"""What the command says of mistakes: exit code 2, one sentence on stderr that names the culprit."""

import dataclasses
import errno
import json
import os
import re
import shutil
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from bowl import CLOSED, SHORT, SIZE

from gshell_mi.errors import UserError
from gshell_mi.fit import FitConfig
from gshell_mi.fit.__main__ import main
from gshell_mi.fit.bookkeeping.checkpoint import Checkpoint
from gshell_mi.fit.flags import GONE, RENAMED
from gshell_mi.fit.scene_checks import notes_on_views
from gshell_mi.fit.stages.openings import Openings
from gshell_mi.own_folder import OwnFolder
from gshell_mi.scene import load_fit_scene


@pytest.fixture
def scene(bowl_scene, tmp_path) -> Path:
    """A copy of the bowl's fit scene, to be spoilt."""
    shutil.copytree(bowl_scene.parent, tmp_path / "in")
    return tmp_path / "in" / bowl_scene.name


@pytest.fixture
def told(scene, tmp_path, capfd):
    """Runs the command on the spoilt scene and checks what holds for every mistake; returns its sentence."""

    def run(*arguments, path=scene, output=tmp_path / "out", whole=False):
        capfd.readouterr()
        before = sorted(output.rglob("*")) if output.is_dir() else None
        assert main([str(path), "-o", str(output), *SHORT, *arguments]) == 2
        *stages, sentence = capfd.readouterr().err.strip().splitlines()
        assert re.fullmatch(r"error: .+", sentence)
        # What was done before has its lines; what takes a second says that it has begun.
        stages = [line for line in stages if line and not re.fullmatch(r"memory: about.+|.+ so far", line)]
        assert not stages or (whole and all(re.fullmatch(r"[a-z ]+: (.+/|took ).+", line) for line in stages))
        if not whole:
            assert (sorted(output.rglob("*")) if output.is_dir() else None) == before
        return sentence

    return run


def change(scene: Path, old: str, new: str) -> None:
    text = scene.read_text()
    assert text.count(old) >= 1
    scene.write_text(text.replace(old, new, 1))


def rewrite(target: Path, edit) -> None:
    """Applies ``edit`` to the pixels of a target."""
    pixels = np.array(mi.Bitmap(str(target)))
    mi.Bitmap(np.ascontiguousarray(edit(pixels))).write(str(target))


def target(scene: Path, name: str = "view_003") -> Path:
    return scene.with_suffix("") / f"{name}.exr"


# --- the scene


def test_missing_scene(told, tmp_path):
    assert f"'{tmp_path / 'none.xml'}' does not exist" in told(path=tmp_path / "none.xml")


def test_not_xml(told, scene):
    scene.write_text("G-Shell?\n\nno")
    assert f"Scene '{scene}' cannot be loaded by Mitsuba" in told()


def test_unknown_plugin(told, scene):
    change(scene, 'type="constant"', 'type="sunshine"')
    assert "sunshine" in told()


def test_no_gshell_shape(told, scene):
    change(scene, 'type="gshell"', 'type="sphere"')
    change(scene, '<integer name="resolution" value="20"/>', "")
    assert "has no gshell shape" in told()


def test_two_gshell_shapes(told, scene):
    change(scene, "</shape>", '</shape>\n<shape type="gshell" id="other"/>')
    assert "has 2 gshell shapes; a fit needs exactly one" in told()


def test_no_sensors(told, scene):
    scene.write_text(re.sub(r"<sensor.*</sensor>", "", scene.read_text(), flags=re.DOTALL))
    assert "has no sensors" in told()


def test_sensors_of_the_same_id(told, scene):
    change(scene, '"view_004"', '"view_003"')
    assert "view_003" in told()


def test_orthographic_sensor(told, scene):
    change(
        scene,
        '<sensor type="perspective" id="view_000">\n        <float name="fov" value="32"/>',
        '<sensor type="orthographic" id="view_000">',
    )
    assert re.search("Sensor 'view_000' is an? .*[Oo]rthographic.*, but a fit needs perspective", told())


def test_no_light(told, scene):
    change(scene, '<emitter type="constant" id="light"/>', "")
    assert "has no environment emitter with the id 'light'" in told()


def test_light_of_another_kind(told, scene):
    change(scene, '<emitter type="constant" id="light"/>', '<emitter type="point" id="light"/>')
    assert "no environment emitter with the id 'light'" in told()


@pytest.mark.parametrize(
    "emitter",
    [
        '<emitter type="point" id="p"/>',
        """
    <shape type="rectangle" id="window"> <emitter type="area" id="p"/> </shape>""",
    ],
)
def test_another_emitter(told, scene, emitter):
    change(scene, "</shape>", f"</shape> {emitter}")
    assert "has another emitter beside 'light' ('p'); a fit explains the images by one environment" in told()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("../../escaped", "has a '/'"),
        ("cam/3", "has a '/'"),
        ("a\\b", "has a '\\'"),
        ("..", "is no name"),
        ("x" * 245, "is longer than 200 bytes"),
        ("x" * 300, "is longer than 200 bytes"),
        ("&#10;", "cannot be printed"),
        ("ü" * 101, "is longer than 200 bytes"),
    ],
)
def test_ids_that_are_no_names_of_files(told, scene, name, reason):
    change(scene, '"view_004"', f'"{name}"')
    assert reason in told()
    assert not list(scene.parent.parent.glob("escaped*"))


def test_an_id_with_quotes_and_spaces(scene, tmp_path):
    change(scene, '"view_000"', '"&quot;a&quot; &amp; b"')
    target(scene, "view_000").rename(target(scene, '"a" & b'))
    assert main([str(scene), "-o", str(tmp_path / "out"), *SHORT, *CLOSED, "--iterations", "0"]) == 0
    assert (tmp_path / "out" / "views" / '"a" & b.png').is_file()
    ids = [sensor.id() for sensor in mi.load_file(str(tmp_path / "out" / "scene.xml")).sensors()]
    assert ids[0] == '"a" & b'


def test_unknown_grid(told, scene):
    change(scene, '<integer name="resolution" value="20"/>', '<string name="grid" value="hexagons"/>')
    assert "grid 'hexagons' is not available" in told()


def test_object_outside_the_box(told, scene):
    change(
        scene,
        "</shape>",
        '<transform name="to_world"> <scale value="0.1"/> <translate y="0.8"/> </transform> </shape>',
    )
    assert "no common volume in the box" in told(whole=True)
    assert "no common volume in the box" in told(whole=True), "and a second try is not told of an earlier fit"


# --- the targets


def test_missing_target(told, scene):
    target(scene).unlink()
    assert f"Target '{target(scene)}' is missing" in told()


def test_missing_folder_of_targets(told, tmp_path):
    assert f"'{tmp_path / 'none' / 'view_000.exr'}' is missing" in told("--targets", str(tmp_path / "none"))


def test_target_of_another_size(told, scene):
    rewrite(target(scene), lambda pixels: pixels[:-8])
    assert f"is {SIZE} x {SIZE - 8} pixels, but its sensor's film is {SIZE} x {SIZE}" in told()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_target_with_nan(told, scene, value):
    def spoil(pixels):
        pixels[5, 7, 1] = value
        return pixels

    rewrite(target(scene), spoil)
    sentence = told()
    assert str(target(scene)) in sentence and "NaN or infinity (first at column 7, row 5)" in sentence


def test_truncated_target(told, scene):
    data = target(scene).read_bytes()
    target(scene).write_bytes(data[: len(data) // 2])
    assert f"Target '{target(scene)}' cannot be read as an image" in told()


def test_grey_target(told, scene):
    rewrite(target(scene), lambda pixels: pixels[..., :1])
    assert "a target needs R, G, B and A" in told()


def test_alpha_out_of_range(told, scene):
    rewrite(target(scene), lambda pixels: 255 * pixels)
    assert "alpha is coverage and lies between 0 and 1" in told()


def test_empty_alpha_everywhere(told, scene):
    for path in scene.with_suffix("").glob("*.exr"):
        rewrite(path, np.zeros_like)
    assert "their alpha is 0 everywhere" in told()


# --- the settings


def test_unknown_variant(told):
    assert "variant 'scalar_rgb' is not usable" in told("--variant", "scalar_rgb")


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--render.spp", "0"),
        ("--radiance.batch", "0"),
        ("--iterations", "-1"),
        ("--render.max-depth", "1"),
        ("--joint.warmup", "1.5"),
        ("--gains.prior", "0"),
        ("--gains.places", "0"),
        ("--resolution", "0"),
        ("--checkpoint-seconds", "-1"),
        ("--losses.light-grey", "-0.1"),
    ],
)
def test_setting_out_of_range(told, option, value):
    assert option.strip("-").replace("-", " ").split()[-1] in told(option, value)


@pytest.mark.parametrize("mode", ["--fixed-material", "--geometry-only"])
def test_no_material_to_keep(told, scene, mode):
    sentence = f"{mode} keeps the material of the gshell shape, but '{scene}' gives it no uniform one"
    assert sentence in told(mode)


def test_every_number_has_its_bounds():
    """NaN, infinity and negative numbers make no sense anywhere; 0 switches off or is refused."""
    numbers = {
        name: value
        for name, value in FitConfig(resolution=64).settings().items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }
    assert len(numbers) > 50
    for name, value in numbers.items():
        impossible = [-1] if isinstance(value, int) else [-0.1, np.nan, np.inf]
        for wrong in impossible:
            with pytest.raises(UserError, match=f"^--{name.replace('_', '-')} must be"):
                FitConfig().changed({name: wrong})


@pytest.mark.parametrize("name", ["occlusion.levels", "cameras.levels", "render.views"])
def test_numbers_that_would_never_end(name):
    with pytest.raises(UserError, match=f"^--{name} must be at most"):
        FitConfig().changed({name: 10**12})


@pytest.mark.parametrize("words", [("eikonal", "-1"), ("eikonal", "nan")])
def test_weights_of_further_losses_have_theirs(told, words):
    assert "--losses.extra eikonal must be" in told("--losses.extra", *words)


def test_a_loss_that_there_is_not(told):
    words = "There is no loss 'tea' for --losses.extra; there are albedo_chroma,"
    assert words in told("--losses.extra", "tea", "1")


@pytest.mark.parametrize("old", sorted(RENAMED))
def test_flags_of_earlier_versions_are_told_the_new_name(old, capfd):
    assert main(["scene.xml", f"--{old}", "1"]) == 2
    told = capfd.readouterr().err.strip()
    assert told == f"error: --{old} is called --{RENAMED[old]} now; --help lists all settings."


@pytest.mark.parametrize("old", GONE)
def test_flags_that_are_gone_are_told_so(old, capfd):
    assert main(["scene.xml", f"--{old}=0.9"]) == 2
    told = capfd.readouterr().err.strip()
    assert told == f"error: --{old} is gone, as one judge decides what is kept; leave it out."


def test_the_new_names_are_settings():
    names = {name.replace("_", "-") for name in FitConfig().settings()} | {"effort"}
    found = {new.split(" ")[0].replace("no-", "") for new in RENAMED.values()}
    assert found <= names and len(RENAMED) >= 75
    assert not RENAMED.keys() & names, "what is called so still is no old name"


def test_smoothing_and_rates_of_0_switch_off(bowl_scene, tmp_path):
    off = [
        word
        for name in (
            "radiance.smoothing",
            "refinement.smoothing",
            "refinement.lr",
            "refinement.radiance-lr",
            "joint.geometry-smoothing",
            "joint.geometry-detail",
            "joint.geometry-lr",
            "joint.deform-lr",
            "joint.material-smoothing",
            "joint.material-lr",
            "joint.light-lr",
            "checkpoint-seconds",
            "hull.daylight-votes",
            "topology.min-area",
            "joint.warmup",
            "joint.color-hold",
        )
        for word in (f"--{name}", "0")
    ]
    assert main([str(bowl_scene), "-o", str(tmp_path), *SHORT, *CLOSED, "--iterations", "3", *off]) == 0
    losses = [json.loads(line)["loss"] for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert np.isfinite(losses).all()


@pytest.mark.parametrize("mode", ["--known-light", "--geometry-only"])
def test_a_known_light_does_not_turn(told, mode):
    assert f"{mode} keeps the light where the scene has it" in told(mode, "--light-frame", "camera")


def test_too_few_views_to_tell_anything_are_told_of(bowl_scene):
    scene = load_fit_scene(bowl_scene)
    assert notes_on_views(scene) == []
    (note,) = notes_on_views(dataclasses.replace(scene, targets=scene.targets[:3]))
    assert "fewer than 4 training views" in note and "give more views" in note


def test_no_surface_left(told, scene, tmp_path):
    sentence = told(
        *CLOSED,
        "--refinement.iterations",
        "0",
        "--joint.warmup",
        "0",
        "--losses.extra",
        "hole_opening",
        "1e6",
        "--joint.geometry-lr",
        "2",
        "--joint.msdf-lr",
        "9",
        whole=True,
    )
    assert "has left no surface; start again with --overwrite and a smaller --joint.geometry-lr" in sentence
    output = tmp_path / "out"
    assert Checkpoint.load(output / "checkpoint.npz").stage == "joint", "nothing is lost"
    assert not (output / "metrics.json").exists() and not list(output.glob(".*"))


def test_given_fields_without_a_surface(told, scene):
    np.savez(scene.parent / "air.npz", sdf=np.ones(21**3, np.float32))
    change(
        scene,
        '<integer name="resolution" value="20"/>',
        f'<string name="filename" value="{scene.parent / "air.npz"}"/>',
    )
    assert "air.npz' of the gshell shape" in told() and "hold no surface" in told()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("scene.xml --no-such-flag", "--no-such-flag is no option; "),
        ("scene.xml --iteration 5", "--iteration is no option; did you mean --iterations\\? "),
        ("scene.xml --iterations many", "Error parsing --iterations: .*'many'; "),
        ("scene.xml --effort quick", r"invalid choice 'quick' for argument '--effort'. Expected one of .*; "),
        ("scene.xml --render.views", "Missing value for argument '--render.views'. Expected 1 values; "),
        ("", "Missing from python -m gshell_mi.fit: PATH The fit scene: .*; "),
    ],
)
def test_words_that_are_not_understood(words, sentence, capfd):
    assert main(words.split()) == 2
    told = capfd.readouterr().err
    assert re.fullmatch(f"error: {sentence}python -m gshell_mi.fit --help lists all options.\n", told)


# --- the output folder


def test_output_below_a_file(told, tmp_path):
    (tmp_path / "file").write_text("")
    output = tmp_path / "file" / "out"
    assert f"'{output}' cannot be made because '{tmp_path / 'file'}' is a file" in told(output=output)


@pytest.mark.skipif(os.name == "posix" and os.geteuid() == 0, reason="root may write anywhere")
def test_output_without_permission(told, tmp_path):
    (tmp_path / "locked").mkdir(mode=0o500)
    assert "no permission" in told(output=tmp_path / "locked" / "out")


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder that nobody may write")
def test_output_that_not_even_root_may_write(told):
    assert "'/proc/self/out' cannot be written" in told(output=Path("/proc/self/out"), whole=True)


def test_earlier_fit_is_kept(told, tmp_path):
    output = tmp_path / "out"
    write_mesh(output)
    assert "holds an earlier fit (mesh.ply)" in told()
    assert (output / "mesh.ply").read_text() == "precious"


def test_earlier_fit_survives_a_mistake_with_overwrite(told, scene, tmp_path):
    output = tmp_path / "out"
    write_mesh(output)
    target(scene).unlink()
    assert "is missing" in told("--overwrite")
    assert (output / "mesh.ply").read_text() == "precious"


def write_mesh(output: Path) -> None:
    """As an earlier fit has left it."""
    output.mkdir()
    OwnFolder(output, "fit").claim("mesh.ply")
    (output / "mesh.ply").write_text("precious")


@pytest.mark.parametrize("options", [(), ("--overwrite",)])
def test_the_scene_in_the_output_folder_stays(told, scene, options):
    scene.rename(scene.parent / "scene.xml")
    scene.with_suffix("").rename(scene.parent / "scene")
    scene = scene.parent / "scene.xml"
    before = scene.read_bytes()
    assert f"'{scene}' is in the way" in told(*options, path=scene, output=scene.parent)
    assert scene.read_bytes() == before


def test_targets_in_the_output_folder_stay(scene, tmp_path):
    output = tmp_path / "out"
    shutil.copytree(scene.with_suffix(""), output / "views")
    (output / "views" / "holiday.jpg").write_bytes(b"mine")
    before = {path: path.read_bytes() for path in output.rglob("*.*")}
    options = ["--targets", str(output / "views"), "--overwrite", "--iterations", "0"]
    assert main([str(scene), "-o", str(output), *SHORT, *CLOSED, *options]) == 0
    assert {path: path.read_bytes() for path in before} == before
    assert (output / "views" / "view_000.png").is_file()


def test_a_light_that_the_scene_reads_stays(told, scene, tmp_path):
    output = tmp_path / "out"
    output.mkdir()
    OwnFolder(output, "fit").claim("light.exr")
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write(str(output / "light.exr"))
    change(
        scene,
        '<emitter type="constant" id="light"/>',
        f'<default name="map" value="{output}/light.exr"/> <emitter type="envmap" id="light"> '
        '<string name="filename" value="$map"/> </emitter>',
    )
    assert f"'{output / 'light.exr'}' is read by this run and would be replaced by it" in told("--overwrite")


def test_a_folder_of_a_capture(told, tmp_path):
    (tmp_path / "out").mkdir()
    OwnFolder(tmp_path / "out", "capture").write_mark([])
    assert f"'{tmp_path / 'out'}' was written by gshell_mi.capture" in told("--overwrite")


def test_resume_without_checkpoint(told):
    assert "There is no checkpoint" in told("--resume")


@pytest.fixture
def stopped(scene, tmp_path, monkeypatch) -> Path:
    """The folder of a fit that was interrupted after its first stage."""
    with monkeypatch.context() as patch:
        patch.setattr(Openings, "run", _interrupt)
        assert main([str(scene), "-o", str(tmp_path / "out"), *SHORT]) == 130
    return tmp_path / "out"


def _interrupt(*_):
    raise KeyboardInterrupt


def test_interrupt_says_how_to_go_on(scene, stopped, capfd):
    assert (stopped / "checkpoint.npz").is_file()
    assert not list(stopped.glob(".*"))


def test_all_views_held_out(told):
    assert "--hold-out 1 leaves 0 of the 12 views" in told("--hold-out", "1")


def test_resume_with_other_views_held_out(told, stopped):
    assert "was made with hold_out = 0, not 4; resume with the same settings" in told(
        "--resume", "--hold-out", "4"
    )


def test_resume_with_another_effort(told, stopped):
    found = told("--resume", "--effort", "thorough")
    assert "was made with --effort" in found and "not thorough; resume with the same settings" in found


def test_resume_with_other_settings(told, stopped):
    assert "was made with render.max_depth = 2, not 3" in told("--resume", "--render.max-depth", "3")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('value="20"', 'value="24"', "(lattice: flexicubes, 20 cells instead of flexicubes, 24 cells)"),
        (
            '<integer name="resolution" value="20"/>',
            '<integer name="resolution" value="20"/> <string name="grid" value="tet"/>',
            "(lattice: flexicubes, 20 cells instead of tet, 20 cells)",
        ),
        (
            "</shape>",
            '<transform name="to_world"> <scale value="2"/> </transform> </shape>',
            "(to_world of the gshell shape)",
        ),
        (
            "</shape>",
            '<bsdf type="diffuse"> <rgb name="reflectance" value="0.1"/> </bsdf> </shape>',
            "(material of the gshell shape)",
        ),
        (
            "</shape>",
            '</shape> <shape type="sphere"> <point name="center" x="9" y="0" z="0"/> </shape>',
            "(objects beside the gshell shape)",
        ),
        (
            '<emitter type="constant" id="light"/>',
            '<emitter type="constant" id="light"> <rgb name="radiance" value="2"/> </emitter>',
            "(initial light)",
        ),
        ('"32"', '"33"', "(cameras of 'view_000')"),
    ],
)
def test_resume_with_another_scene(told, scene, stopped, old, new, words):
    change(scene, old, new)
    assert words in told("--resume")


def test_resume_with_other_targets(told, scene, stopped):
    rewrite(target(scene), lambda pixels: 0.9 * pixels)
    assert "(images of 'view_003'); resume with the same" in told("--resume")


def test_resume_with_fewer_views(told, scene, stopped):
    sensors = re.compile(r'<sensor type="perspective" id="view_00[2-9].*?</sensor>', re.DOTALL)
    scene.write_text(sensors.sub("", scene.read_text()))
    words = "(12 views instead of 4: 'view_002', 'view_003', 'view_004' ...)"
    assert words in told("--resume")


def test_resume_with_a_copy_elsewhere(scene, stopped, tmp_path):
    """It is not the name of the scene that counts; a comment changes nothing either."""
    shutil.copytree(scene.parent, tmp_path / "copy")
    copy = (tmp_path / "copy" / scene.name).rename(tmp_path / "copy" / "other.xml")
    change(copy, "<shape", "<!-- the same --> <shape")
    options = ["--targets", str(tmp_path / "copy" / "bowl"), "--resume"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Openings, "run", _interrupt)
        assert main([str(copy), "-o", str(stopped), *SHORT, *options]) == 130


@pytest.mark.parametrize(
    "damage",
    [
        b"garbage\n",
        b"\n",
        b"\0\0\0\n",
        b"5\n",
        b'{"stage": "tea"}\n',
        b"\xff\xfe\n",
        b"{}",
        b'{"stage": "openings", "iteration": "1"}\n',
        b"[" * 9000 + b"\n",
    ],
)
def test_a_damaged_log_is_no_reason_to_stop(scene, stopped, damage):
    (stopped / "log.jsonl").write_bytes(damage)
    assert main([str(scene), "-o", str(stopped), *SHORT, "--openings.iterations", "1", "--resume"]) == 2
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Openings, "run", _interrupt)
        assert main([str(scene), "-o", str(stopped), *SHORT, "--resume"]) == 130
    assert (stopped / "log.jsonl").read_bytes() == b""


def test_damaged_checkpoint(told, stopped):
    data = (stopped / "checkpoint.npz").read_bytes()
    (stopped / "checkpoint.npz").write_bytes(data[: len(data) // 2])
    assert f"'{stopped / 'checkpoint.npz'}' is damaged" in told("--resume")


def test_checkpoint_of_another_version(told, stopped, monkeypatch):
    monkeypatch.setattr("gshell_mi.fit.bookkeeping.checkpoint.FORMAT", 99)
    assert "written by another version" in told("--resume")


def _full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_disk_full_at_a_checkpoint(told, stopped, monkeypatch):
    before = (stopped / "checkpoint.npz").read_bytes()
    monkeypatch.setattr("numpy.savez", _full)
    assert "No space left on device" in told("--resume", whole=True)
    assert (stopped / "checkpoint.npz").read_bytes() == before, "the older one stays"
    assert not list(stopped.glob(".*")), "no remains"


@pytest.mark.parametrize("writer", ["_write_surface", "write_views"])
def test_disk_full_at_export(told, scene, tmp_path, monkeypatch, writer):
    output = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(f"gshell_mi.export.fit_folder.{writer}", _full)
        assert "No space left on device" in told(*CLOSED, "--iterations", "1", whole=True)
    assert not (output / "metrics.json").exists()
    assert main([str(scene), "-o", str(output), *SHORT, *CLOSED, "--iterations", "1", "--resume"]) == 0
    assert (output / "metrics.json").is_file()
