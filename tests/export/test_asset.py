"""mesh.glb and its companions, as trimesh and Khronos' validator read them."""

import json
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from fitted import RADIUS, color_at, open_sphere, write_fit

from gshell_mi import UserError
from gshell_mi.export import __main__ as command
from gshell_mi.export.asset import AssetConfig, _to_y_up, write_asset
from gshell_mi.export.atlas import unwrap
from gshell_mi.export.bake import openness, vertex_tangents
from gshell_mi.export.ply import FittedMesh, read_ply
from gshell_mi.export.remesh import triangle_quality
from gshell_mi.topology import topology

VALIDATOR = "gltf-validator@2.0.0-dev.3.10"


def bumpy(points: np.ndarray) -> np.ndarray:
    """Normals of a sphere with detail that no coarse mesh can hold."""
    normals = points / np.linalg.norm(points, axis=1, keepdims=True) + 0.15 * np.sin(12 * points)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    ball = open_sphere()
    return write_fit(tmp_path_factory.mktemp("fit"), replace(ball, normals=bumpy(ball.vertices)))


@pytest.fixture(scope="module")
def asset(fit):
    """The folder and what ``write_asset`` said, with a mesh coarser than the fitted one."""
    report = write_asset(fit, AssetConfig(face_count=1200, texture_size=256, obj=True, remesh=0.08))
    return fit, report


@pytest.fixture(scope="module")
def validate(tmp_path_factory):
    """Khronos' glTF validator: a function from a file to the list of its complaints."""
    if not shutil.which("node") or not shutil.which("npm"):
        pytest.skip("node and npm are not installed: the GLB is not validated")
    folder = tmp_path_factory.mktemp("validator")
    try:
        subprocess.run(
            ["npm", "install", "--silent", "--no-audit", "--no-fund", VALIDATOR],
            cwd=folder,
            check=True,
            capture_output=True,
            timeout=120,
        )
    except (subprocess.SubprocessError, OSError):
        pytest.skip("npm cannot install gltf-validator: the GLB is not validated")
    script = (
        "require('gltf-validator').validateBytes(new Uint8Array(require('fs').readFileSync("
        "process.argv[1]))).then(r => console.log(JSON.stringify(r.issues)))"
    )

    def run(path) -> dict:
        found = subprocess.run(["node", "-e", script, str(path)], cwd=folder, check=True, capture_output=True)
        return json.loads(found.stdout)

    return run


