"""Colours of places, gains of views and coefficients of directions that together explain sightings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from .observations import REGIONS, Observations

#: Steps of the robust regression, each of which weighs by the residuals of the one before.
_STEPS = 6

#: Degree of the polynomials of directions: of a mirrored one and of a normal, which tell gloss and a light
#: that turns with the camera, and of the cosine between normal and view, which tells dark edges.
_DEGREE = 3

#: Standard deviation of their coefficients before anything was seen.
_FREE = 1.0

#: Residuals, of the logarithm of radiance, that are as good as none.
EXACT = 1e-3


@dataclass(frozen=True)
class Foretold:
    """What each region of a surface shows, as all others foretell it.

    Attributes:
        rays: (N,) how much each view tells.
        errors: (N,) sums of the residuals.
        gains: (R, N, 3) logarithms of the gains that are known without each region.
    """

    rays: np.ndarray
    errors: np.ndarray
    gains: np.ndarray


class ColorModel:
    """The logarithm of what a view shows of a place is that of the place's colour, plus the view's gain, plus
    what depends on directions.

    Args:
        seen: the sightings.
        prior: standard deviation of a gain's logarithm.
    """

    def __init__(self, seen: Observations, prior: float):
        cosine = (seen.normal * seen.toward).sum(axis=1)
        self._columns = np.concatenate(
            [
                _polynomials(seen.mirrored, _DEGREE),
                _polynomials(seen.normal, _DEGREE),
                cosine[:, None] ** np.arange(1, _DEGREE + 1),
            ],
            axis=1,
        )
        self._seen, self._prior = seen, prior

    def gains(self) -> np.ndarray:
        """(N, 3) logarithms of the gains."""
        everything = np.ones(len(self._seen), bool)
        return np.stack([self._regression(everything, channel)[0] for channel in range(3)], axis=1)

    def foretold(self, *, exposed: bool = True) -> Foretold:
        """Tells each region from the others, with gains or without."""
        seen, views = self._seen, self._seen.views
        found = Foretold(np.zeros(views), np.zeros(views), np.zeros((REGIONS, views, 3)))
        for region in range(REGIONS):
            here = seen.region == region
            part = seen.only(here)
            for channel in range(3):
                told, weight = self._regression(~here, channel, exposed=exposed), part.weight[:, channel]
                error = np.abs(_residual(part, self._columns[here], channel, weight, *told))
                found.rays[:] += np.bincount(part.view, weight, views)
                found.errors[:] += np.bincount(part.view, weight * error, views)
                found.gains[region, :, channel] = told[0]
        return found

    def _regression(
        self, chosen: np.ndarray, channel: int, *, exposed: bool = True
    ) -> tuple[np.ndarray, np.ndarray]:
        """Huber's robust regression.

        Args:
            chosen: (E,) the sightings that count.
            channel: of the three.
            exposed: whether there are gains.

        Returns:
            (N,) logarithms of the gains and (L,) coefficients.
        """
        seen, columns = self._seen.only(chosen), self._columns[chosen]
        count, views = len(seen), seen.views
        of_view = sparse.csr_array((np.ones(count), (np.arange(count), seen.view)), (count, views))
        weight, scale = seen.weight[:, channel], 1.0
        deviation = np.concatenate([np.full(views, self._prior), np.full(columns.shape[1], _FREE)])
        free = np.arange(len(deviation)) >= (0 if exposed else views)
        found = np.zeros(len(deviation))
        for _ in range(_STEPS):
            weighted = weight[:, None] * columns
            cross, value = of_view.T @ weighted, weight * seen.log_radiance[:, channel]
            matrix = np.block([[np.diag(of_view.T @ weight), cross], [cross.T, columns.T @ weighted]])
            right = np.concatenate([of_view.T @ value, columns.T @ value])
            # A place's colour is the mean of what is left there: that is eliminated.
            of_place = np.concatenate(
                [(seen.places @ (of_view * weight[:, None])).toarray(), seen.places @ weighted], axis=1
            )
            total = np.maximum(seen.places @ weight, 1e-12)
            matrix -= of_place.T @ (of_place / total[:, None])
            right -= of_place.T @ ((seen.places @ value) / total)
            matrix = matrix[np.ix_(free, free)] + np.diag((scale / deviation[free]) ** 2)
            found[free] = np.linalg.solve(matrix, right[free])
            residual = np.abs(_residual(seen, columns, channel, weight, found[:views], found[views:]))
            scale = max(_weighted_median(residual, seen.weight[:, channel]), EXACT)
            weight = seen.weight[:, channel] * np.minimum(1, scale / np.maximum(residual, 1e-12))
        return found[:views], found[views:]


def _residual(
    seen: Observations,
    columns: np.ndarray,
    channel: int,
    weight: np.ndarray,
    gain: np.ndarray,
    coefficients: np.ndarray,
) -> np.ndarray:
    """(E,) what is left of the logarithms, where each place has the colour that suits best."""
    left = seen.log_radiance[:, channel] - gain[seen.view] - columns @ coefficients
    color = (seen.places @ (weight * left)) / np.maximum(seen.places @ weight, 1e-12)
    return left - seen.places.T @ color


def _polynomials(vectors: np.ndarray, degree: int) -> np.ndarray:
    """(E, L) polynomials of (E, 3) unit vectors that span all up to a degree, but for the constant one."""
    x, y, z = vectors.T
    # A square of z is 1 less the others.
    return np.stack(
        [
            x ** (total - high - flat) * y**high * z**flat
            for total in range(1, degree + 1)
            for flat in range(2)
            for high in range(total - flat + 1)
        ],
        axis=1,
    )


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    if not len(values):
        return 0.0
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, reached[-1] / 2)])
