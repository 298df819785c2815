"""Finite differences with little noise: images as integrals over surfaces.

A pixel is the integral over all surfaces of filter x radiance x visibility x d(film area)/d(surface area).
Its samples are points of the surfaces: they move with them and keep their random numbers, so that two images
a small step apart differ by little noise, also where silhouettes cross the film. Radiance is what the stock
``path`` integrator returns along the camera ray through the point. Nothing here is code of ``gshell_path``.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

#: Share of the distance to the camera within which a ray is taken to have reached its point
_TOLERANCE = 1e-4


class SurfaceImage:
    """Images of a scene whose emitters are hidden, from points that keep their place on its meshes.

    Parameters
    ----------
    mover:
        A :class:`~pipelines.gradient_scenes.Mover`.
    case:
        Its :class:`~pipelines.gradient_scenes.GradientScene`.
    count:
        How many points: half of them on the subject, the others where static meshes project on the film.
    seed:
        Of the points and of the paths from them.
    """

    def __init__(self, mover, case, count, seed):
        self.mover, self.seed = mover, seed
        self.scene = mover.scene
        self.sensor = self.scene.sensors()[0]
        self.to_camera = self.sensor.world_transform().inverse()
        fov = mi.traverse(self.sensor)["x_fov"]  # of a film without crop window
        self.focal_length = self.sensor.film().size().x / 2 / dr.tan(dr.deg2rad(fov) / 2)
        self.integrator = mi.load_dict({"type": "path", "max_depth": case.depth, "hide_emitters": True})
        random = np.random.default_rng(seed)
        meshes = [shape for shape in self.scene.shapes() if shape.is_mesh() and shape.emitter() is None]
        self.points = []
        for mesh in meshes:
            static = mesh.id() != "subject"
            # Of static meshes the points outside the frame are dropped at once.
            points = _points(mesh, count // 2 * (4 if static else 2 if len(meshes) == 1 else 1), random)
            if static:
                points = _take(points, dr.compress(self._project(mesh, *points)[2]))
            self.points.append((mesh, *points))
        self.unit = self._splat([(*_film_grid(self.sensor.film(), 16), [mi.Float(1 / 256)])], 1)

    def at(self, t) -> np.ndarray:
        """The image (H x W x 4: colour and coverage) for a value of the scene's parameter."""
        self.mover.to(mi.Float(t))
        image = self._splat([self._seen(k, *points) for k, points in enumerate(self.points)], 4)
        self.mover.to(mi.Float(0))
        return image / self.unit

    def difference(self, step) -> np.ndarray:
        """Central difference, extrapolated (Richardson) from steps ``step`` and ``2 step``."""
        one, two = ((self.at(h) - self.at(-h)) / (2 * h) for h in (step, 2 * step))
        return (4 * one - two) / 3

    def _project(self, mesh, face, bary, share):
        """World and film positions, whether these are on the film, and the film area of the points."""
        p, q, r = (mesh.vertex_position(i) for i in mesh.face_indices(face))
        x = p + (q - p) * bary.x + (r - p) * bary.y
        # Not by the sensor's sample_direction(), which knows no border of the film
        local = mi.Vector3f(self.to_camera @ mi.Point3f(x))
        d = dr.normalize(local)
        size = mi.Vector2f(self.sensor.film().crop_size())
        uv = mi.Point2f(0.5 * size - self.focal_length * mi.Vector2f(local.x, local.y) / local.z)
        border = _border(self.sensor.film())
        inside = (local.z > self.sensor.near_clip()) & dr.all((uv > -border) & (uv < size + border))
        normal = self.to_camera @ mi.Vector3f(0.5 * dr.cross(q - p, r - p))
        area = dr.abs_dot(normal, d) / dr.squared_norm(local) * self.focal_length**2 / d.z**3
        return mi.Point3f(x), uv, inside, area * share

    def _seen(self, k, mesh, *points):
        """Film positions of the points of a mesh, which of them are seen, and their channels."""
        x, uv, inside, area = self._project(mesh, *points)
        ray, _ = self.sensor.sample_ray_differential(
            0.0, 0.0, uv / mi.Point2f(self.sensor.film().crop_size()), mi.Point2f(0.5)
        )
        to_point = mi.Ray3f(ray.o, ray.d, dr.norm(x - ray.o) * (1 - _TOLERANCE), 0.0, mi.Color0f())
        seen = inside & ~self.scene.ray_test(to_point, inside)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(16 * self.seed + k, dr.width(x))
        value, _, _ = self.integrator.sample(self.scene, sampler, ray, None, seen)
        return uv, seen, [*(c * area for c in value), area]

    def _splat(self, samples, channels):
        film = self.sensor.film()
        block = mi.ImageBlock(
            film.crop_size(),
            film.crop_offset(),
            channels,
            rfilter=film.rfilter(),
            border=False,
            coalesce=False,
        )
        for u, active, values in samples:
            block.put(u + mi.Vector2f(film.crop_offset()), values, active)
        return np.array(block.tensor(), np.float64)


def _points(mesh, count, random):
    """Points spread by area: face, barycentric coordinates, and the share of its face it stands for."""
    corners = np.array(mesh.faces_buffer()).reshape(-1, 3)
    p, q, r = (np.array(mesh.vertex_positions_buffer()).reshape(-1, 3)[corners[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(q - p, r - p), axis=1)
    on_face = np.maximum(np.round(area / area.sum() * count).astype(int), area > 0)
    face = np.repeat(np.arange(len(area)), on_face)
    # A Kronecker sequence (Roberts 2018) through all faces covers each of them evenly.
    golden = 1.32471795724474602596
    u = (np.arange(len(face))[:, None] * [1 / golden, 1 / golden**2] + random.random(2)) % 1
    bary = mi.warp.square_to_uniform_triangle(mi.Point2f(u.T.astype(np.float32)))
    dr.eval(bary)
    return mi.UInt32(face.astype(np.uint32)), bary, mi.Float((1 / on_face[face]).astype(np.float32))


def _take(arrays, index):
    return tuple(dr.gather(type(x), x, index) for x in arrays)


def _border(film):
    return film.rfilter().border_size() if film.sample_border() else 0


def _film_grid(film, n):
    """Positions n x n per pixel over all that the film samples."""
    border = _border(film)
    axes = [(np.arange((size + 2 * border) * n) + 0.5) / n - border for size in film.crop_size()]
    x, y = (a.ravel().astype(np.float32) for a in np.meshgrid(*axes))
    return mi.Point2f(x, y), mi.Bool(True)
