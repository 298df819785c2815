"""The lobe's factors in closed form, and what it is for: highlights do not read as shape."""

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from gshell_mi.fit.radiance.gloss import _HEIGHT, _NODES, initial_lobe, mirrored_radiance
from gshell_mi.fit.radiance.surface_radiance import RadianceConfig, SurfaceRadiance
from gshell_mi.fit.refinement.refinement import PhotometricRefinement
from gshell_mi.fit.stages.refinement import RefinementConfig
from gshell_mi.pixels import PixelPool
from gshell_mi.targets import Target
from gshell_mi.views import PinholeViews


def reflected(lobe, normal, direction, gloss=0.0):
    normal, direction = (dr.normalize(mi.Vector3f(list(map(float, v)))) for v in (normal, direction))
    return np.ravel(mirrored_radiance(lobe, mi.Float(gloss), normal, direction))


def test_at_first_it_is_schlick_under_an_even_sky():
    lobe = initial_lobe(3, 2.0)
    np.testing.assert_allclose(reflected(lobe, [0, 0, 1], [0, 0, -1]), 0.04 * 2, rtol=1e-4)
    np.testing.assert_allclose(reflected(lobe, [0, 0, 1], [0, 0, -1], np.log(3.0)), 3 * 0.04 * 2, rtol=1e-4)
    cosine = 3 / (_NODES - 1)
    slanted = [np.sqrt(1 - cosine**2), 0, -cosine]
    schlick = 0.04 + 0.96 * (1 - cosine) ** 5
    np.testing.assert_allclose(reflected(lobe, [0, 0, 1], slanted), schlick * 2, rtol=1e-3)


def test_the_mirrored_texel_is_seen():
    lobe = initial_lobe(3, 1.0)
    image = np.zeros((_HEIGHT, 2 * _HEIGHT, 3), np.float32)
    row, column = 5, 20
    image[row, column] = np.log([10, 20, 30])
    lobe["surroundings"] = mi.Float(image.ravel())
    polar, azimuth = (row + 0.5) / _HEIGHT * np.pi, ((column + 0.5) / (2 * _HEIGHT) - 0.5) * 2 * np.pi
    towards = np.array([np.sin(polar) * np.sin(azimuth), np.cos(polar), np.sin(polar) * np.cos(azimuth)])
    np.testing.assert_allclose(reflected(lobe, towards, -towards), 0.04 * np.array([10, 20, 30]), rtol=1e-3)
    aside = np.cross(towards, [0, 1, 0])
    # Comes in from one side of the normal, leaves to the other.
    normal = towards + aside / np.linalg.norm(aside)
    away = reflected(lobe, normal, -(2 * (normal @ towards) / (normal @ normal) * normal - towards))
    np.testing.assert_allclose(away / away[0], [1, 2, 3], rtol=1e-2)


def test_the_surroundings_have_no_seam():
    lobe = initial_lobe(3, 1.0)
    lobe["surroundings"] = mi.Float(np.random.default_rng(0).normal(size=6 * _HEIGHT**2).astype(np.float32))
    left, right = (reflected(lobe, [side * 1e-4, 0.3, -1], [-side * 1e-4, -0.3, 1]) for side in (1, -1))
    np.testing.assert_allclose(left, right, rtol=1e-2)


# --- a glossy sphere: its highlights move over it as the camera does

RADIUS, SIZE = 0.5, 48
CELL = 2 / 32
RADIANCE = RadianceConfig(batch=8192, smoothing=1.0)
CONFIG = RefinementConfig(iterations=80, smoothing=6.3, detail=3.1, lr=0.2)


def cameras() -> list[mi.Sensor]:
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    look_at = mi.ScalarTransform4f().look_at
    return [mi.load_dict({"type": "perspective", "fov": 35, "film": film,
                          "to_world": look_at((3 * d).tolist(), [0, 0, 0], [0.1, 1, 0.2])})
            for d in trimesh.creation.icosphere(subdivisions=1).vertices]


def glossy_sphere() -> tuple[PinholeViews, PixelPool]:
    """One grey, and the mirror image of a sky with a bright side."""
    views, targets = PinholeViews.from_sensors(cameras()), []
    for index in range(len(views)):
        lane = dr.arange(mi.UInt32, (4 * SIZE) ** 2)
        film = mi.Point2f((lane % (4 * SIZE) + 0.5) / (4 * SIZE), (lane // (4 * SIZE) + 0.5) / (4 * SIZE))
        ray = views.rays(dr.full(mi.UInt32, index, dr.width(lane)), film)
        half = dr.dot(ray.o, ray.d)
        root = dr.square(half) - dr.squared_norm(ray.o) + RADIUS**2
        normal = (ray(-half - dr.sqrt(dr.maximum(root, 0)))) / RADIUS
        mirrored = ray.d - 2 * dr.dot(ray.d, normal) * normal
        radiance = 0.3 + 0.5 * dr.exp(3 * (mirrored.x - 1)) + 0.3 * dr.exp(3 * (mirrored.y - 1))
        covered = root > 0
        gray = dr.select(covered, radiance, 0).numpy()
        samples = np.stack([gray, gray, gray, covered.numpy()]).reshape(4, SIZE, 4, SIZE, 4)
        rgba = np.ascontiguousarray(samples.mean(axis=(2, 4)).transpose(1, 2, 0).astype(np.float32))
        targets.append(Target(None, rgba, True))
    return views, PixelPool(views, targets)


def test_highlights_pull_the_surface_inwards_far_less():
    views, pixels = glossy_sphere()
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    offsets = {}
    for glossy in (False, True):
        appearance = SurfaceRadiance(vertices, faces, views, pixels, RADIANCE, glossy=glossy)
        for _ in range(3):
            appearance.refit(np.ones(len(vertices), bool))
        refinement = PhotometricRefinement(appearance, vertices, faces, None, CELL, CONFIG)
        for step in range(CONFIG.iterations):
            refinement.step(step)
        offsets[glossy] = (np.linalg.norm(refinement.positions(), axis=1) - RADIUS).mean() / CELL
    assert offsets[False] < -0.2
    assert abs(offsets[True]) < 0.65 * abs(offsets[False])
