"""What all of a surface mirrors of its surroundings, as a factor of its radiance.

The mirror image of the surroundings lies behind the surface. To whoever gives each place one colour, a
polished surface therefore looks like a window, and whatever is behind it explains the views better. So the
whole surface shares one factor over the mirrored direction: enough for highlights, and no single place can
use it to look deeper than it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..pixels import DARK

#: Degree of the spherical harmonics: about what a lobe of roughness 0.2 leaves of the surroundings. With 4,
#: the gilded crown of a bronze head is a window.
_DEGREE = 6

#: Number of harmonics without the constant one.
_COUNT = (_DEGREE + 1) ** 2 - 1

#: The factor is at least this.
_LEAST = 0.1

#: Relative errors of radiance larger than this are cut off: they are none of gloss.
_OUTLIER = 2.0

#: What may hold the coefficients at 0, over what images tell of one in the mean.
_RIDGES = np.geomspace(1e-3, 100, 11)


@dataclass(frozen=True)
class Mirrored:
    """A factor of radiance.

    Attributes:
        coefficients: (3, 48) of the real spherical harmonics of degrees 1 to 6, per colour channel.
    """

    coefficients: np.ndarray

    @classmethod
    def nothing(cls) -> Mirrored:
        """The factor 1."""
        return cls(np.zeros((3, _COUNT)))

    @classmethod
    def mean(cls, several: list[Mirrored]) -> Mirrored:
        """The mean of some factors."""
        return cls(np.mean([each.coefficients for each in several], axis=0))

    def factor(self, direction: mi.Vector3f) -> mi.Color3f:
        """The factor for unit directions, into which rays are mirrored."""
        total = [mi.Float(1) for _ in range(3)]
        for index, value in enumerate(_harmonics(direction)):
            for channel in range(3):
                total[channel] += value * dr.opaque(mi.Float, float(self.coefficients[channel, index]))
        return dr.maximum(mi.Color3f(*total), _LEAST)

    def improved(
        self, direction: mi.Vector3f, radiance: mi.Color3f, color: mi.Color3f, view: mi.UInt32
    ) -> Mirrored:
        """The factor that explains images best if the surface has given colours.

        Coefficients are held at 0 as much as suits views that did not tell them: rays of one view err alike,
        so few views tell little, however many rays they have.

        Args:
            direction: unit directions into which rays are mirrored.
            radiance: in the images.
            color: of the surface.
            view: index of the view that a ray is of.
        """
        order = np.argsort(view.numpy(), kind="stable")
        ends = np.flatnonzero(np.diff(view.numpy()[order])) + 1
        basis = np.stack([value.numpy()[order] for value in _harmonics(direction)])
        channels = (values.numpy()[:, order] for values in (radiance, color, color * self.factor(direction)))
        found = np.zeros_like(self.coefficients)
        for channel, (seen, own, now) in enumerate(zip(*channels, strict=True)):
            scale = 1 / np.maximum(own, max(DARK * own.mean(), 1e-9))
            slope = basis * (own * scale)
            change = np.clip((seen - now) * scale, -_OUTLIER, _OUTLIER)
            values = change + self.coefficients[channel] @ slope
            by_view = list(zip(np.split(slope, ends, axis=1), np.split(values, ends), strict=True))
            left = np.array([part @ part.T for part, _ in by_view], np.float64)
            right = np.array([part @ value for part, value in by_view], np.float64)
            found[channel] = _held(left, right)
        return Mirrored(found)


def _held(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(K,) solution of normal equations, with the largest ridge that foretells what is left out as well as
    the best one, up to a standard error (Breiman and others 1984).

    Args:
        left, right: (V, K, K) and (V, K), what each view adds to them.
    """
    total, count = left.sum(axis=0), len(right)
    unit = np.trace(total) / len(total) * np.eye(len(total)) + 1e-9 * np.eye(len(total))
    if count < 2:
        return np.linalg.solve(total + _RIDGES[-1] * unit, right.sum(axis=0))
    errors = []
    for ridge in _RIDGES:
        others = np.linalg.solve(total - left + ridge * unit, (right.sum(axis=0) - right)[..., None])[..., 0]
        errors.append(np.einsum("vi,vij,vj->v", others, left, others) - 2 * (others * right).sum(axis=1))
    worse = np.array(errors) - errors[np.argmin(np.sum(errors, axis=1))]
    as_good = worse.mean(axis=1) <= worse.std(axis=1) / np.sqrt(count - 1)
    return np.linalg.solve(total + _RIDGES[as_good].max() * unit, right.sum(axis=0))


def mirrored_direction(direction: mi.Vector3f, normal: mi.Vector3f) -> mi.Vector3f:
    """Where a ray along a unit ``direction`` is mirrored to, at normals of any length and sign."""
    normal = normal / dr.maximum(dr.norm(normal), 1e-12)
    return direction - 2 * dr.dot(direction, normal) * normal


def _harmonics(direction: mi.Vector3f) -> list[mi.Float]:
    return dr.sh_eval(direction, _DEGREE)[1:]
