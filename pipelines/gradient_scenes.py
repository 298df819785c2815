"""Small scenes with one moving parameter each, on which derivatives of visibility are hard.

Every scene is a :class:`GradientScene`: a Mitsuba scene whose one mesh moves with a scalar, along a given
direction in the space of its vertices. ``pipelines/validate_gradients.py`` measures derivatives on all of
them; the tests do so at small sizes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class GradientScene:
    """A scene, whose emitters are to be hidden, and the motion of its mesh ``subject``."""

    name: str  #: short name, also of the image file
    about: str  #: what it shows
    build: Callable  #: resolution in pixels -> (scene, motion of the vertices, V x 3)
    depth: int = 2  #: path length (``max_depth``)
    step: float = 0.01  #: of the finite differences, in units of the parameter


def make_mesh(name, vertices, faces, bsdf=None, *, uv=None, smooth=True):
    """A ``mi.Mesh`` of given arrays, with smooth vertex normals or flat faces."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf or diffuse())
    mesh = mi.Mesh(
        name,
        len(vertices),
        len(faces),
        properties,
        has_vertex_normals=smooth,
        has_vertex_texcoords=uv is not None,
    )
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(np.asarray(vertices, np.float32).ravel())
    params["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
    if uv is not None:
        params["vertex_texcoords"] = mi.Float(np.asarray(uv, np.float32).ravel())
    params.update()
    return mesh


def camera(resolution, origin=(0, 0, 5), target=(0, 0, 0), up=(0, 1, 0), **film):
    return {
        "type": "perspective",
        "fov": 40,
        "near_clip": 0.05,
        "to_world": mi.ScalarTransform4f().look_at(list(origin), list(target), list(up)),
        "sampler": {"type": "independent"},
        "film": {
            "type": "hdrfilm",
            "width": resolution,
            "height": resolution,
            "pixel_format": "rgba",
            "rfilter": {"type": "gaussian"},
            **film,
        },
    }


def diffuse(*colour):
    return {
        "type": "twosided",
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour) or [0.8, 0.5, 0.3]}},
    }


def sky():
    """An environment with a bright side: smooth, so that renderings converge fast."""
    height, width = 32, 64
    theta = (np.arange(height) + 0.5) / height * np.pi
    phi = (np.arange(width) + 0.5) / width * 2 * np.pi
    lobe = np.sin(theta)[:, None] * np.cos(phi - 1)[None] * 0.6 + 0.8 * np.cos(theta)[:, None]
    image = 0.3 + 2.0 * np.exp(4 * (lobe - 1))[..., None] * np.array([1, 0.9, 0.7])
    return {"type": "envmap", "bitmap": mi.Bitmap(image.astype(np.float32))}


def constant(radiance=1.0):
    return {"type": "constant", "radiance": {"type": "rgb", "value": [radiance] * 3}}


def load(sensor, light, subject, **others):
    return mi.load_dict({"type": "scene", "sensor": sensor, "light": light, "subject": subject, **others})


def sphere(level=3, radius=1.0, centre=(0, 0, 0)):
    mesh = trimesh.creation.icosphere(level, radius)
    return np.array(mesh.vertices) + np.array(centre), np.array(mesh.faces)


def sheet(n=8, size=1.6):
    """A square in the plane z = 0, gently curved."""
    x, y = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1))
    vertices = np.stack([x * size / 2, y * size / 2, 0.15 * np.cos(2 * x)], -1).reshape(-1, 3)
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n + 2], -1), np.stack([i, i + n + 2, i + n + 1], -1)])
    return vertices, faces


def plane(height=0.0, size=4.0):
    corners = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) * size
    return corners + np.array([0, height, 0]), np.array([[0, 2, 1], [0, 3, 2]])


def uv_sphere(radius=1.0, centre=(0, 0, 0), n=24):
    """A sphere with a texture seam: the vertices of one meridian exist twice."""
    u, v = np.meshgrid(np.linspace(0, 1, 2 * n + 1), np.linspace(0, 1, n + 1))
    theta, phi = v * np.pi, u * 2 * np.pi
    vertices = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    vertices[:, -1] = vertices[:, 0]
    vertices[0], vertices[-1] = (0, 1, 0), (0, -1, 0)
    i = (np.arange(n)[:, None] * (2 * n + 1) + np.arange(2 * n)).ravel()
    faces = np.concatenate(
        [np.stack([i, i + 1, i + 2 * n + 2], -1), np.stack([i, i + 2 * n + 2, i + 2 * n + 1], -1)]
    )
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return vertices.reshape(-1, 3) * radius + np.array(centre), faces, uv


