"""The one camera convention that every importer translates into."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

#: Columns of our camera axes (right, down, forward) in Mitsuba's (left, up, forward), and the reverse.
_MITSUBA_AXES = np.diag([-1.0, -1.0, 1.0, 1.0])
#: The same in OpenGL's, Blender's and NeRF's (right, up, backward).
_OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Distortion:
    """Brown-Conrady lens distortion as OpenCV and COLMAP write it, with two further radial terms.

    A point at ``(x, y)`` = (right, down) / forward is seen at ``x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) +
    2 p1 x y + p2 (r² + 2 x²)`` and ``y (...) + p1 (r² + 2 y²) + 2 p2 x y`` with ``r² = x² + y²``.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def __bool__(self) -> bool:
        return any((self.k1, self.k2, self.p1, self.p2, self.k3, self.k4))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Where the lens shows ideal points ``(..., 2)``.

        >>> Distortion(k1=0.1).apply(np.array([1.0, 0.0]))
        array([1.1, 0. ])
        """
        x, y = points[..., 0], points[..., 1]
        rr = x * x + y * y
        radial = 1 + rr * (self.k1 + rr * (self.k2 + rr * (self.k3 + rr * self.k4)))
        return np.stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (rr + 2 * x * x),
                y * radial + self.p1 * (rr + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            axis=-1,
        )

    def folds_at(self) -> float:
        """The radius ``r`` from which on the radial part runs backwards; infinity if it never does.

        >>> round(Distortion(k1=-0.3).folds_at() ** 2, 4)     # where 1 + 3 k1 r² = 0
        1.1111
        """
        # d/dr of r (1 + k1 r² + ...), a polynomial in r²
        roots = np.roots([9 * self.k4, 7 * self.k3, 5 * self.k2, 3 * self.k1, 1.0])
        real = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real
        return float(np.sqrt(real.min())) if real.size else float("inf")


@dataclass(frozen=True)
class Camera:
    """A posed camera.

    Pixel coordinates have their origin at the outer corner of the upper left pixel, x to the right and y
    down, so that the first pixel's centre is (0.5, 0.5) and an image's is (width / 2, height / 2). The
    camera's own axes are x to the right, y down and z forward (those of OpenCV and COLMAP).

    Attributes:
        width, height: size of the image in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels.
        to_world: (4, 4) rigid camera-to-world matrix; its last column is the centre of projection.
        distortion: of the lens.
        rfilter: Mitsuba's reconstruction filter whose footprint the pixels have; a sensor's pixels
            average over their area.

    >>> camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))
    >>> camera.project(np.array([[0.0, 0.0, 2.0], [0.2, 0.0, 1.0]]))
    array([[32., 24.],
           [42., 24.]])
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    to_world: np.ndarray
    distortion: Distortion = field(default_factory=Distortion)
    rfilter: str = "box"

    @property
    def center(self) -> np.ndarray:
        """Centre of projection in the world."""
        return self.to_world[:3, 3]

    @property
    def forward(self) -> np.ndarray:
        """Unit direction of the optical axis in the world."""
        return self.to_world[:3, 2]

    @property
    def up(self) -> np.ndarray:
        """Unit direction of the image's upward axis in the world."""
        return -self.to_world[:3, 1]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixel coordinates (n, 2) of world points (n, 3); without meaning for those behind the camera."""
        local = (np.asarray(points) - self.center) @ self.to_world[:3, :3]
        ideal = local[:, :2] / local[:, 2:]
        seen = self.distortion.apply(ideal) if self.distortion else ideal
        return seen * [self.fx, self.fy] + [self.cx, self.cy]

    def project_front(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixel coordinates (n, 2) of world points (n, 3), and (n,) whether they are before the camera; those
        that are not have the coordinates of the optical axis."""
        front = (points - self.center) @ self.forward > 1e-9
        return self.project(np.where(front[:, None], points, self.center + self.forward)), front

    def basis(self) -> np.ndarray:
        """(3, 3) matrix from the film position (u, v, 1), u and v in [0, 1], to a world direction of depth 1.

        Of the camera without its distortion; as in ``gshell_mi.views.PinholeViews``.
        """
        film = np.array(
            [
                [self.width / self.fx, 0, -self.cx / self.fx],
                [0, self.height / self.fy, -self.cy / self.fy],
                [0, 0, 1],
            ]
        )
        return self.to_world[:3, :3] @ film

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for a copy of its image in another size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def moved(self, transform: np.ndarray) -> Camera:
        """The same camera in a world that ``transform`` (4, 4), a rigid motion, has moved."""
        return replace(self, to_world=transform @ self.to_world)

    @classmethod
    def opengl_pose(cls, to_world: np.ndarray) -> np.ndarray:
        """``to_world`` of a matrix whose camera axes are right, up, backward (OpenGL, Blender, NeRF)."""
        return to_world @ _OPENGL_AXES

    @classmethod
    def mitsuba_pose(cls, to_world: np.ndarray) -> np.ndarray:
        """``to_world`` of a matrix whose camera axes are left, up, forward (Mitsuba); its own inverse."""
        return to_world @ _MITSUBA_AXES


def rigid(matrix: np.ndarray) -> np.ndarray:
    """The rigid motion in a (4, 4) camera-to-world matrix, freed of uniform scale and rounding.

    Raises:
        ValueError: what is wrong, as the rest of a sentence ("is ..."), if it is none.

    >>> rigid(np.diag([2.0, 2.0, 2.0, 1.0]))[0]
    array([1., 0., 0., 0.])
    """
    if not np.isfinite(matrix).all():
        raise ValueError("holds NaN or infinity")
    if np.abs(matrix).max() > 1e12:
        raise ValueError("holds numbers too large for a position")
    linear = matrix[:3, :3]
    scale = np.cbrt(abs(np.linalg.det(linear)))
    if scale < 1e-9:
        raise ValueError("is singular")
    if np.linalg.det(linear) < 0:
        raise ValueError("is mirrored (its determinant is negative)")
    u, _, vt = np.linalg.svd(linear / scale)
    if np.abs(u @ vt - linear / scale).max() > 0.01:
        raise ValueError("is no rotation (its columns are not orthogonal unit vectors)")
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError("does not end in the row 0 0 0 1")
    result = np.eye(4)
    result[:3, :3] = u @ vt
    result[:3, 3] = matrix[:3, 3]
    return result
