"""Colour finer than a lattice: where it is, that it moves along, and its derivatives in a render."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from gshell_mi.color_detail import ColorDetail
from gshell_mi.material import principled

_SIDE = 64


@pytest.fixture
def sphere() -> mi.Shape:
    shape = mi.load_dict({"type": "gshell", "resolution": 24})
    count = shape.lattice.vertex_count
    for name, value, channels in (("color", 0.5, 3), ("roughness", 0.5, 1), ("metallic", 0.0, 1)):
        shape.attach_attribute(f"vertex_{name}", dr.full(mi.Float, value, channels * count))
    return shape


def _detail(shape: mi.Shape) -> ColorDetail:
    vertices, _, _ = shape.surface.to_numpy()
    return ColorDetail(vertices, _SIDE, mi.Transform4f(shape.to_world).inverse())


def test_it_is_there_around_the_surface(sphere):
    detail = _detail(sphere)
    detail.values = dr.ones(mi.Float, dr.width(detail.values))
    vertices, _, _ = sphere.surface.to_numpy()
    voxel = 2 / _SIDE
    for distance in (-1.5, 0.0, 1.5):
        points = vertices * (1 + distance * voxel / np.linalg.norm(vertices, axis=1, keepdims=True))
        assert np.allclose(detail.at(mi.Point3f(points.T)), 1, atol=1e-5)
    assert dr.all(detail.at(mi.Point3f(0.0)) == 0)[0]


def test_no_detail_leaves_the_colour(sphere):
    color = mi.Color3f(0.2, 0.5, 0.9)
    assert np.allclose(_detail(sphere).color(color, mi.Point3f(0.5, 0, 0)), color, atol=1e-5)


def test_it_follows_the_surface_and_forgets_what_is_far(sphere):
    detail = _detail(sphere)
    centre = detail.bricks.centres()
    detail.values = dr.ravel(mi.Vector4f(centre.x, centre.y, centre.z, 0))
    vertices, _, _ = sphere.surface.to_numpy()
    moved = vertices + np.array([0.1, 0, 0])
    source = detail.follow(moved)
    assert dr.width(source) == detail.bricks.voxel_count
    kept = np.abs(detail.values.numpy().reshape(-1, 4)).sum(axis=1) > 0
    centres = detail.bricks.centres().numpy().T
    assert np.allclose(detail.values.numpy().reshape(-1, 4)[kept, :3], centres[kept], atol=1e-6)
    assert 0 < (~kept).sum() < len(kept)


def test_arrays_bring_it_back(sphere):
    detail, other = _detail(sphere), _detail(sphere)
    detail.values = dr.arange(mi.Float, dr.width(detail.values))
    other.follow(sphere.surface.to_numpy()[0] * 0.5)
    other.restore(detail.arrays())
    assert (other.bricks.places == detail.bricks.places).all()
    assert (other.values.numpy() == detail.values.numpy()).all()


def test_a_render_has_derivatives_by_it(sphere):
    texture = mi.load_dict({"type": "gshell_color"})
    texture.detail = _detail(sphere)
    sphere.set_bsdf(mi.load_dict(principled(texture)))
    scene = mi.load_dict({"type": "scene", "subject": sphere, "light": {"type": "constant"}, "sensor": {
        "type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}}})
    parameters = mi.traverse(scene)
    name = next(name for name in parameters.keys() if name.endswith(".detail"))
    integrator = mi.load_dict({"type": "gshell_path", "max_depth": 2, "hide_emitters": True})
    front = texture.detail.bricks.centres().z.numpy() > 0
    direction = np.zeros((len(front), 4), np.float32)
    direction[front, :3] = [1, 0.5, -0.25]

    def rendered(values: mi.Float) -> mi.Float:
        parameters[name] = texture.detail.values = values
        parameters.update()
        image = mi.render(scene, parameters, integrator=integrator, spp=64, seed=0)
        return dr.sum(image.array)

    values = dr.zeros(mi.Float, 4 * len(front))
    dr.enable_grad(values)
    dr.backward(rendered(values))
    along = float(dr.grad(values).numpy() @ direction.ravel())
    step = 0.05
    high, low = (rendered(mi.Float(sign * step * direction.ravel()))[0] for sign in (1, -1))
    assert np.isclose(along, (high - low) / (2 * step), rtol=0.02)
