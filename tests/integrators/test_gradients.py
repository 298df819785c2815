"""Derivatives of gshell_path and gshell_mask against finite differences and against each other."""

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from gshell_mi.errors import UserError
from pipelines import gradient_scenes as scenes
from pipelines.surface_differences import SurfaceImage

RESOLUTION = 24
CASES = {case.name: case for case in scenes.SCENES}
QUICK = [
    "sphere_translating",
    "sheet_scaling",
    "sharp_pleats",
    "cube_flat_shaded",
    "many_flat_faces",
    "leaving_the_frame",
    "shadow_point_light",
    "shadow_directional",
]


def path(case, **options):
    return mi.load_dict({"type": "gshell_path", "max_depth": case.depth, "hide_emitters": True, **options})


def weighted(images):
    weights = scenes.image_weights(RESOLUTION)
    return np.array([(image[..., :3] * weights).sum() for image in images])


def mean_and_error(x):
    return x.mean(), x.std(ddof=1) / np.sqrt(len(x))


def converged(image_of_seed, least, most=320):
    """Mean and error of the weighted images of as many seeds as an error of 3 % takes, within limits."""
    values = np.array([])
    while len(values) < most:
        values = np.append(values, weighted([image_of_seed(len(values) + i) for i in range(least)]))
        mean, error = mean_and_error(values)
        if error < 0.03 * abs(mean):
            break
    return mean, error


@pytest.mark.parametrize("name", ["shirt_translating", "border_sampled", "box_filter", "shadow_area_light"])
def test_points_on_surfaces_make_the_same_image(name):
    """The reference of the finite differences: equal to what Mitsuba renders."""
    case = CASES[name]
    mover = scenes.Mover(case, RESOLUTION)
    path = mi.load_dict({"type": "path", "max_depth": case.depth, "hide_emitters": True})
    expected = np.array(mi.render(mover.scene, integrator=path, spp=1024))
    image = np.mean([SurfaceImage(mover, case, 400_000, seed).at(0) for seed in range(4)], 0)
    np.testing.assert_allclose(image, expected, atol=0.05 * expected.max())
    assert image[..., :3].mean() == pytest.approx(expected[..., :3].mean(), rel=0.01)


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
def test_against_finite_differences(name):
    case = CASES[name]
    mover = scenes.Mover(case, RESOLUTION)
    fd, fd_error = converged(lambda seed: SurfaceImage(mover, case, 200_000, seed).difference(case.step), 6)
    mean, error = converged(lambda seed: scenes.forward_image(mover, path(case), 64, seed), 8)
    assert abs(mean - fd) <= max(0.01 * abs(fd), 3.5 * np.hypot(fd_error, error))
    assert np.hypot(fd_error, error) < 0.05 * abs(fd)  # else the line above says nothing


@pytest.mark.parametrize("name", ["shirt_translating", "open_box", "border_sampled"])
def test_reverse_equals_forward(name):
    case = CASES[name]
    mover = scenes.Mover(case, RESOLUTION)
    integrator = path(case)
    forward = weighted([scenes.forward_image(mover, integrator, 8, 3)])[0]
    reverse = scenes.reverse_derivative(mover, integrator, 8, 3, scenes.image_weights(RESOLUTION))
    assert reverse == pytest.approx(forward, rel=1e-3)


def test_replayed_vertices_reverse_equals_forward():
    """Depth 5 in an open box: replayed vertices and the adjoint of the one before them."""
    case = CASES["open_box"]
    mover = scenes.Mover(case, RESOLUTION)
    integrator = mi.load_dict({"type": "gshell_path", "max_depth": 5, "hide_emitters": True})
    forward = weighted([scenes.forward_image(mover, integrator, 8, 3)])[0]
    reverse = scenes.reverse_derivative(mover, integrator, 8, 3, scenes.image_weights(RESOLUTION))
    assert reverse == pytest.approx(forward, rel=1e-3)


