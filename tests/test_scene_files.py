"""Scenes are data: what a foreign file may not make Mitsuba do."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
import trimesh
from PIL import Image

from gshell_mi.errors import UserError
from gshell_mi.scene_files import is_scene_file, load_scene

SENSOR = '<sensor type="perspective" id="view"/>'
#: A library that leaves a mark when it is loaded.
CODE = """
#include <stdio.h>
__attribute__((constructor)) static void loaded(void) { FILE *f = fopen(MARK, "w"); if (f) fclose(f); }
"""


def scene(folder, content, name="scene.xml"):
    (folder / name).write_text(f'<scene version="3.0.0">{content}</scene>', encoding="utf-8")
    return folder / name


@pytest.fixture
def planted(tmp_path):
    """A folder whose plugins would leave a mark, under names of Mitsuba's and others; and the mark."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no C compiler to make a plugin with")
    (tmp_path / "plugins").mkdir()
    (tmp_path / "code.c").write_text(CODE)
    mark, library = tmp_path / "loaded", tmp_path / "plugins" / "evil.so"
    subprocess.run(
        [compiler, "-shared", "-fPIC", f'-DMARK="{mark}"', str(tmp_path / "code.c"), "-o", str(library)],
        check=True,
    )
    for name in ("perspective", "hdrfilm", "independent", "gaussian", "path", "prb", "gshell", "cylinder"):
        shutil.copy(library, library.with_name(f"{name}.so"))
    return tmp_path, mark


def run(folder, *lines):
    """In a process of its own, as plugins are loaded once; from the folder, which is searched as well."""
    program = "\n".join(
        [
            "import gshell_mi, mitsuba as mi",
            "mi.set_variant('llvm_ad_rgb')",
            "from gshell_mi.scene_files import load_scene",
            *lines,
        ]
    )
    return subprocess.run(
        [sys.executable, "-c", program],
        cwd=folder,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
    )


def test_plugins_beside_a_scene_are_never_loaded(planted):
    folder, mark = planted
    path = scene(folder, f'{SENSOR}<shape type="cylinder"/><integrator type="path"/>')
    found = run(folder, f"print(len(load_scene({str(path)!r}).shapes()))")
    assert (found.stdout.strip(), mark.exists()) == ("1", False), found.stderr


@pytest.mark.parametrize(
    "content",
    [
        '<shape type="evil"/>',
        '<default name="kind" value="evil"/><shape type="$kind"/>',
        '<path value="{folder}"/><shape type="evil"/>',
        '<shape type="../plugins/evil"/>',
        '<include filename="inner.xml"/>',
        '<bsdf type="twosided"><bsdf type="evil"/></bsdf>',
    ],
)
def test_types_that_nobody_knows_are_refused_before_anything_is_loaded(content, planted):
    folder, mark = planted
    scene(folder, '<emitter type="evil"/>', "inner.xml")
    path = scene(folder, SENSOR + content.format(folder=folder))
    with pytest.raises(UserError, match=r"names a plugin '.*evil', which neither Mitsuba nor gshell_mi has"):
        load_scene(path)
    assert not mark.exists()


def test_the_resource_path_is_put_back(tmp_path):
    before = [str(folder) for folder in mi.file_resolver()]
    load_scene(scene(tmp_path, f'<path value="{tmp_path}"/>{SENSOR}'))
    with pytest.raises(UserError):
        load_scene(scene(tmp_path, '<shape type="evil"/>'))
    assert [str(folder) for folder in mi.file_resolver()] == before


@pytest.mark.parametrize("included", [False, True])
def test_nesting_that_would_overflow_mitsubas_stack(included, tmp_path):
    deep = scene(tmp_path, '<bsdf type="twosided">' * 100_000 + "</bsdf>" * 100_000, "deep.xml")
    if included:
        deep = scene(tmp_path, '<default name="n" value="deep"/><include filename="$n.xml"/>')
    with pytest.raises(UserError, match="nested more than 100 elements deep"):
        load_scene(deep)


def test_a_file_that_includes_itself_is_refused(tmp_path):
    looping = scene(tmp_path, 4 * '<include filename="scene.xml"/>')
    with pytest.raises(UserError, match="a file may not include itself"):
        load_scene(looping)


