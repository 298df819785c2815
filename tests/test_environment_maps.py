"""Environment maps that would poison a render, in every place that takes one."""

import mitsuba as mi
import numpy as np
import pytest
from bowl import write_scene
from fitted import open_sphere, write_fit

from gshell_mi.environment_maps import environment_emitter, read_environment_map
from gshell_mi.errors import UserError
from gshell_mi.export.fitted_scene import load_fitted_scene
from gshell_mi.scene import load_fit_scene


@pytest.fixture
def spoilt(tmp_path):
    """A map with infinity at column 5, row 3."""
    radiance = np.ones((8, 16, 3), np.float32)
    radiance[3, 5] = np.inf
    mi.Bitmap(radiance).write(str(tmp_path / "sun.exr"))
    return tmp_path / "sun.exr"


def test_values_come_back(tmp_path):
    radiance = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    mi.Bitmap(radiance).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_environment_map(tmp_path / "a.exr", "Map"), radiance)
    mi.Bitmap(radiance[..., :1]).write(str(tmp_path / "grey.exr"))
    np.testing.assert_array_equal(
        read_environment_map(tmp_path / "grey.exr", "Map"), np.repeat(radiance[..., :1], 3, axis=-1)
    )
    assert environment_emitter(tmp_path / "a.exr", "Map").is_environment()


def test_light_of_a_relit_fit(spoilt, tmp_path):
    folder = tmp_path / "fit"
    folder.mkdir()
    write_fit(folder, open_sphere(1), views=2, size=8)
    with pytest.raises(UserError, match=r"column 5, row 3"):
        load_fitted_scene(folder, spoilt)


def test_light_of_a_scene(spoilt, tmp_path):
    scene = write_scene(tmp_path / "scene")
    text = scene.read_text(encoding="utf-8")
    scene.write_text(
        text.replace(
            '<emitter type="constant" id="light"/>',
            f'<emitter type="envmap" id="light"> <string name="filename" value="{spoilt}"/> </emitter>',
        ),
        encoding="utf-8",
    )
    with pytest.raises(UserError, match=r"column 5, row 3"):
        load_fit_scene(scene)
    scene.write_text(
        text.replace(
            '<emitter type="constant" id="light"/>',
            '<emitter type="constant" id="light"> <rgb name="radiance" value="nan"/> </emitter>',
        ),
        encoding="utf-8",
    )
    with pytest.raises(UserError):
        load_fit_scene(scene)


def test_missing_or_no_image(tmp_path):
    with pytest.raises(UserError, match=r"Map .* does not exist"):
        read_environment_map(tmp_path / "a.exr", "Map")
    (tmp_path / "a.exr").write_text("nonsense")
    with pytest.raises(UserError, match="cannot be read as an image"):
        read_environment_map(tmp_path / "a.exr", "Map")