def test_paths_that_are_not_differentiated_are_in_the_image_alone():
    case = CASES["open_box"]
    mover, weights = scenes.Mover(case, RESOLUTION), scenes.image_weights(RESOLUTION)
    short, long, both = (
        mi.load_dict({"type": "gshell_path", "hide_emitters": True, **depths})
        for depths in ({"max_depth": 3}, {"max_depth": 5}, {"max_depth": 5, "gradient_depth": 3})
    )
    of_short, of_long, of_both = (
        np.array(mi.render(mover.scene, integrator=integrator, spp=8, seed=3))
        for integrator in (short, long, both)
    )
    # To rounding: a film adds its samples up in the order in which threads get there.
    np.testing.assert_allclose(of_both, of_long, rtol=1e-5, atol=1e-7)
    assert of_long[..., :3].sum() > 1.02 * of_short[..., :3].sum()
    assert weighted([scenes.forward_image(mover, both, 8, 3)])[0] == pytest.approx(
        weighted([scenes.forward_image(mover, short, 8, 3)])[0], rel=1e-4
    )
    assert scenes.reverse_derivative(mover, both, 8, 3, weights) == pytest.approx(
        scenes.reverse_derivative(mover, short, 8, 3, weights), rel=1e-4
    )


def test_few_samples_are_unbiased():
    case = CASES["sphere_scaling"]
    mover = scenes.Mover(case, RESOLUTION)
    integrator = path(case, reparam_depth=1)
    few = weighted([scenes.forward_image(mover, integrator, 2, seed) for seed in range(100)])
    many = weighted([scenes.forward_image(mover, integrator, 256, seed) for seed in range(8)])
    (few, few_error), (many, error) = mean_and_error(few), mean_and_error(many)
    assert few_error < 0.01 * abs(many)
    assert abs(few - many) <= 3.5 * np.hypot(few_error, error)


def shadow_of_a_curtain(profile):
    """Derivative of a floor's image as a curtain of the profile, (x, z) from top to bottom, moves along x."""
    x, z = np.array(profile, float).T
    count = len(profile)
    v = np.stack([np.repeat(x, 2), np.tile([-2.0, 2.0], count), np.repeat(z, 2)], -1)
    i = 2 * np.arange(count - 1)
    f = np.concatenate([np.stack([i, i + 1, i + 2], -1), np.stack([i + 1, i + 3, i + 2], -1)])
    floor = scenes.plane(size=8)
    case = scenes.GradientScene(
        "curtain",
        "",
        lambda _: (
            scenes.load(
                scenes.camera(RESOLUTION, (0.4, 0, 0.4), (0.02, 0, 0)),
                scenes.directional_light((0, 0, -1)),
                scenes.make_mesh("subject", v, f),
                floor=scenes.make_mesh("floor", floor[0][:, [0, 2, 1]], floor[1], smooth=False),
            ),
            scenes.translation(v, (1, 0, 0)),
        ),
    )
    mover = scenes.Mover(case, RESOLUTION)
    images = [scenes.forward_image(mover, path(case, light_edge_samples=16), 16, seed) for seed in range(8)]
    return np.mean([image[..., :3].sum() for image in images])


def test_edges_in_line_with_the_light_cast_one_shadow():
    """Where light grazes a fine mesh, several of its edges are silhouettes; one is outermost."""
    one = shadow_of_a_curtain([(-0.05, 1.5), (0, 1), (-1, 0.6)])
    two = shadow_of_a_curtain([(-0.05, 1.5), (0, 1), (-1.2e-4, 0.97), (-3e-5, 0.94), (-1, 0.6)])
    assert one != 0
    assert two == pytest.approx(one, rel=0.02)


@pytest.mark.parametrize("copies", [False, True])
def test_repeated_faces_change_no_derivative(copies):
    """Whose creases and silhouettes are there twice."""

    def derivative(doubled):
        box = trimesh.creation.box((1.2, 1.2, 1.2))
        v, f = np.array(box.vertices), np.array(box.faces)
        if doubled:
            again, v = (f + len(v), np.concatenate([v, v])) if copies else (f[:, ::-1], v)
            f = np.concatenate([f, again])
        case = scenes.GradientScene(
            "cube",
            "",
            lambda _: (
                scenes.load(
                    scenes.camera(RESOLUTION, (2, 2.5, 4)),
                    scenes.sky(),
                    scenes.make_mesh("subject", v, f, smooth=False),
                ),
                scenes.translation(v),
            ),
        )
        mover = scenes.Mover(case, RESOLUTION)
        return weighted([scenes.forward_image(mover, path(case), 16, seed) for seed in range(4)]).mean()

    assert derivative(True) == pytest.approx(derivative(False), rel=0.02)