def welded(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh


def read_attributes(path, *names: str) -> list[np.ndarray]:
    """Arrays of shape (V, 3) of the first primitive, straight from the file."""
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    views = [document["bufferViews"][document["accessors"][attributes[name]]["bufferView"]] for name in names]
    return [
        np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"]).reshape(-1, 3)
        for view in views
    ]


def sample(image, uv: np.ndarray) -> np.ndarray:
    """Nearest texels in [0, 1] at uv as trimesh holds it, v upwards."""
    pixels = np.asarray(image, float)[..., :3] / 255
    column, row = (np.clip(x * len(pixels), 0, len(pixels) - 1).astype(int) for x in (uv[:, 0], 1 - uv[:, 1]))
    return pixels[row, column]


def on_surface(mesh: trimesh.Trimesh, count: int = 4000):
    """Points with their uv and shading normals."""
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
    blend = lambda values: np.einsum("nk,nkc->nc", weights, values[mesh.faces[faces]])  # noqa: E731
    return points, faces, weights, blend


def linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def test_no_complaint_of_the_validator(asset, validate):
    issues = validate(asset[0] / "mesh.glb")
    assert issues["numErrors"] == issues["numWarnings"] == 0, issues


def test_boundary_loops_are_those_of_the_mesh(asset):
    mesh, again = read_ply(asset[0] / "mesh.ply"), welded(trimesh.load(asset[0] / "mesh.glb", force="mesh"))
    before, after = topology(mesh.vertices, mesh.faces), topology(again.vertices, again.faces)
    assert after.boundary_length == pytest.approx(before.boundary_length, rel=1e-5)
    assert (after.boundary_loops, after.components, after.nonmanifold_edges) == (1, 1, 0)
    assert after.faces == asset[1]["faces"] < before.faces


def test_the_object_is_called_as_the_folder_is(asset):
    folder, _ = asset
    assert list(trimesh.load(folder / "mesh.glb").graph.nodes_geometry) == [folder.name]
    assert f"o {folder.name}\nusemtl {folder.name}\n" in (folder / "mesh.obj").read_text()
    assert f"newmtl {folder.name}\n" in (folder / "mesh.mtl").read_text()


def test_base_colour(asset):
    mesh = trimesh.load(asset[0] / "mesh.glb", force="mesh")
    points, _, _, blend = on_surface(mesh)
    found = linear(sample(mesh.visual.material.baseColorTexture, blend(np.asarray(mesh.visual.uv))))
    error = np.abs(found - color_at(points)).max(1)
    assert np.percentile(error, 99) < 0.03, "seams included"
    assert error.mean() < 0.005


def test_roughness_and_metallic(asset):
    mesh = trimesh.load(asset[0] / "mesh.glb", force="mesh")
    _, _, _, blend = on_surface(mesh)
    texture = sample(mesh.visual.material.metallicRoughnessTexture, blend(np.asarray(mesh.visual.uv)))
    np.testing.assert_allclose(texture[:, 1], 0.3, atol=1.5 / 255)
    np.testing.assert_allclose(texture[:, 2], 0.1, atol=1.5 / 255)
    assert texture[:, 0].mean() > 0.95, "hardly anything occludes the outside of a sphere"
    assert mesh.visual.material.doubleSided


def test_normal_texture_restores_the_fine_normals(asset):
    mesh = trimesh.load(asset[0] / "mesh.glb", force="mesh", process=False)
    points, _, _, blend = on_surface(mesh)
    uv, normals = np.asarray(mesh.visual.uv), np.asarray(mesh.vertex_normals)
    tangents = vertex_tangents(np.asarray(mesh.vertices), normals, np.asarray(mesh.faces), uv)
    local = 2 * sample(mesh.visual.material.normalTexture, blend(uv)) - 1
    bitangents = tangents[:, 3:] * np.cross(normals, tangents[:, :3])
    shaded = sum(
        local[:, i : i + 1] * blend(axis) for i, axis in enumerate((tangents[:, :3], bitangents, normals))
    )
    shaded /= np.linalg.norm(shaded, axis=1, keepdims=True)
    angle = np.degrees(np.arccos((shaded * bumpy(points)).sum(1).clip(-1, 1)))
    plain = np.degrees(np.arccos((blend(normals) * bumpy(points)).sum(1).clip(-1, 1)))
    assert np.median(plain) > 5
    assert np.median(angle) < 1 and np.percentile(angle, 95) < 4


def test_obj_is_welded_and_textured(asset):
    folder, report = asset
    mesh = trimesh.load(folder / "mesh.obj", force="mesh", process=False)
    assert len(mesh.faces) == report["faces"] and mesh.visual.uv is not None
    lines = (folder / "mesh.obj").read_text().splitlines()
    positions = [line for line in lines if line.startswith("v ")]
    assert len(set(positions)) == len(positions)
    for line in (folder / "mesh.mtl").read_text().splitlines():
        if ".png" in line:
            assert (folder / line.split()[1]).is_file()


def test_remeshed(asset):
    folder, report = asset
    mesh = read_ply(folder / "remeshed.ply")
    assert len(mesh.faces) == report["remeshed_faces"]
    assert triangle_quality(mesh.vertices, mesh.faces).min() >= report["remeshed_min_quality"] - 1e-3 >= 0.299
    np.testing.assert_allclose(mesh.attributes["color"], color_at(mesh.vertices), atol=0.02)
    assert topology(mesh.vertices, mesh.faces).boundary_loops == 1


def test_an_edge_length_that_does_not_suit_costs_nothing(tmp_path):
    write_fit(tmp_path, open_sphere(2))
    write_asset(tmp_path, AssetConfig(unwrap_seconds=0.0))
    before = (tmp_path / "mesh.glb").read_bytes()
    with pytest.raises(UserError, match="does not suit an object of size"):
        write_asset(tmp_path, AssetConfig(face_count=100, unwrap_seconds=0.0, remesh=50.0))
    assert (tmp_path / "mesh.glb").read_bytes() == before


def test_colours_at_the_vertices_without_an_atlas(tmp_path, validate):
    write_fit(tmp_path, open_sphere(2))
    report = write_asset(tmp_path, AssetConfig(unwrap_seconds=0.0, obj=True))
    assert report["charts"] == 0 and (tmp_path / "mesh.obj").is_file()
    assert validate(tmp_path / "mesh.glb")["numErrors"] == 0
    points, colors = read_attributes(tmp_path / "mesh.glb", "POSITION", "COLOR_0")
    np.testing.assert_allclose(colors, color_at(points), atol=1e-3)  # linear, as glTF has it


@pytest.mark.parametrize("axis", range(6))
def test_up_becomes_y(axis, tmp_path):
    up = np.concatenate([np.eye(3), -np.eye(3)])[axis]
    turn = _to_y_up(axis)
    np.testing.assert_allclose(turn @ up, [0, 1, 0])
    assert np.linalg.det(turn) == pytest.approx(1) and np.allclose(turn @ turn.T, np.eye(3))
    ball = open_sphere(2)
    moved = FittedMesh(ball.vertices @ turn, ball.faces, ball.normals @ turn, ball.attributes)
    write_fit(tmp_path, moved, up=up)
    write_asset(tmp_path, AssetConfig(unwrap_seconds=0.0))
    found = trimesh.load(tmp_path / "mesh.glb", force="mesh")
    assert found.bounds[1][1] < 0.4 and found.bounds[0][1] == pytest.approx(-RADIUS, abs=0.01), "open at +y"


def test_openness_of_a_bowl():
    """At the bottom of the inner side only the opening is seen: its cosine-weighted solid angle."""
    ball = open_sphere(4)
    inward = FittedMesh(ball.vertices, ball.faces[:, ::-1], -ball.normals, ball.attributes)
    bottom = ball.vertices[:, 1].argmin()
    rim = ball.vertices[:, 1].max()
    # A disc on the axis, seen from the pole: sin² of its half-angle.
    radius = np.sqrt(RADIUS**2 - rim**2)
    expected = radius**2 / (radius**2 + (rim + RADIUS) ** 2)
    neighbours = np.linalg.norm(ball.vertices - ball.vertices[bottom], axis=1) < 0.1
    assert openness(inward)[neighbours].mean() == pytest.approx(expected, abs=0.04)
    assert openness(ball).min() > 0.95


def test_atlas_covers_every_face_without_overlap():
    ball = open_sphere(3)
    atlas = unwrap(ball.vertices, ball.faces, texture_size=256)
    np.testing.assert_array_equal(atlas.source[atlas.faces], ball.faces)
    assert 0 <= atlas.uv.min() and atlas.uv.max() <= 1
    a, b, c = (atlas.uv[atlas.faces[:, i]] for i in range(3))
    (x1, y1), (x2, y2) = (b - a).T, (c - a).T
    area = np.abs(x1 * y2 - x2 * y1) / 2
    assert (area > 0).mean() > 0.999
    # Were triangles to overlap, fewer texels would be covered than their areas add up to.
    size = 1024
    covered = np.zeros((size, size), int)
    for t in atlas.uv[atlas.faces] * size:
        low, high = np.floor(t.min(0)).astype(int), np.ceil(t.max(0)).astype(int)
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        edge = [
            (t[(i + 1) % 3, 0] - t[i, 0]) * (y - t[i, 1]) - (t[(i + 1) % 3, 1] - t[i, 1]) * (x - t[i, 0])
            for i in range(3)
        ]
        inside = np.all(np.array(edge) > 0, 0) | np.all(np.array(edge) < 0, 0)
        covered[low[1] : high[1], low[0] : high[0]] += inside
    assert covered.max() == 1


def test_command(fit, capsys):
    assert command.main([str(fit), "--texture-size", "64", "--face-count", "600"]) == 0
    assert "faces" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((), "does not exist; give the folder of a finished fit"),
        (("--texture-size", "0"), "--texture-size must be at least 16 pixels"),
        (("--face-count", "-1"), "--face-count must not be negative"),
        (("--min-quality", "1.5"), "--min-quality lies between 0 and 1"),
        (("--texture-size", "1000000"), "GiB are free; lower --texture-size"),
        (("--unwrap-seconds", "nan"), "--unwrap-seconds lies between 0 and"),
    ],
)
def test_mistakes(tmp_path, capsys, arguments, message):
    assert command.main([str(tmp_path / "none"), *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1


def test_empty_mesh(tmp_path):
    empty = FittedMesh(
        np.zeros((0, 3)),
        np.zeros((0, 3), int),
        np.zeros((0, 3)),
        {"color": np.zeros((0, 3)), "roughness": np.zeros(0), "metallic": np.zeros(0)},
    )
    write_fit(tmp_path, empty)
    with pytest.raises(UserError, match="is empty; there is nothing to export"):
        write_asset(tmp_path)


def test_a_damaged_scene_leaves_nothing_behind(tmp_path):
    write_fit(tmp_path, open_sphere(2), views=1)
    (tmp_path / "scene.xml").write_text("<scene")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(UserError, match=r"scene\.xml' cannot be loaded"):
        write_asset(tmp_path)
    assert sorted(tmp_path.iterdir()) == before
