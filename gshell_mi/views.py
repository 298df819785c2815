"""Pinhole geometry of a set of Mitsuba sensors, packed for kernels that mix pixels of all views."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from .errors import UserError

#: Parameters of the two kinds of sensors: those that traversal shows, by their names in XML.
OPTICS = {
    "perspective": ("principal_point_offset_x", "principal_point_offset_y", "near_clip", "far_clip"),
    "thinlens": ("aperture_radius", "focus_distance", "near_clip", "far_clip"),
}


@dataclass(frozen=True)
class PinholeViews:
    """Projections of N perspective sensors.

    The direction through the film position ``(u, v)`` in [0, 1]^2 (crop window, v downwards), scaled
    to depth 1 along the optical axis, is ``basis @ (u, v, 1)``: exact for every sensor whose film
    is a plane, whatever its field of view, principal point or crop window.

    Attributes:
        ids: the sensors' ids.
        sizes: (N, 2) integers, width and height of each crop window in pixels.
        origins: (N, 3) centres of projection, world units.
        bases: (N, 3, 3) as above, world units.
        turns: (N, 3, 3) how what surrounds the object has turned in each view; None if it stays.
    """

    ids: tuple[str, ...]
    sizes: np.ndarray
    origins: np.ndarray
    bases: np.ndarray
    turns: np.ndarray | None = None

    @classmethod
    def from_sensors(cls, sensors: list[mi.Sensor]) -> PinholeViews:
        """Measures the sensors by the rays that they sample.

        Raises:
            UserError: a sensor is no perspective or thin-lens camera.
        """
        sizes, origins, bases = [], [], []
        for sensor in sensors:
            parameters = mi.traverse(sensor)
            if "x_fov" not in parameters:
                raise UserError(
                    f"Sensor '{sensor.id()}' is a {sensor.class_name()}, but a fit needs perspective "
                    f'sensors; use <sensor type="perspective"> or "thinlens".'
                )
            to_world = np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)
            forward = to_world[:3, 2] / np.linalg.norm(to_world[:3, 2])
            film = mi.Point2f([0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
            ray, _ = sensor.sample_ray_differential(0.0, 0.5, film, mi.Point2f(0.5))
            corners = np.array(ray.d, dtype=np.float64).T
            corners /= (corners @ forward)[:, None]
            bases.append(np.stack([corners[1] - corners[0], corners[2] - corners[0], corners[0]], axis=1))
            origins.append(to_world[:3, 3])
            sizes.append(sensor.film().crop_size())
        return cls(
            tuple(sensor.id() for sensor in sensors),
            np.array(sizes, dtype=np.int64),
            np.array(origins),
            np.array(bases),
        )

    def __len__(self) -> int:
        return len(self.ids)

    @cached_property
    def _table(self) -> mi.Float:
        """Four vectors per view on the device: the columns of its basis and its origin."""
        columns = np.concatenate([self.bases.transpose(0, 2, 1), self.origins[:, None]], axis=1)
        return mi.Float(columns.ravel())

    def rays(self, view: mi.UInt32, film: mi.Point2f) -> mi.Ray3f:
        """Rays through film positions ``film`` in [0, 1]^2 of the views with index ``view``."""
        across, down, corner, origin = (dr.gather(mi.Vector3f, self._table, 4 * view + i) for i in range(4))
        direction = dr.normalize(across * film.x + down * film.y + corner)
        return mi.Ray3f(mi.Point3f(origin), direction)

    def pixel_rays(self, view: int) -> mi.Ray3f:
        """The rays through the pixels' centres of one view, row by row."""
        width, height = (int(side) for side in self.sizes[view])
        pixel = dr.arange(mi.UInt32, width * height)
        row = pixel // dr.opaque(mi.UInt32, width)
        column = pixel - row * dr.opaque(mi.UInt32, width)
        size = dr.opaque(mi.Float, width), dr.opaque(mi.Float, height)
        film = mi.Point2f((column + 0.5) / size[0], (row + 0.5) / size[1])
        return self.rays(dr.opaque(mi.UInt32, view), film)

    @cached_property
    def _inverse_table(self) -> mi.Float:
        """Three vectors per view on the device: the rows of its basis' inverse."""
        return mi.Float(np.linalg.inv(self.bases).ravel())

    def project(self, view: int | mi.UInt32, points: mi.Point3f) -> tuple[mi.Point2f, mi.Float]:
        """Film positions in [0, 1]^2 and depths (world units along the axis) of points.

        Args:
            view: index of the view, one for all points or one each.
            points: world positions.

        Film positions of points at depth <= 0 have no meaning.
        """
        view = dr.opaque(mi.UInt32, view) if isinstance(view, int) else view
        offset = points - self.origins_of(view)
        scaled = [
            dr.dot(dr.gather(mi.Vector3f, self._inverse_table, 3 * view + row), offset) for row in range(3)
        ]
        return mi.Point2f(scaled[0], scaled[1]) / scaled[2], scaled[2]

    def origins_of(self, view: mi.UInt32) -> mi.Point3f:
        """Centres of projection of the views with index ``view``."""
        return dr.gather(mi.Point3f, self._table, 4 * view + 3)

    def in_surroundings(self, view: mi.UInt32, direction: mi.Vector3f) -> mi.Vector3f:
        """Directions in the frame of what surrounds the object in the views with index ``view``."""
        if self.turns is None:
            return direction
        axes = (dr.gather(mi.Vector3f, self._turn_table, 3 * view + axis) for axis in range(3))
        return mi.Vector3f(*(dr.dot(axis, direction) for axis in axes))

    @cached_property
    def _turn_table(self) -> mi.Float:
        """Three vectors per view on the device: the columns of its turn."""
        assert self.turns is not None
        return mi.Float(self.turns.transpose(0, 2, 1).ravel())

    def pixel_size(self, view: mi.UInt32) -> mi.Float:
        """Width of a pixel at depth 1 along the axis, in world units."""
        return dr.gather(mi.Float, self._pixel_sizes, view)

    @cached_property
    def _pixel_sizes(self) -> mi.Float:
        return mi.Float(np.linalg.norm(self.bases[:, :, 0], axis=1) / self.sizes[:, 0])


#: Plugins of reconstruction filters by the names of their classes.
_FILTERS = {
    "BoxFilter": "box",
    "GaussianFilter": "gaussian",
    "TentFilter": "tent",
    "MitchellNetravaliFilter": "mitchell",
    "CatmullRomFilter": "catmullrom",
    "LanczosSincFilter": "lanczos",
}


def filter_of(film: mi.Film) -> str:
    """The plugin of a film's reconstruction filter."""
    return _FILTERS.get(film.rfilter().class_name(), "gaussian")


def kind_of(sensor: mi.Sensor) -> str:
    """The plugin of a sensor that ``PinholeViews`` takes: one of ``OPTICS``."""
    return "thinlens" if "aperture_radius" in mi.traverse(sensor) else "perspective"