def open_cylinder(n=32, rings=8, radius=0.8, height=1.6):
    phi = np.arange(n) / n * 2 * np.pi
    y = np.linspace(-0.5, 0.5, rings + 1) * height
    vertices = np.stack(
        [np.tile(radius * np.cos(phi), rings + 1), np.repeat(y, n), np.tile(radius * np.sin(phi), rings + 1)],
        -1,
    )
    j, i = np.meshgrid(np.arange(rings), np.arange(n), indexing="ij")
    a, b = (j * n + i).ravel(), (j * n + (i + 1) % n).ravel()
    return vertices, np.concatenate([np.stack([a, b, b + n], -1), np.stack([a, b + n, a + n], -1)])


def box_without_top(size=1.6):
    mesh = trimesh.creation.box((size, size, size))
    keep = mesh.face_normals[:, 1] < 0.5
    return np.array(mesh.vertices), np.array(mesh.faces)[keep]


def chequers(n=8):
    cells = np.indices((n, n)).sum(0) % 2
    image = np.where(cells[..., None], [0.9, 0.2, 0.1], [0.1, 0.3, 0.8]).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(image), "filter_type": "bilinear", "raw": True}


def shirt():
    """The T-shirt of ``scenes/tshirt``, or an open cylinder where it has not been made yet."""
    path = ROOT / "scenes" / "tshirt" / "truth.ply"
    if not path.exists():
        return open_cylinder()
    mesh = trimesh.load(path, process=False)
    vertices = np.array(mesh.vertices)
    vertices -= vertices.mean(0)
    return vertices / np.abs(vertices).max() * 1.2, np.array(mesh.faces)


def pleats(count=12):
    """A sheet folded back and forth, at angles far below 90 degrees."""
    x, y = np.linspace(-1, 1, count + 1), np.linspace(-0.8, 0.8, 4)
    row = np.stack([x, 0 * x, 0.25 * (-1.0) ** np.arange(count + 1)], -1)
    i = (np.arange(3)[:, None] * (count + 1) + np.arange(count)).ravel()
    faces = [np.stack([i, i + 1, i + count + 2], -1), np.stack([i, i + count + 2, i + count + 1], -1)]
    return (row + y[:, None, None] * [0, 1, 0]).reshape(-1, 3), np.concatenate(faces)


def translation(vertices, direction=(1, 0.5, 0.3)):
    return np.broadcast_to(np.array(direction, float), np.shape(vertices))


def _sphere(motion):
    def build(resolution):
        v, f = sphere()
        return (
            load(camera(resolution), constant(), make_mesh("subject", v, f)),
            translation(v) if motion == "translate" else v,
        )

    return build


def _sheet(motion):
    def build(resolution):
        v, f = sheet()
        return (
            load(camera(resolution, (1, 1, 4)), sky(), make_mesh("subject", v, f)),
            translation(v) if motion == "translate" else v,
        )

    return build


def _shirt(motion, light=sky):
    def build(resolution):
        v, f = shirt()
        normals = np.array(trimesh.Trimesh(v, f, process=False).vertex_normals)
        return (
            load(camera(resolution, (1.5, 1.5, 4)), light(), make_mesh("subject", v, f)),
            translation(v) if motion == "translate" else 0.5 * normals,
        )

    return build


def _pleats(resolution):
    v, f = pleats()
    return load(camera(resolution, (1.5, 1.5, 4)), sky(), make_mesh("subject", v, f)), translation(v)


def _cube(resolution):
    box = trimesh.creation.box((1.2, 1.2, 1.2))
    v, f = np.array(box.vertices), np.array(box.faces)
    return (
        load(camera(resolution, (2, 2.5, 4)), constant(), make_mesh("subject", v, f, smooth=False)),
        translation(v),
    )


def _flat_cube_sky(resolution):
    box = trimesh.creation.box((1.2, 1.2, 1.2))
    v, f = np.array(box.vertices), np.array(box.faces)
    return (
        load(camera(resolution, (2, 2.5, 4)), sky(), make_mesh("subject", v, f, smooth=False)),
        translation(v),
    )


