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

from ...pixels import DARK

#: Degree of the spherical harmonics: about what a lobe of roughness 0.2 leaves of the surroundings. With four,
#: the gilded crown of a bronze head is taken for a window.
_DEGREE = 6

#: Number of harmonics without the constant one.
_COUNT = (_DEGREE + 1) ** 2 - 1

#: The factor is at least this.
_LEAST = 0.1

#: Relative errors of radiance larger than this are cut off: they are none of gloss.
_OUTLIER = 2.0

#: Variance of a coefficient that is expected, over that of the noise of a ray.
_RIDGE = 1e-3


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

    def improved(self, samples: list[tuple[mi.Vector3f, mi.Color3f, mi.Color3f]]) -> Mirrored:
        """The factor that explains images best if the surface has given colours.

        Args:
            samples: of rays, the mirrored directions, the radiance in the images, and the colours. Without
                any, nothing changes.
        """
        left, right = np.zeros((3, _COUNT, _COUNT)), np.zeros((3, _COUNT))
        for direction, radiance, color in samples:
            basis = np.stack([value.numpy() for value in _harmonics(direction)])
            explained = (color * self.factor(direction)).numpy()
            for channel, (seen, own, now) in enumerate(
                zip(radiance.numpy(), color.numpy(), explained, strict=True)
            ):
                scale = 1 / np.maximum(own, max(DARK * own.mean(), 1e-9))
                slope = basis * (own * scale)
                left[channel] += slope @ slope.T
                right[channel] += slope @ np.clip((seen - now) * scale, -_OUTLIER, _OUTLIER)
        ridge = _RIDGE * np.trace(left, axis1=1, axis2=2)[:, None, None] / _COUNT + 1e-9
        change = np.linalg.solve(left + ridge * np.eye(_COUNT), right[..., None])[..., 0]
        return Mirrored(self.coefficients + change)


def mirrored_direction(direction: mi.Vector3f, normal: mi.Vector3f) -> mi.Vector3f:
    """Where a ray along a unit ``direction`` is mirrored to, at normals of any length and sign."""
    normal = normal / dr.maximum(dr.norm(normal), 1e-12)
    return direction - 2 * dr.dot(direction, normal) * normal


def _harmonics(direction: mi.Vector3f) -> list[mi.Float]:
    return dr.sh_eval(direction, _DEGREE)[1:]
