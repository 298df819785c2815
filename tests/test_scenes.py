"""Facts about the committed scenes: the truth's topology, what the sensors see, what stock Mitsuba loads."""

import xml.etree.ElementTree as ET
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh

import gshell_mi  # noqa: F401  (registers the gshell shape)

SCENES = Path(__file__).parents[1] / "scenes"
#: name: boundary loops, genus, components
TRUTH = {
    "basket": (1, 3, 1),
    "bowl": (1, 0, 1),
    "bunny": (0, 1, 1),
    "chair": (1, 2, 1),
    "lace": (15, 0, 4),
    "leaf": (1, 0, 1),
    "mug": (0, 1, 1),
    "skirt": (2, 0, 1),
    "tshirt": (4, 0, 1),
    "vase": (1, 0, 1),
}
#: Scenes without views from below.
FROM_ABOVE = {"chair"}


@pytest.fixture(scope="module", params=TRUTH)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def truth(name):
    return trimesh.load(SCENES / name / "truth.ply", process=False)


@pytest.fixture(scope="module")
def reference(name):
    return mi.load_file(str(SCENES / name / "reference.xml"))


def test_the_list_is_complete():
    assert {p.stem for p in SCENES.glob("*.xml")} == set(TRUTH)


def boundary_loops(mesh):
    """Every boundary vertex has one boundary edge in and one out; counts the cycles they form."""
    directed = mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    assert len(np.unique(directed[:, 0])) == len(np.unique(directed[:, 1])) == len(directed)
    following, loops = dict(directed.tolist()), 0
    while following:
        loops += 1
        start, at = following.popitem()
        while at != start:
            at = following.pop(at)
    return loops


def test_topology(name, truth):
    loops, genus, components = TRUTH[name]
    _, count = np.unique(truth.edges_sorted, axis=0, return_counts=True)
    assert count.max() == 2, "edge-manifold"
    _, count = np.unique(truth.edges, axis=0, return_counts=True)
    assert count.max() == 1, "consistently oriented"
    assert len(np.unique(truth.vertices, axis=0)) == len(truth.vertices), "no duplicate vertices"
    assert len(np.unique(truth.faces)) == len(truth.vertices), "no unreferenced vertices"
    assert truth.area_faces.min() > 1e-9
    assert truth.body_count == components
    assert boundary_loops(truth) == loops
    assert truth.euler_number == 2 * components - 2 * genus - loops
    assert (SCENES / name / "truth.ply").stat().st_size < 2**20


def crossing_edges(mesh):
    """Edges that cut through a triangle which holds neither of their ends, by rays along the edges."""
    params = mi.Properties()
    shape = mi.Mesh("truth", len(mesh.vertices), len(mesh.faces), props=params)
    p = mi.traverse(shape)
    p["vertex_positions"] = np.asarray(mesh.vertices, np.float32).ravel()
    p["faces"] = np.asarray(mesh.faces, np.uint32).ravel()
    p.update()
    scene = mi.load_dict({"type": "scene", "truth": shape})
    edges = mesh.edges_unique
    crossing = np.zeros(len(edges), bool)
    for ends in (edges, edges[:, ::-1]):
        a, b = (np.asarray(mesh.vertices)[e] for e in ends.T)
        length = np.linalg.norm(b - a, axis=1, keepdims=True)
        d = (b - a) / length
        # Off the ends, where the ray meets the triangles it belongs to.
        ray = mi.Ray3f(mi.Point3f((a + 0.01 * length * d).T), mi.Vector3f(d.T))
        ray.maxt = mi.Float((0.98 * length).ravel())
        hit = scene.ray_intersect_preliminary(ray)
        face = np.array(hit.prim_index)
        valid = np.array(hit.is_valid())
        own = np.zeros(len(ends), bool)
        own[valid] = (mesh.faces[face[valid]][:, :, None] == ends[valid][:, None, :]).any((1, 2))
        crossing |= valid & ~own
    return int(crossing.sum())


def test_no_self_intersection(truth):
    assert crossing_edges(truth) == 0


def test_self_intersection_is_seen():
    box = trimesh.creation.box((1, 1, 1))
    assert crossing_edges(box) == 0
    both = trimesh.util.concatenate([box, trimesh.creation.box((0.5, 0.4, 2.0))])
    assert crossing_edges(both) > 0


def test_truth_lies_in_the_lattice_box(truth):
    assert np.abs(truth.bounds).max() <= 0.95
    assert np.abs(truth.bounds).max() >= 0.8, "and fills it"


def test_colours_are_reflectances(reference):
    color = np.array(mi.traverse(reference)["subject.vertex_color"])
    assert color.min() >= 0 and color.max() <= 1
    assert np.ptp(color.reshape(-1, 3), axis=0).max() > 0.2, "more than one colour"


def test_light_is_finite_and_never_black(name):
    light = np.array(mi.Bitmap(str(SCENES / name / "light.exr")), dtype=np.float32)
    assert light.shape == (64, 128, 3)
    assert np.isfinite(light).all() and light.min() > 0


def test_fit_scene_follows_the_contract(name):
    root = ET.parse(SCENES / f"{name}.xml").getroot()
    assert [s.get("type") for s in root.iter("shape")] == ["gshell"]
    assert [e.get("id") for e in root.iter("emitter")] == ["light"]
    (include,) = root.iter("include")
    sensors = ET.parse(SCENES / include.get("filename")).getroot()
    assert [s.get("id") for s in sensors.iter("sensor")] == [f"view_{i:03}" for i in range(48)]


def test_fit_scene_loads(name):
    scene = mi.load_file(str(SCENES / f"{name}.xml"))
    params = mi.traverse(scene)
    assert {"subject.sdf", "subject.msdf", "subject.deform"} <= set(params.keys())
    assert len(scene.sensors()) == 48


def test_reference_has_the_same_sensors(name, reference):
    assert [s.id() for s in reference.sensors()] == [f"view_{i:03}" for i in range(48)]
    test = mi.load_file(str(SCENES / name / "test.xml")).sensors()
    assert [s.id() for s in test] == [f"test_{i:03}" for i in range(12)]

    def origins(sensors):
        return np.array([np.ravel(s.world_transform().translation()) for s in sensors])

    o, t = origins(reference.sensors()), origins(test)
    assert o[:, 1].max() > 2
    if name in FROM_ABOVE:
        assert o[:, 1].min() > 0 and t[:, 1].min() > 0
    else:
        assert o[:, 1].min() < -2, "from above and from below"
    between = np.linalg.norm(o[None] - t[:, None], axis=-1).min(1)
    assert between.min() > 0.05 * np.linalg.norm(o[0]), "test views are new views"


def test_sensors_see_the_whole_object(truth, reference):
    for sensor in reference.sensors():
        to_camera = np.array(sensor.world_transform().inverse().matrix).reshape(4, 4)
        p = np.asarray(truth.vertices) @ to_camera[:3, :3].T + to_camera[:3, 3]
        assert np.abs(p[:, :2] / p[:, 2:]).max() < np.tan(np.radians(21))


def test_reference_renders(reference):
    for k in (0, 20, 47):
        image = np.array(mi.render(reference, sensor=k, spp=4, seed=k))
        assert image.shape == (256, 256, 4) and np.isfinite(image).all()
        alpha = image[..., 3]
        rim = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
        assert 0.05 < alpha.mean() < 0.8 and rim.max() == 0
        assert image[..., :3][alpha > 0.9].mean() > 0.02