def _seam_over_mirror(resolution):
    v, f, uv = uv_sphere(0.6, (0, 0.9, 0))
    mirror = make_mesh(
        "mirror",
        *plane(),
        {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.3, "material": "Al"}},
        smooth=False,
    )
    texture = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": chequers()}}
    return (
        load(
            camera(resolution, (0, 3, 4.5), (0, 0.5, 0)),
            constant(),
            make_mesh("subject", v, f, texture, uv=uv),
            mirror=mirror,
        ),
        translation(v, (0.3, 1, -0.3)),
    )


def _seam_self_shadowed(resolution):
    v, f, uv = uv_sphere(0.9)
    dent = 0.45 * np.exp(-8 * ((v[:, 0] - 0.3) ** 2 + (v[:, 2] - 0.8) ** 2))
    v = v * (1 - dent)[:, None]
    return (load(camera(resolution, (1, 1.5, 4)), sky(), make_mesh("subject", v, f, uv=uv)), translation(v))


def _textured_light(smooth):
    def build(resolution):
        v, f = sphere(3, 0.8)
        to_world = mi.ScalarTransform4f().look_at([1.5, 2.5, 2.5], [0, 0, 0], [0, 1, 0])
        light = {
            "type": "rectangle",
            "to_world": to_world,
            "emitter": {"type": "area", "radiance": {**chequers(4)}},
        }
        return load(camera(resolution), light, make_mesh("subject", v, f, smooth=smooth)), translation(v)

    return build


def _coarse(resolution):
    v, f = sphere(1, 0.8)
    return (
        load(camera(resolution), _point_light([1.5, 2.5, 2.5]), make_mesh("subject", v, f)),
        translation(v),
    )


def _frame(sample_border, **film):
    def build(resolution):
        v, f = sphere(3, 0.8, (1.7, 0.4, 0))
        return (
            load(
                camera(resolution, sample_border=sample_border, **film),
                constant(),
                make_mesh("subject", v, f),
            ),
            translation(v),
        )

    return build


def _box_filter(resolution):
    v, f = sphere()
    return (
        load(camera(resolution, rfilter={"type": "box"}), constant(), make_mesh("subject", v, f)),
        translation(v),
    )


def _occluder(resolution):
    v, f = sphere(3, 0.9)
    w, g = sheet(4, 0.9)
    return (
        load(
            camera(resolution, (0.3, 0.4, 5)),
            constant(),
            make_mesh("subject", v, f),
            occluder=make_mesh("occluder", w + np.array([0.4, 0.2, 1.6]), g, diffuse(0.1, 0.2, 0.7)),
        ),
        translation(v),
    )


def _open_box(resolution):
    v, f = box_without_top()
    return (
        load(camera(resolution, (1.5, 3.5, 3)), sky(), make_mesh("subject", v, f, smooth=False)),
        translation(v),
    )


def _thin_sheet(resolution):
    v, f = sheet()
    v = v[:, [2, 1, 0]]
    return (load(camera(resolution, (0.4, 0.5, 5)), constant(), make_mesh("subject", v, f)), translation(v))


def _shadow_on_plane(light):
    def build(resolution):
        v, f = sphere(3, 0.5, (0.3, 0.8, 0))
        # Darker than the plane: else the object and its shadow nearly cancel
        dark = diffuse(0.1, 0.15, 0.2)
        return (
            load(
                camera(resolution, (0.2, 6, 4)),
                light(),
                make_mesh("subject", v, f, dark),
                plane=make_mesh("plane", *plane(), smooth=False),
            ),
            translation(v),
        )

    return build


def _point_light(position=(2, 4, 1)):
    return {"type": "point", "position": list(position), "intensity": {"type": "rgb", "value": [16.0] * 3}}


def directional_light(direction=(-0.4, -1, -0.2), irradiance=1.0):
    return {
        "type": "directional",
        "direction": list(direction),
        "irradiance": {"type": "rgb", "value": [irradiance] * 3},
    }


def _area_light():
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().look_at([2, 4, 1], [0, 0, 0], [0, 0, 1]).scale(0.7),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [6.0] * 3}},
    }


