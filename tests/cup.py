"""A cup in a printed pattern: its hull is a solid block, as no silhouette shows its inside."""

from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from gshell_mi.compat import mesh_scene
from gshell_mi.fields import LatticeFields
from gshell_mi.fit.config import FitConfig
from gshell_mi.fit.judge import Judge
from gshell_mi.fit.stages.cavities import CavitiesConfig
from gshell_mi.fit.surface import Seen, Surface
from gshell_mi.pixels import PixelPool
from gshell_mi.radiance.surface_radiance import RadianceConfig
from gshell_mi.targets import Target
from gshell_mi.views import PinholeViews

#: Half the side of the block, how thick the walls are, and the views' pixels per side.
HALF, WALL, SIZE = 0.6, 0.15, 64

CONFIG = FitConfig(cavities=CavitiesConfig(iterations=400, batch=32768), radiance=RadianceConfig(batch=8192))


def block(low, high) -> trimesh.Trimesh:
    low, high = np.array(low, float), np.array(high, float)
    box = trimesh.creation.box(high - low)
    return box.apply_translation((low + high) / 2)


def cup(floor: float = 0.0, wall: float = WALL) -> trimesh.Trimesh:
    """Hollow above y = floor, half of it by default; open towards y = +HALF."""
    inner = HALF - wall
    walls = [
        ([-HALF, floor, -HALF], [-inner, HALF, HALF]),
        ([inner, floor, -HALF], [HALF, HALF, HALF]),
        ([-HALF, floor, -HALF], [HALF, HALF, -inner]),
        ([-HALF, floor, inner], [HALF, HALF, HALF]),
    ]
    bottom = block([-HALF] * 3, [HALF, floor, HALF])
    return trimesh.util.concatenate([bottom, *(block(*ends) for ends in walls)])


def solid_block() -> trimesh.Trimesh:
    return block([-HALF] * 3, [HALF] * 3)


def pattern(point: mi.Point3f) -> mi.Color3f:
    return mi.Color3f(*(1 + dr.sin(9 * point[i] + i) * dr.sin(7 * point[(i + 1) % 3]) for i in range(3)))


def capture(shape: trimesh.Trimesh | None = None) -> tuple[PinholeViews, PixelPool, list[Target]]:
    """The shape (default: the cup) with ``pattern`` as its radiance, seen from all around."""
    shape = cup() if shape is None else shape
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    look_at = mi.ScalarTransform4f().look_at
    views = PinholeViews.from_sensors(
        [
            mi.load_dict(
                {
                    "type": "perspective",
                    "fov": 35,
                    "film": film,
                    "to_world": look_at((4 * d).tolist(), [0, 0, 0], [0.1, 1, 0.2]),
                }
            )
            for d in trimesh.creation.icosphere(subdivisions=1).vertices
        ]
    )
    scene, targets, n = mesh_scene(shape.vertices, shape.faces), [], 4 * SIZE
    for index in range(len(views)):
        lane = dr.arange(mi.UInt32, n * n)
        ray = views.rays(
            dr.full(mi.UInt32, index, n * n), mi.Point2f((lane % n + 0.5) / n, (lane // n + 0.5) / n)
        )
        hit = scene.ray_intersect_preliminary(ray, coherent=False)
        color = dr.select(hit.is_valid(), pattern(ray(hit.t)), 0)
        samples = np.concatenate([color.numpy(), hit.is_valid().numpy()[None]]).reshape(4, SIZE, 4, SIZE, 4)
        rgba = np.ascontiguousarray(samples.mean(axis=(2, 4)).transpose(1, 2, 0).astype(np.float32))
        targets.append(Target(None, rgba, True))
    return views, PixelPool(views, targets), targets


def fit_of(subject: mi.Shape, shape: trimesh.Trimesh, config: FitConfig = CONFIG) -> SimpleNamespace:
    """What the stages read of a fit of a shape; every sixth view is held out."""
    views, pixels, targets = capture(shape)
    held_out = np.arange(len(views)) % 6 == 0
    training = PixelPool(views, targets, np.flatnonzero(~held_out))
    split = [(np.flatnonzero(~held_out), np.flatnonzero(held_out))]
    judges = [
        Judge(views, targets, splits, batch=config.radiance.batch)
        for splits in (Judge.halves(len(views)), split)
    ]
    return SimpleNamespace(
        scene=SimpleNamespace(subject=subject),
        views=views,
        pixels=pixels,
        config=config,
        training=training,
        judge=judges[0],
        outline_judge=Judge(
            views, targets, Judge.halves(len(views)), batch=config.radiance.batch, off_outline=0
        ),
        validation_judge=judges[1],
        cell=lambda surface: surface.lattice.spacing * subject.length_scale,
        mesh=lambda surface: subject.surface_of(surface.fields).to_numpy()[:2],
    )


def surface_of(sdf: np.ndarray, msdf: np.ndarray, grid: str = "tet") -> Surface:
    """A surface that is its own hull, of which nothing was seen."""
    sdf, msdf = (np.asarray(field, np.float32).ravel() for field in (sdf, msdf))
    seen = Seen(np.zeros((len(sdf), 3)), np.zeros(len(sdf), bool), np.float32(1))
    return Surface(replace(LatticeFields.closed(sdf, grid), msdf=msdf), hull=sdf, seen=seen)


def hull_of(resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The block's signed distance on the lattice (z by y by x), and its surface."""
    axis = np.linspace(-1, 1, resolution + 1)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    shape = solid_block()
    return np.maximum.reduce([abs(x), abs(y), abs(z)]) - HALF, np.array(shape.vertices), np.array(shape.faces)
