"""The material's parameters: what goes in comes out, within the ranges of reflectance and roughness."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.material import ATTRIBUTES, ROUGHNESS_RANGE, MaterialField, given_material, principled


@pytest.fixture
def color() -> np.ndarray:
    return np.random.default_rng(3).uniform(0.02, 0.98, (50, 3)).astype(np.float32)


def test_round_trip(color):
    values = MaterialField(color, roughness=0.3, metallic=0.4).values()
    assert set(values) == set(ATTRIBUTES) == {"vertex_color", "vertex_roughness", "vertex_metallic"}
    np.testing.assert_allclose(values["vertex_color"].numpy().reshape(-1, 3), color, atol=1e-6)
    np.testing.assert_allclose(values["vertex_roughness"].numpy(), np.full(50, 0.3), atol=1e-6)
    np.testing.assert_allclose(values["vertex_metallic"].numpy(), np.full(50, 0.4), atol=1e-6)


def test_saturated_values_can_still_move():
    material = MaterialField(np.array([[0.0, 1.0, 5.0]]), roughness=1, metallic=0)
    values = material.values()
    np.testing.assert_allclose(values["vertex_color"].numpy(), [0.02, 0.98, 0.98], atol=1e-6)
    for name, logits in material.parameters.items():
        assert np.abs(logits.numpy()).max() < 4, name


@pytest.mark.parametrize("logit", [-80.0, 0.0, 80.0])
def test_values_stay_in_range_whatever_the_logits(color, logit):
    material = MaterialField(color)
    for name, old in material.parameters.items():
        material.parameters[name] = dr.full(mi.Float, logit, dr.width(old))
    for name, values in material.values().items():
        low, high = ROUGHNESS_RANGE if name == "vertex_roughness" else (0, 1)
        expected = {-80: low, 0: (low + high) / 2, 80: high}[logit]
        np.testing.assert_allclose(values.numpy(), expected, atol=1e-6)


def test_derivative(color):
    material = MaterialField(color)
    dr.enable_grad(material.parameters)
    dr.backward(dr.sum(material.values()["vertex_color"]))
    expected = (color * (1 - color)).ravel()
    np.testing.assert_allclose(dr.grad(material.parameters["vertex_color"]).numpy(), expected, atol=1e-5)


def test_gloss_has_a_part_that_all_vertices_share(color):
    material = MaterialField(color, roughness=0.5, metallic=0.5)
    before = material.values()
    material.parameters["shared_metallic"] = mi.Float([1.0])
    after = material.values()
    np.testing.assert_allclose(after["vertex_metallic"].numpy(), 1 / (1 + np.exp(-1)), atol=1e-6)
    for name in ("vertex_color", "vertex_roughness"):
        np.testing.assert_array_equal(after[name].numpy(), before[name].numpy())
    assert set(material.on_lattice) == set(ATTRIBUTES), "they have a value per vertex, what is shared has not"


def test_what_is_shared_hears_every_vertex(color):
    material = MaterialField(color, metallic=0.5)
    dr.enable_grad(material.parameters)
    weight = np.arange(50, dtype=np.float32)
    dr.backward(dr.sum(mi.Float(weight) * material.values()["vertex_metallic"]))
    own, shared = (dr.grad(material.parameters[f"{name}_metallic"]).numpy() for name in ("vertex", "shared"))
    np.testing.assert_allclose(own, weight / 4, rtol=1e-5)
    np.testing.assert_allclose(shared, [own.sum()], rtol=1e-5)


def test_one_colour_for_all():
    values = MaterialField(np.zeros((4, 3)), base_color=np.array([0.2, 0.4, 0.6])).values()
    np.testing.assert_allclose(values["vertex_color"].numpy(), 4 * [0.2, 0.4, 0.6], atol=1e-6)


@pytest.mark.parametrize("twosided", [False, True])
def test_material_given_by_a_scene(twosided):
    bsdf = {
        "type": "principled",
        "base_color": {"type": "rgb", "value": [0.2, 0.4, 0.6]},
        "roughness": 0.3,
        "metallic": 0.7,
    }
    given = given_material(mi.load_dict({"type": "twosided", "bsdf": bsdf} if twosided else bsdf))
    np.testing.assert_allclose(given.pop("base_color"), [0.2, 0.4, 0.6], atol=1e-6)
    assert given == pytest.approx({"roughness": 0.3, "metallic": 0.7})


def test_no_material_given():
    assert given_material(mi.load_dict({"type": "diffuse"})) == {}


def test_the_bsdf_reads_the_attributes():
    """A grey-lit quad looks like its base colour, from either side."""
    mesh = mi.Mesh("quad", 4, 2)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0])
    parameters["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    parameters.update()
    values = MaterialField(np.full((4, 3), [0.8, 0.4, 0.1]), roughness=0.5, metallic=0.02).values()
    for name, field in values.items():
        mesh.add_attribute(name, 3 if name == "vertex_color" else 1, field)
    mesh.set_bsdf(mi.load_dict(principled()))
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    for z, d in ((1.0, -1.0), (-1.0, 1.0)):
        si = scene.ray_intersect(mi.Ray3f([0.2, 0.1, z], [0, 0, d]))
        wo = mi.warp.square_to_cosine_hemisphere(mi.Point2f(0.3, 0.2))
        wo.z = dr.select(si.wi.z > 0, wo.z, -wo.z)
        seen = np.ravel(si.bsdf().eval(mi.BSDFContext(), si, wo))
        assert seen.min() > 0, "either side reflects"
        assert seen[0] > 1.5 * seen[1] > 1.5 * seen[2], "in the colour of the attribute"