def test_alpha_of_a_scaled_sphere():
    """The coverage of a sphere is the area of its projection: a closed form."""
    case = CASES["sphere_scaling"]
    mover = scenes.Mover(case, 32)
    image = np.mean([scenes.forward_image(mover, path(case), 64, s) for s in range(4)], 0)
    tan2 = 1 / (5.0**2 - 1)  # square of the tangent of the cone around a unit sphere
    derivative = 2 * 5**2 / (5**2 - 1) ** 2  # of that tangent's square, over the radius
    pixels = (16 / np.tan(np.deg2rad(20))) ** 2
    assert np.pi * tan2 * pixels == pytest.approx(
        np.array(mi.render(mover.scene, integrator=path(case), spp=64))[..., 3].sum(), rel=0.02
    )
    assert image[..., 3].sum() == pytest.approx(np.pi * derivative * pixels, rel=0.02)


def test_mask_integrator_matches_path_coverage_and_its_own_reverse_mode():
    case = CASES["sheet_translating"]
    mover = scenes.Mover(case, RESOLUTION)
    mask = mi.load_dict({"type": "gshell_mask"})
    image = scenes.forward_image(mover, mask, 64, 1)
    assert image.shape[-1] == 8
    alpha = scenes.forward_image(mover, path(case), 64, 1)[..., 3]
    np.testing.assert_allclose(image[..., 3], alpha, rtol=1e-4, atol=1e-3)
    ramp = np.linspace(0, 1, RESOLUTION, dtype=np.float32)
    x = np.broadcast_to(ramp[None, :, None], image.shape)
    t = mi.Float(0)
    dr.enable_grad(t)
    mover.to(t)
    rendered = mi.render(mover.scene, mover.params, integrator=mask, spp=64, seed=1)
    dr.backward(dr.sum(rendered * mi.TensorXf(np.array(x))))
    assert dr.grad(t)[0] == pytest.approx((image * x).sum(), rel=1e-3)


def test_material_and_light_receive_derivatives():
    """The image is linear in albedo (at depth 2) and in the light, so the derivatives are known."""
    v, f = scenes.sphere(2)
    scene = scenes.load(scenes.camera(RESOLUTION), scenes.constant(0.5), scenes.make_mesh("subject", v, f))
    params = mi.traverse(scene)
    albedo = next(k for k in params.keys() if k.endswith("reflectance.value"))
    light = next(k for k in params.keys() if k.endswith("radiance.value"))
    for key in (albedo, light):
        dr.enable_grad(params[key])
    params.update()
    integrator = mi.load_dict({"type": "gshell_path", "max_depth": 2, "hide_emitters": True})
    image = mi.render(scene, params, integrator=integrator, spp=256)
    total = dr.sum(image[:, :, :3])
    dr.backward(total)
    # The red, green and blue of the albedo times their derivatives make up the whole image.
    by_albedo = dr.sum(params[albedo] * dr.grad(params[albedo]))
    by_light = dr.sum(params[light] * dr.grad(params[light]))
    assert by_albedo[0] == pytest.approx(total.array[0], rel=0.01)
    assert by_light[0] == pytest.approx(total.array[0], rel=0.01)


def opacity_derivative(hide_emitters, depth, **others):
    """Sum over the pixels of the derivative by a sheet's opacity, and the scene and its parameters."""
    sheet = {"type": "mask", "opacity": {"type": "uniform", "value": 0.5}, "bsdf": scenes.diffuse()}
    v, f = scenes.sheet()
    subject = scenes.make_mesh("subject", v, f, sheet)
    scene = scenes.load(scenes.camera(RESOLUTION), scenes.constant(), subject, **others)
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("opacity.value"))
    dr.enable_grad(params[key])
    params.update()
    dr.set_grad(params[key], 1)
    integrator = mi.load_dict({"type": "gshell_path", "max_depth": depth, "hide_emitters": hide_emitters})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # that shadows through it have no derivative
        image = mi.render(scene, params, integrator=integrator, spp=256)
    return np.array(dr.forward_to(image)).sum((0, 1)), scene, params, key


