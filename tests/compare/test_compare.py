"""The compare command: fits, folders, files and meshes; and every mistake in one sentence."""

import json
import shutil
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from fitted import RADIUS, open_sphere, write_fit
from PIL import Image

from gshell_mi.compare.__main__ import main
from gshell_mi.export.ply import read_ply, write_ply

VIEWS, SIZE = 2, 32


@pytest.fixture(scope="module")
def sphere(tmp_path_factory):
    """A fit, its targets (rendered from itself), and targets under half the light."""
    folder = write_fit(tmp_path_factory.mktemp("fit"), open_sphere(3), views=VIEWS, size=SIZE)
    targets, dim = (tmp_path_factory.mktemp(name) for name in ("targets", "dim"))
    scene = mi.load_file(str(folder / "scene.xml"))
    for number, sensor in enumerate(scene.sensors()):
        image = np.array(mi.render(scene, sensor=sensor, spp=256, seed=100 + number))
        for place, factor in ((targets, 1.0), (dim, 0.5)):
            pixels = (image * [factor, factor, factor, 1]).astype(np.float32)
            mi.Bitmap(pixels, mi.Bitmap.PixelFormat.RGBA).write(str(place / f"{sensor.id()}.exr"))
    (folder / "metrics.json").write_text(json.dumps({"targets": str(targets)}))
    return SimpleNamespace(folder=folder, targets=targets, dim=dim)


def scores(*arguments, tmp_path) -> dict:
    out = tmp_path / "scores.json"
    assert main([*map(str, arguments), "--json", str(out)]) == 0
    return json.loads(out.read_text())


def test_fit_against_its_targets(sphere, tmp_path, capsys):
    found = scores(
        sphere.folder, "-o", tmp_path / "errors", "--mesh", sphere.folder / "mesh.ply", tmp_path=tmp_path
    )
    assert set(found["views"]) == {"view_000", "view_001"}
    assert found["mean"]["psnr"] > 30 and found["mean"]["mask_iou"] > 0.97
    assert found["mesh"]["boundary_loops"] == {"found": 1, "reference": 1}
    picture = Image.open(tmp_path / "errors" / "view_000.png")
    assert picture.size == (3 * SIZE, SIZE)
    shown = capsys.readouterr().out
    assert "view_001" in shown and "boundary_loops" in shown


def test_relighting_is_scored_raw_and_scaled(sphere, tmp_path):
    """Targets half as bright: the albedo's factor is 1/2, and only the scaled score is high."""
    found = scores(
        sphere.folder, "--envmap", sphere.folder / "light.exr", "--targets", sphere.dim, tmp_path=tmp_path
    )
    np.testing.assert_allclose(found["albedo_scale"], 0.5, rtol=0.02)
    assert found["mean_albedo_scaled"]["psnr"] > 30 > 25 > found["mean"]["psnr"]


def test_files_and_folders(sphere, tmp_path):
    whole = scores(sphere.targets, sphere.dim, tmp_path=tmp_path)
    one = scores(sphere.targets / "view_000.exr", sphere.dim / "view_000.exr", tmp_path=tmp_path)
    assert one["mean"] == one["views"]["view_000"] == whole["views"]["view_000"]
    assert whole["mean"]["psnr"] == pytest.approx(np.mean([view["psnr"] for view in whole["views"].values()]))


def test_maps_beside_targets_are_no_images(sphere, tmp_path):
    both = [shutil.copytree(folder, tmp_path / folder.name) for folder in (sphere.targets, sphere.dim)]
    for folder in both:
        for kind in ("known", "depth"):
            mi.Bitmap(np.ones((SIZE, SIZE, 1), np.float32)).write(str(folder / f"view_000.{kind}.exr"))
    assert set(scores(*both, tmp_path=tmp_path)["views"]) == {"view_000", "view_001"}


