"""Small rigid corrections of cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from ..views import OPTICS, PinholeViews, kind_of


@dataclass(frozen=True)
class Corrections:
    """Of N cameras.

    Attributes:
        rotations: (N, 3) rotation vectors about the centres of projection, world axes, radians.
        shifts: (N, 3) of the centres of projection, world units.
    """

    rotations: np.ndarray
    shifts: np.ndarray

    @classmethod
    def from_array(cls, array: np.ndarray) -> Corrections:
        """What ``to_array`` gave."""
        return cls(array[:, :3], array[:, 3:])

    def to_array(self) -> np.ndarray:
        """(N, 6): rotations and shifts."""
        return np.concatenate([self.rotations, self.shifts], axis=1)

    def after(self, first: Corrections) -> Corrections:
        """Both: these of cameras that others have corrected first."""
        turns = Rotation.from_rotvec(self.rotations) * Rotation.from_rotvec(first.rotations)
        return Corrections(turns.as_rotvec(), self.shifts + first.shifts)

    def inverse(self) -> Corrections:
        """Those that take these back."""
        return Corrections(-self.rotations, -self.shifts)

    def views(self, given: PinholeViews) -> PinholeViews:
        """The given views, corrected."""
        turned = Rotation.from_rotvec(self.rotations).as_matrix() @ given.bases
        return replace(given, origins=given.origins + self.shifts, bases=turned)

    def sensors(self, given: list[mi.Sensor]) -> list[mi.Sensor]:
        """New sensors like the given ones, corrected; they share the films."""
        turns = Rotation.from_rotvec(self.rotations).as_matrix()
        return [_moved(*each) for each in zip(given, turns, self.shifts, strict=True)]

    def as_given(self, views: PinholeViews, weight: np.ndarray | None = None) -> Corrections:
        """The same without what all cameras have in common.

        The scene could be turned, moved and scaled together with the cameras, and no image would change. So
        in the mean they stay as they were given: in orientation, place, and distance from their middle.

        Args:
            views: as given.
            weight: (N,) how much each has to say in that; default: all the same.
        """
        share = np.ones(len(views)) if weight is None else weight
        share = (share / share.sum())[:, None]
        turns, moved = Rotation.from_rotvec(self.rotations), views.origins + self.shifts
        middle = (share * views.origins).sum(axis=0)
        a, b = moved - (share * moved).sum(axis=0), views.origins - middle
        # Procrustes: orientations and places have the same say (Kabsch 1976).
        size_a, size_b = (max(float(np.sqrt((share * each**2).sum())), 1e-12) for each in (a, b))
        mean_turn = (share[..., None] * turns.as_matrix()).sum(axis=0)
        u, _, vt = np.linalg.svd((share * b).T @ a / (size_a * size_b) + mean_turn.T)
        turn = Rotation.from_matrix(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)
        moved = size_b / size_a * turn.apply(a) + middle
        return Corrections((turn * turns).as_rotvec(), moved - views.origins)

    def in_pixels(self, views: PinholeViews, points: np.ndarray) -> np.ndarray:
        """(N,) mean distances by which points (P, 3) move in the images; 0 where none is in the image.

        Args:
            views: as given.
            points: of the surface, world units.
        """
        moved, found = self.views(views), np.zeros(len(views))
        for view in range(len(views)):
            here = projected(points - views.origins[view], views, view)
            framed = ((here > -0.5) & (here < views.sizes[view] - 0.5)).all(axis=1)
            framed &= (points - views.origins[view]) @ np.linalg.inv(views.bases[view])[2] > 0
            if framed.any():
                there = projected(points[framed] - moved.origins[view], moved, view)
                found[view] = np.linalg.norm(there - here[framed], axis=1).mean()
        return found


def projected(offsets: np.ndarray, views: PinholeViews, view: int) -> np.ndarray:
    """(K, 2) pixels, centres at integers, of (K, 3) offsets from a centre of projection."""
    scaled = offsets @ np.linalg.inv(views.bases[view]).T
    return scaled[:, :2] / scaled[:, 2:] * views.sizes[view] - 0.5


def _moved(sensor: mi.Sensor, turn: np.ndarray, shift: np.ndarray) -> mi.Sensor:
    parameters = mi.traverse(sensor)
    kind = kind_of(sensor)
    to_world = np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    to_world[:3, :3] = turn @ to_world[:3, :3]
    to_world[:3, 3] += shift
    return mi.load_dict(
        {
            "type": kind,
            "id": sensor.id(),
            "fov": float(parameters["x_fov"][0]),
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f(to_world),
            **{name: float(np.ravel(parameters[name])[0]) for name in OPTICS[kind]},
            "film": sensor.film(),
            "sampler": sensor.sampler(),
        }
    )