def test_opacity_of_a_lone_sheet():
    """The sheet shows its albedo times its opacity, and its coverage is its opacity."""
    derivative, scene, *_ = opacity_derivative(True, 2)
    mask = mi.load_dict({"type": "gshell_mask"})
    area = np.array(mi.render(scene, integrator=mask, spp=256))[..., 3].sum()
    np.testing.assert_allclose(derivative, area * np.array([0.8, 0.5, 0.3, 1]), rtol=0.03)


def test_transparent_surfaces_look_as_in_stock_path():
    """Sheets of opacity one half before a lamp and a ball, with and without hidden emitters."""
    half = {"type": "mask", "opacity": {"type": "uniform", "value": 0.5}, "bsdf": scenes.diffuse()}
    v, f = scenes.sheet()
    scene = scenes.load(
        scenes.camera(RESOLUTION),
        scenes.constant(),
        scenes.make_mesh("subject", v, f, half),
        second=scenes.make_mesh("second", v - np.array([0, 0, 0.5]), f, half),
        ball=scenes.make_mesh("ball", *scenes.sphere(2, 0.3, (0.5, 0, -1))),
        lamp={
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, -2]),
            "emitter": {"type": "area"},
        },
    )
    for hide, depth in ((False, 1), (False, 4), (True, 1), (True, 2), (True, 4)):
        path, ours = (
            np.array(
                mi.render(
                    scene,
                    integrator=mi.load_dict({"type": kind, "max_depth": depth, "hide_emitters": hide}),
                    spp=512,
                )
            ).mean((0, 1))
            for kind in ("path", "gshell_path")
        )
        assert ours[3] == pytest.approx(path[3], abs=2e-3)
        if not hide:
            np.testing.assert_allclose(ours[:3], path[:3], rtol=0.01)


def test_hidden_emitters_leave_a_transparent_sheet_its_light():
    """Half opaque, it shows half of what it does when opaque.

    Stock ``path`` shows less: it also drops the light that it has sampled at the sheet wherever its path
    goes on through the sheet and leaves the scene, so its image depends on how light is sampled.
    """
    images = []
    for opacity in (0.5, 1.0):
        sheet = {"type": "mask", "opacity": {"type": "uniform", "value": opacity}, "bsdf": scenes.diffuse()}
        scene = scenes.load(
            scenes.camera(RESOLUTION), scenes.constant(), scenes.make_mesh("subject", *scenes.sheet(), sheet)
        )
        images += [
            np.array(
                mi.render(
                    scene,
                    integrator=mi.load_dict({"type": kind, "max_depth": 2, "hide_emitters": True}),
                    spp=1024,
                )
            ).mean((0, 1))
            for kind in ("gshell_path", "path")
        ]
    (half, _, full, stock_full) = images
    np.testing.assert_allclose(full, stock_full, rtol=0.01)
    np.testing.assert_allclose(half, full / 2, rtol=0.02)


def test_opacity_before_another_surface():
    """The image is a polynomial of the opacity, of degree 2 but for what is too dim to matter."""
    ball = scenes.make_mesh("ball", *scenes.sphere(2, 0.5, (0, 0, -1)))
    derivative, scene, params, key = opacity_derivative(False, 4, ball=ball)
    stock = mi.load_dict({"type": "path", "max_depth": 4})
    images = []
    for opacity in (0.35, 0.65):
        params[key] = opacity
        params.update()
        images.append(np.array(mi.render(scene, integrator=stock, spp=2048)))
    expected = ((images[1] - images[0]) / 0.3).sum((0, 1))
    np.testing.assert_allclose(derivative, expected, atol=0.03 * np.abs(expected).max())
    assert derivative[3] == 0


def test_camera_motion_is_the_opposite_of_object_motion():
    v, f = scenes.sphere(3)
    scene = scenes.load(scenes.camera(RESOLUTION), scenes.constant(), scenes.make_mesh("subject", v, f))
    params = mi.traverse(scene)
    integrator = mi.load_dict({"type": "gshell_path", "max_depth": 2, "hide_emitters": True})
    weights = mi.TensorXf(scenes.image_weights(RESOLUTION))
    rest, pose = mi.Float(params["subject.vertex_positions"]), mi.Transform4f(params["sensor.to_world"])
    derivatives = []
    for moves_camera in (False, True):
        t = mi.Float(0)
        dr.enable_grad(t)
        shift = mi.Vector3f(1, 0.5, 0.3) * t
        if moves_camera:
            params["subject.vertex_positions"] = rest
            params["sensor.to_world"] = mi.Transform4f().translate(shift) @ pose
        else:
            params["subject.vertex_positions"] = dr.ravel(dr.unravel(mi.Point3f, rest) + shift)
        params.update()
        image = mi.render(scene, params, integrator=integrator, spp=64, seed=2)
        dr.backward(dr.sum(image[:, :, :3] * weights))
        derivatives.append(dr.grad(t)[0])
    assert derivatives[1] == pytest.approx(-derivatives[0], rel=0.02)