def test_what_is_unknown_of_a_target_is_not_held_against_the_fit(sphere, tmp_path):
    targets = shutil.copytree(sphere.targets, tmp_path / "targets")
    known = np.ones((SIZE, SIZE, 1), np.float32)
    known[:, : SIZE // 2] = 0
    for view in sphere.targets.iterdir():
        pixels = np.array(mi.Bitmap(str(view)))
        pixels[:, : SIZE // 2] = 0
        mi.Bitmap(pixels, mi.Bitmap.PixelFormat.RGBA).write(str(targets / view.name))
    spoilt = scores(sphere.folder, "--targets", targets, tmp_path=tmp_path)["mean"]
    for view in sphere.targets.iterdir():
        mi.Bitmap(known).write(str(targets / f"{view.stem}.known.exr"))
    told = scores(sphere.folder, "--targets", targets, tmp_path=tmp_path)["mean"]
    assert told["psnr"] > 30 > spoilt["psnr"] and told["mask_iou"] > 0.97 > 0.6 > spoilt["mask_iou"]


def test_a_fit_is_exposed_as_its_targets_were(sphere, tmp_path):
    folder = shutil.copytree(sphere.folder, tmp_path / "fit")
    metrics = {"targets": str(sphere.dim)}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    assert scores(folder, tmp_path=tmp_path)["mean"]["psnr"] < 25
    gains = {f"view_{number:03}": [0.5, 0.5, 0.5] for number in range(VIEWS)}
    (folder / "metrics.json").write_text(json.dumps(metrics | {"exposures": {"gains": gains}}))
    assert scores(folder, tmp_path=tmp_path)["mean"]["psnr"] > 30


def test_a_light_that_turns_with_the_camera_turns(sphere, tmp_path):
    """The first view is lit as before; of the second, lit so as the first is, the light has turned."""
    folder = shutil.copytree(sphere.folder, tmp_path / "fit")
    sky = np.full((8, 16, 3), 0.1, np.float32)
    sky[:, :4] = 4
    mi.Bitmap(sky).write(str(folder / "light.exr"))
    targets = tmp_path / "targets"
    targets.mkdir()
    scene = mi.load_file(str(folder / "scene.xml"))
    for sensor in scene.sensors():
        mi.Bitmap(np.array(mi.render(scene, sensor=sensor, spp=64)), mi.Bitmap.PixelFormat.RGBA).write(
            str(targets / f"{sensor.id()}.exr")
        )
    found = []
    for frame in ("world", "camera"):
        (folder / "metrics.json").write_text(json.dumps({"targets": str(targets), "light_frame": frame}))
        views = scores(folder, tmp_path=tmp_path)["views"]
        found.append([view["psnr"] for view in views.values()])
    world, camera = found
    assert camera[0] == pytest.approx(world[0], abs=0.5) and camera[1] < world[1] - 3


def test_images_that_show_the_object_nowhere_alike(tmp_path, capsys):
    for name, half in (("a.exr", slice(8)), ("b.exr", slice(8, 16))):
        pixels = np.zeros((16, 16, 4), np.float32)
        pixels[half] = 1
        mi.Bitmap(pixels, mi.Bitmap.PixelFormat.RGBA).write(str(tmp_path / name))
    found = scores(tmp_path / "a.exr", tmp_path / "b.exr", tmp_path=tmp_path)
    assert found["mean"]["psnr_inside"] is None and found["mean"]["mask_iou"] == 0
    assert "–" in capsys.readouterr().out


def test_meshes(sphere, tmp_path):
    found = scores(sphere.folder / "mesh.ply", sphere.folder / "template.ply", tmp_path=tmp_path)
    assert found["mesh"]["f_score"] == 1


def test_other_sensors(sphere, tmp_path):
    found = scores(
        sphere.folder,
        "--sensors",
        sphere.folder / "scene.xml",
        "--targets",
        sphere.targets,
        tmp_path=tmp_path,
    )
    assert found["mean"]["psnr"] > 30


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("{none}",), "does not exist; check the path"),
        (("{mesh}",), "is compared with nothing; give the reference after it"),
        (("{empty}",), "holds no fit (scene.xml is missing)"),
        (("{fit}", "--spp", "0"), "--spp must be at least 1"),
        (("{fit}", "--sensors", "{none}"), "give their images with --targets"),
        (("{fit}", "--sensors", "{none}", "--targets", "{empty}"), "does not exist; check the path"),
        (("{fit}", "--targets", "{empty}"), "view_000.exr' is missing"),
        (("{fit}", "--envmap", "{none}", "--targets", "{targets}"), "does not exist; check the path"),
        (("{fit}", "--envmap", "{text}", "--targets", "{targets}"), "cannot be read"),
        (("{fit}", "--mesh", "{none}"), "does not exist; check the path"),
        (("{fit}", "--mesh", "{text}"), "cannot be read"),
        (("{fit}", "--variant", "scalar_rgb"), "is not usable"),
        (("{fit}", "--spp", "10000000000"), "GiB are free; lower --spp"),
        (("{targets}", "{none}"), "does not exist; check the path"),
        (("{targets}", "{targets}/view_000.exr"), "are a folder and a file"),
        (("{targets}", "{empty}"), "have no EXR files of the same name"),
        (("{mesh}", "{targets}"), "only one is a mesh"),
        (("{targets}", "{targets}", "--mesh", "{mesh}"), "--mesh is for fits only"),
        (("{targets}/view_000.exr", "{fit}/scene.xml"), "cannot be read"),
        (("{targets}/view_000.exr", "{fit}/light.exr"), "only images of one size"),
        (("{targets}", "{dim}", "--json", "{none}/a/b.json"), "cannot be written"),
        (("{targets}", "{dim}", "--json", "/dev/full/a"), "'/dev/full/a' cannot be written"),
        (
            ("{targets}/view_000.exr", "{dim}/view_000.exr", "--json", "{dim}/view_000.exr"),
            "was not written by",
        ),
    ],
)
def test_mistakes(sphere, tmp_path, capsys, arguments, message):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.ply").write_text("no mesh")
    places = {
        "none": tmp_path / "none",
        "empty": tmp_path / "empty",
        "text": tmp_path / "text.ply",
        "fit": sphere.folder,
        "mesh": sphere.folder / "mesh.ply",
        "targets": sphere.targets,
        "dim": sphere.dim,
    }
    assert main([argument.format(**places) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1


def test_what_no_comparison_wrote_is_left_alone(sphere, tmp_path, capsys):
    """Metrics of a fit, photographs beside images; but files of an earlier comparison are replaced."""
    images = shutil.copytree(sphere.dim, tmp_path / "images")
    metrics, photograph = tmp_path / "metrics.json", images / "view_001.png"
    metrics.write_text('{"targets": "x"}')
    Image.new("RGB", (4, 4)).save(photograph)
    before = photograph.read_bytes()
    given = [str(sphere.targets), str(sphere.dim)]
    for options, file in ((("--json", metrics), metrics), (("-o", images), photograph)):
        assert main([*given, *map(str, options)]) == 2
        assert f"'{file}' exists and was not written by gshell_mi" in capsys.readouterr().err
    assert metrics.read_text() == '{"targets": "x"}' and photograph.read_bytes() == before
    assert not (images / "view_000.png").exists()
    for _ in range(2):
        own = "--json", str(tmp_path / "own.json"), "-o", str(tmp_path / "errors")
        assert main([*given, *own]) == 0


def test_ids_of_a_fit_do_not_leave_the_folder(sphere, tmp_path, capsys):
    folder = shutil.copytree(sphere.folder, tmp_path / "fit")
    scene = (folder / "scene.xml").read_text()
    (folder / "scene.xml").write_text(scene.replace('"view_000"', '"../../escaped"'))
    (tmp_path / "a" / "b").mkdir(parents=True)
    shutil.copy(sphere.targets / "view_000.exr", tmp_path / "escaped.exr")
    shutil.copy(sphere.targets / "view_001.exr", tmp_path / "a" / "b")
    assert main([str(folder), "--targets", str(tmp_path / "a" / "b"), "-o", str(tmp_path / "c" / "d")]) == 2
    assert "has a '/', so no error image can have it" in capsys.readouterr().err
    assert not (tmp_path / "escaped.png").exists() and not (tmp_path / "c").exists()


def test_fit_that_does_not_know_its_targets(sphere, tmp_path, capsys):
    folder = write_fit(tmp_path, open_sphere(2), views=1)
    assert main([str(folder)]) == 2
    assert "does not tell where the targets are" in capsys.readouterr().err


def test_sphere_is_what_it_claims():
    assert np.linalg.norm(open_sphere(3).vertices, axis=1) == pytest.approx(RADIUS)


def test_images_without_a_partner_are_named(sphere, tmp_path, capsys):
    """And a suffix in another case is no other name."""
    ours, theirs = (shutil.copytree(sphere.targets, tmp_path / name) for name in ("ours", "theirs"))
    (ours / "view_001.exr").unlink()
    (theirs / "view_000.exr").rename(theirs / "view_000.EXR")
    found = scores(ours, theirs, tmp_path=tmp_path)
    assert list(found["views"]) == ["view_000"]
    assert found["unmatched"] == [str(theirs / "view_001.exr")]
    assert "1 image without a partner of the same name not compared" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["[", "[" * 100_000, "5", '{"targets": 5}', '{"targets": null}', "\ud800"])
def test_metrics_that_do_not_tell_the_targets(text, sphere, tmp_path, capsys):
    folder = shutil.copytree(sphere.folder, tmp_path / "fit")
    (folder / "metrics.json").write_bytes(text.encode(errors="surrogatepass"))
    assert main([str(folder)]) == 2
    assert "does not tell where the targets are" in capsys.readouterr().err


def test_meshes_that_are_damaged(sphere, tmp_path, capsys):
    mesh = read_ply(sphere.folder / "mesh.ply")
    for spoilt in (mesh.faces + 10**6, mesh.faces * 0):
        write_ply(tmp_path / "a.ply", mesh.vertices, spoilt, mesh.normals, mesh.attributes)
        assert main([str(tmp_path / "a.ply"), str(sphere.folder / "mesh.ply")]) == 2
        assert capsys.readouterr().err.startswith(f"error: Mesh '{tmp_path / 'a.ply'}' ")