SCENES = (
    GradientScene("sphere_translating", "closed silhouette", _sphere("translate")),
    GradientScene("sphere_scaling", "closed silhouette", _sphere("scale")),
    GradientScene("sheet_translating", "open boundary", _sheet("translate")),
    GradientScene("sheet_scaling", "open boundary", _sheet("scale")),
    GradientScene("shirt_translating", "open garment, self-shadowed", _shirt("translate")),
    GradientScene("shirt_inflating", "open garment, deforming", _shirt("inflate")),
    GradientScene(
        "shirt_grazed",
        "fine mesh along which light passes",
        _shirt("translate", lambda: directional_light((-0.1, -1, -0.1), 2.0)),
    ),
    GradientScene("sharp_pleats", "smooth-shaded sharp folds, some faces almost edge-on", _pleats),
    GradientScene("cube_constant", "cube under a constant environment (Mitsuba #1895)", _cube),
    GradientScene("cube_flat_shaded", "creases between flat faces", _flat_cube_sky),
    GradientScene(
        "seam_over_rough_mirror",
        "texture seam over a rough mirror (Mitsuba #1648)",
        _seam_over_mirror,
        3,
        step=0.04,
    ),
    GradientScene("seam_self_shadowed", "texture seam, self-shadowed (Mitsuba #1648)", _seam_self_shadowed),
    GradientScene("textured_area_light", "spatially varying emitter (Mitsuba #1506)", _textured_light(True)),
    GradientScene("many_flat_faces", "the same, flat-shaded at small angles", _textured_light(False)),
    GradientScene("coarse_shading_rim", "coarse mesh, normals turned away at the silhouette", _coarse),
    GradientScene("border_sampled", "sample_border, object at the frame (Mitsuba #1954)", _frame(True)),
    GradientScene("leaving_the_frame", "object leaving the frame", _frame(False)),
    GradientScene("box_filter", "box reconstruction filter", _box_filter),
    GradientScene("occluder", "static occluder in front", _occluder, step=0.02),
    GradientScene("open_box", "interreflection in an open box", _open_box, 3),
    GradientScene("thin_sheet_edge_on", "sheet seen almost from its edge", _thin_sheet, step=0.0025),
    GradientScene(
        "shadow_environment", "shadow on a plane, environment", _shadow_on_plane(constant), step=0.08
    ),
    GradientScene(
        "shadow_area_light", "shadow on a plane, area light", _shadow_on_plane(_area_light), step=0.08
    ),
    GradientScene(
        "shadow_point_light", "hard shadow, point light", _shadow_on_plane(_point_light), step=0.08
    ),
    GradientScene(
        "shadow_directional", "hard shadow, directional light", _shadow_on_plane(directional_light), step=0.08
    ),
)


class Mover:
    """Moves the subject of a scene along its motion."""

    def __init__(self, case: GradientScene, resolution: int):
        self.scene, motion = case.build(resolution)
        self.params = mi.traverse(self.scene)
        self.key = "subject.vertex_positions"
        self.rest = mi.Float(self.params[self.key])
        self.motion = mi.Float(np.ascontiguousarray(motion, np.float32).ravel())

    def to(self, t):
        """Sets the parameter; ``t`` may be attached."""
        self.params[self.key] = self.rest + self.motion * t
        self.params.update()


def image_weights(resolution: int) -> np.ndarray:
    """Smooth weights of the colour channels, H x W x 3, so that one number tests the whole image."""
    x = (np.arange(resolution) + 0.5) / resolution
    weights = 1 + 3 * x[None, :] + 2 * x[:, None] + 0.3 * np.sin(7 * x[None, :] + 1) * np.cos(5 * x[:, None])
    return (weights[..., None] * np.array([1.0, 0.7, 0.4])).astype(np.float32)


def forward_image(mover, integrator, spp, seed) -> np.ndarray:
    """The derivative of the image in forward mode, H x W x 4."""
    t = mi.Float(0)
    dr.enable_grad(t)
    mover.to(t)
    dr.set_grad(t, 1)
    image = mi.render(mover.scene, mover.params, integrator=integrator, spp=spp, seed=seed)
    return np.array(dr.forward_to(image))


def reverse_derivative(mover, integrator, spp, seed, weights) -> float:
    """The derivative of the weighted sum of colours in reverse mode."""
    t = mi.Float(0)
    dr.enable_grad(t)
    mover.to(t)
    image = mi.render(mover.scene, mover.params, integrator=integrator, spp=spp, seed=seed)
    dr.backward(dr.sum(image[:, :, :3] * mi.TensorXf(weights)))
    return float(dr.grad(t)[0])
