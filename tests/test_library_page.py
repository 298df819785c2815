"""The examples of docs/library.md run, in their order, on small sizes."""

import re
from pathlib import Path

import drjit as dr
import pytest
import trimesh
import tyro
from bowl import SHORT

from gshell_mi.fit import FitConfig

PAGE = Path(__file__).parents[1] / "docs" / "library.md"

#: What makes the examples quick; each has to be there.
SMALLER = {
    "TetLattice(64)": "TetLattice(24)",
    "TetLattice(48)": "TetLattice(16)",
    "spp=64": "spp=8",
    '"width": 96, "height": 96': '"width": 32, "height": 32',
    ":48]": ":16]",
    '"resolution": 32': '"resolution": 12',
    "range(100)": "range(8)",
}


def short_config() -> FitConfig:
    """The options of a short fit, as settings."""
    return tyro.cli(FitConfig, args=[option for option in SHORT if option != "--no-report"])


def example(number: int, variant: str) -> str:
    code = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.M | re.S)[number]
    return code.replace("llvm_ad_rgb", variant)


@pytest.fixture(scope="module")
def done(variant, tmp_path_factory) -> tuple[dict, Path]:
    """The names that all examples but that of the fit leave behind, and the folder that they ran in."""
    code = "".join(example(number, variant) for number in range(5))
    for large, small in SMALLER.items():
        assert large in code, f"the page no longer says {large}"
        code = code.replace(large, small)
    folder, names = tmp_path_factory.mktemp("library"), {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(compile(code, str(PAGE), "exec"), names)
    return names, folder


def test_extraction_example(done):
    names, folder = done
    bowl = trimesh.load(folder / "bowl.ply")
    assert not bowl.is_watertight and abs(bowl.bounds[1][1] - 0.2) < 1e-4
    assert names["rises"].numpy().max() > 0


def test_gradient_has_the_sign_that_the_page_tells(done):
    assert done[0]["to_the_right"].numpy().size == 1
    assert dr.grad(done[0]["to_the_right"])[0] < 0


def test_optimisation_lowers_the_loss(done):
    names, folder = done
    assert names["losses"][-1] < names["losses"][0]
    assert len(trimesh.load(folder / "from_one_picture.ply").faces)


def test_fields_of_the_mesh_are_open(done):
    shape = done[0]["shape"]
    assert shape.surface.face_count > 0 and not shape.surface.to_trimesh().is_watertight


@pytest.mark.slow
def test_fit_example(bowl_scene, tmp_path, variant):
    names = {"config": short_config()}
    code = example(5, variant)
    for said, here in {
        '"scenes/tshirt.xml"': repr(str(bowl_scene)),
        '"out/first"': repr(str(tmp_path / "out")),
        "config=FitConfig()": "config=config, report=False",
    }.items():
        assert said in code
        code = code.replace(said, here)
    exec(compile(code, str(PAGE), "exec"), names)
    assert (tmp_path / "out" / "mesh.ply").exists() and names["result"].metrics["psnr_training"] > 10