def test_other_sensors_are_refused():
    sensor = {**scenes.camera(8), "type": "thinlens", "aperture_radius": 0.1}
    v, f = scenes.sphere(1)
    scene = scenes.load(sensor, scenes.constant(), scenes.make_mesh("subject", v, f))
    integrator = mi.load_dict({"type": "gshell_path", "max_depth": 2})
    assert np.isfinite(np.array(mi.render(scene, integrator=integrator, spp=4))).all()
    with pytest.raises(UserError, match=r"ThinLensCamera.*'perspective' sensors only"):
        integrator.render_forward(scene, None, 0)


def test_reparam_depth_is_checked():
    with pytest.raises(Exception, match="reparam_depth is 7"):
        mi.load_dict({"type": "gshell_path", "reparam_depth": 7})


def test_gradient_depth_is_checked():
    with pytest.raises(Exception, match="gradient_depth is 0"):
        mi.load_dict({"type": "gshell_path", "gradient_depth": 0})


def odd_shapes(folder):
    """Kind -> shapes that the integrators cannot differentiate, and words of the warnings about them."""
    curve = folder / "curve.txt"
    curve.write_text("".join(f"{x} {0.3 * x} 0.5 0.05\n" for x in (-1.5, -0.7, 0, 0.7, 1.5)))
    scenes.make_mesh("ball", *scenes.sphere(1, 0.3)).write_ply(str(folder / "ball.ply"))
    ball = {"type": "ply", "filename": str(folder / "ball.ply")}
    instance = {
        "type": "instance",
        "id": "odd",
        "to_world": mi.ScalarTransform4f().translate([1, 0, 0]),
        "shape": {"type": "ref", "id": "group"},
    }
    glass = {"type": "sphere", "id": "odd", "radius": 0.3, "bsdf": {"type": "dielectric"}}
    v, f = scenes.sheet(2)
    return {
        "curve": ({"odd": {"type": "bsplinecurve", "id": "odd", "filename": str(curve)}}, ["BSplineCurve"]),
        "instance": (
            {"group": {"type": "shapegroup", "id": "group", "ball": ball}, "odd": instance},
            ["Instance"],
        ),
        "glass": ({"odd": glass}, ["Sphere", "mirror or glass"]),
        "mirror": ({"odd": scenes.make_mesh("odd", v, f, {"type": "conductor"})}, ["mirror or glass"]),
        "mask": (
            {
                "odd": scenes.make_mesh(
                    "odd", v, f, {"type": "mask", "opacity": 0.5, "bsdf": scenes.diffuse()}
                )
            },
            ["partly transparent"],
        ),
    }


@pytest.mark.parametrize("kind", ["curve", "instance", "glass", "mirror", "mask"])
def test_says_once_what_it_cannot_differentiate(kind, tmp_path):
    others, words = odd_shapes(tmp_path)[kind]
    v, f = scenes.sphere(1, 0.7)
    scene = scenes.load(scenes.camera(8), scenes.constant(), scenes.make_mesh("subject", v, f), **others)
    params = mi.traverse(scene)
    key = "subject.vertex_positions"
    dr.enable_grad(params[key])
    params.update()
    integrator = mi.load_dict({"type": "gshell_path", "max_depth": 4, "reparam_depth": 2})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for seed in range(2):
            dr.backward(dr.sum(mi.render(scene, params, integrator=integrator, spp=4, seed=seed)))
    messages = sorted(str(w.message) for w in caught if "'odd'" in str(w.message))
    assert len(messages) == len(words) and all(w in m for w, m in zip(words, messages, strict=True))
    assert np.isfinite(np.array(dr.grad(params[key]))).all()