def test_files_beside_the_scene_are_found(tmp_path):
    (tmp_path / "inside").mkdir()
    trimesh.creation.icosphere(1).export(tmp_path / "inside" / "ball.ply")
    scene(tmp_path, SENSOR, "sensors.xml")
    path = scene(
        tmp_path,
        '<include filename="sensors.xml"/><shape type="ply">'
        '<string name="filename" value="inside/ball.ply"/></shape>',
    )
    loaded = load_scene(path)
    assert (loaded.sensors()[0].id(), loaded.shapes()[0].face_count()) == ("view", 80)


def test_an_image_that_would_crash_mitsuba_is_refused(tmp_path):
    OpenEXR.File(
        {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "displayWindow": ((0, 0), (31, 15)),
            "dataWindow": ((-2, -2), (31, 15)),
        },
        {name: np.ones((18, 34), np.float32) for name in "RGB"},
    ).write(str(tmp_path / "light.exr"))
    path = scene(tmp_path, '<emitter type="envmap"><string name="filename" value="light.exr"/></emitter>')
    with pytest.raises(UserError, match=r"light.exr' has a data window other than its display window"):
        load_scene(path)


#: A row that is not packed behind one that is: Mitsuba writes past the end of its memory.
_OVERFLOWING = (
    b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 8\n\2\2\0\10" + b"\x88\x80" * 4 + b"\x90\x10" * 40
)


@pytest.mark.parametrize(
    "around",
    [
        '<emitter type="envmap">{}</emitter>',
        '<bsdf type="diffuse"><texture type="bitmap" name="reflectance">{}</texture></bsdf>',
    ],
)
@pytest.mark.parametrize(
    "name, content",
    [
        ("a.hdr", _OVERFLOWING),
        ("a.png", _OVERFLOWING),
        ("a.pfm", b"PF\n65536 65536\n-1.0\n" + bytes(48)),
        ("a.ppm", b"P6\n65536 65536\n255\n" + bytes(48)),
        ("a.bmp", b"BM" + bytes(8) + b"\x36\0\0\0\x28\0\0\0\x10\0\0\0\0\0\0\x80\1\0\x18\0" + bytes(40)),
        # Behind a header of no size comes what makes Mitsuba take it for TGA.
        ("a.tga", bytes((0, 0, 2)) + bytes(13) + bytes((24, 0)) + bytes(16) + b"TRUEVISION-XFILE.\0"),
    ],
)
def test_images_that_would_crash_mitsuba_are_refused(around, name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    path = scene(tmp_path, SENSOR + around.format(f'<string name="filename" value="{name}"/>'))
    with pytest.raises(UserError, match=rf"{name}' cannot be read"):
        load_scene(path)


def test_images_of_other_kinds_are_textures(tmp_path):
    colors = np.random.default_rng(0).integers(0, 255, (8, 8, 3), np.uint8)
    for name in ("a.png", "a.jpg", "a.bmp", "a.ppm"):
        Image.fromarray(colors).save(tmp_path / name)
    mi.Bitmap(colors.astype(np.float32)).write(str(tmp_path / "a.hdr"))
    mi.Bitmap(colors.astype(np.float32)).write(str(tmp_path / "a.pfm"))
    textures = "".join(
        f'<bsdf type="diffuse" id="{path.suffix[1:]}"> <texture type="bitmap" '
        f'name="reflectance"> <string name="filename" value="{path.name}"/> </texture> </bsdf>'
        for path in sorted(tmp_path.glob("a.*"))
    )
    assert textures.count("<texture") == 6
    assert load_scene(scene(tmp_path, SENSOR + textures)).sensors()


@pytest.mark.parametrize(
    "content, words",
    [
        ("<scene", "is no XML file"),
        ("", "is no XML file"),
        ('<shape type="sphere"/>', "correct it"),
        ('<scene version="3.0.0"><shape type="sphere"></scene>', "mismatched tag"),
    ],
)
def test_other_files(content, words, tmp_path):
    (tmp_path / "a.xml").write_text(content, encoding="utf-8")
    with pytest.raises(UserError, match=words):
        load_scene(tmp_path / "a.xml")


def test_which_xml_files_are_scenes(tmp_path):
    assert is_scene_file(scene(tmp_path, SENSOR))
    (tmp_path / "cameras.xml").write_text('<?xml version="1.0"?><document><sensor id="0"/></document>')
    assert not is_scene_file(tmp_path / "cameras.xml")
    (tmp_path / "b.xml").write_text("nonsense")
    assert not is_scene_file(tmp_path / "b.xml")
