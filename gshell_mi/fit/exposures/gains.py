"""The gain of every view and channel, from what views see of the same places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ..judge import Verdict, verdict_of
from .observations import REGIONS, Observations

#: Steps of the robust regression, each of which weighs by the residuals of the one before.
_STEPS = 6

#: Degree of the polynomials of a mirrored direction and a normal, which tell gloss and a light that turns
#: with the camera.
_GLOSSY = 3

#: Standard deviation of their coefficients before anything was seen.
_FREE = 1.0

#: Angles between views, in degrees, over which a look may change, and shares of a gain's variance that it may
#: be. Views of a capture are rarely nearer to each other than the least angle.
_ANGLES, _SHARES = (20.0, 30.0, 45.0, 60.0, 90.0), np.linspace(0.02, 0.98, 49)

#: Variance of the gains, as a multiple of that of their noise, above which they count.
_CLEAR = 2.0

#: Residuals, of the logarithm of radiance, that are as good as none.
_EXACT = 1e-3


@dataclass(frozen=True)
class Gains:
    """How the views are exposed.

    Attributes:
        log_gain: (N, 3) natural logarithms of what multiplies each view's channels; 0 in the mean.
        noise: (N, 3) standard errors, by leaving out one region of the surface after the other.
        look: whether neighbouring views differ alike, which is no exposure; then that is left out.
        verdict: whether the gains that the rest of the surface tells explain each region.
    """

    log_gain: np.ndarray
    noise: np.ndarray
    look: bool
    verdict: Verdict

    @property
    def count(self) -> bool:
        """Whether they are to be used."""
        return bool(self.verdict.accepted[0]) and bool(self.log_gain.any())


def find_gains(seen: Observations, prior: float) -> Gains:
    """Solves for the gains, and for whether they count.

    The logarithm of what a view shows of a place is that of the place's colour, plus the view's gain, plus
    what depends on the direction: gloss, and a light that turns with the camera. All are sought at once, so a
    gain is what views disagree by on places that both see, as far as gloss does not explain it. Views that
    share no places with others have no gain.

    Metal, or a shape that is not right yet, looks darker from one side than from another, and neighbouring
    views look alike. Exposures do not know of each other. So gains are the sum of a random function of where
    views look from, and of exposures (kriging with a nugget; Matheron 1963).

    An exposure is the same all over an image. So each region of the surface is foretold by the others, and
    the judge's rule decides: the error of a view's sightings there, with gains and without, has to fall by
    more than two standard errors over the views. What differs between the regions is the noise of a gain. A
    gain as noisy as the gains vary beyond their noise counts half, and if that is not clear, there are none.

    Args:
        seen: the sightings.
        prior: standard deviation of the logarithm of a gain before anything was seen; the gains are taken to
            vary by no more.
    """
    columns = [_polynomials(vectors, _GLOSSY) for vectors in (seen.mirrored, seen.normal)]
    model = _Model(seen, np.concatenate(columns, axis=1), prior)
    views = np.unique(seen.view)
    gains = np.zeros((seen.views, 3))
    gains[views], look = _without_look(model.gains()[views], _toward(seen)[views])
    noise, verdict = model.foretold()
    variance = min((gains**2 - noise**2).mean(), prior**2)
    if variance <= _CLEAR * (noise**2).mean():
        return Gains(np.zeros_like(gains), noise, look, verdict)
    gains = gains * variance / (variance + noise**2)
    return Gains(gains - gains.mean(axis=0), noise, look, verdict)


class _Model:
    """Colours of places, gains of views and coefficients of directions that together explain sightings.

    Args:
        seen: the sightings.
        columns: (E, L) polynomials of their directions.
        prior: standard deviation of a gain's logarithm.
    """

    def __init__(self, seen: Observations, columns: np.ndarray, prior: float):
        self.seen, self.columns, self.prior = seen, columns, prior

    def gains(self) -> np.ndarray:
        """(N, 3) logarithms of the gains."""
        everything = np.ones(len(self.seen), bool)
        return np.stack([self._regression(everything, channel)[0] for channel in range(3)], axis=1)

    def foretold(self) -> tuple[np.ndarray, Verdict]:
        """(N, 3) how uncertain the gains are, and whether they count."""
        seen, views = self.seen, self.seen.views
        rays, before, after = (np.zeros(views) for _ in range(3))
        told = np.zeros((REGIONS, views, 3))
        for region in range(REGIONS):
            here = seen.region == region
            part = seen.only(here)
            for channel in range(3):
                found = self._regression(~here, channel)
                without = self._regression(~here, channel, exposed=False)
                told[region, :, channel] = found[0]
                weight = part.weight[:, channel]
                rays += np.bincount(part.view, weight, views)
                for total, model in ((before, without), (after, found)):
                    error = weight * np.abs(_residual(part, self.columns[here], channel, weight, *model))
                    total += np.bincount(part.view, error, views)
        # The jackknife: sightings of one region err alike, those of different ones do not.
        noise = np.sqrt(REGIONS - 1) * told.std(axis=0)
        return noise, verdict_of(rays[None], before[None], after[None])

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
        seen, columns = self.seen.only(chosen), self.columns[chosen]
        count, views = len(seen), seen.views
        of_view = sparse.csr_array((np.ones(count), (np.arange(count), seen.view)), (count, views))
        weight, scale = seen.weight[:, channel], 1.0
        deviation = np.concatenate([np.full(views, self.prior), np.full(columns.shape[1], _FREE)])
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
            scale = max(_weighted_median(residual, seen.weight[:, channel]), _EXACT)
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


def _without_look(gains: np.ndarray, toward: np.ndarray) -> tuple[np.ndarray, bool]:
    """What of (N, 3) gains does not depend on where the views look from, and whether anything does.

    Angle and share are the likeliest ones, if they are worth two parameters (Schwarz 1978).
    """
    if not gains.size:
        return gains, False

    def likelihood(parts: np.ndarray, variance: np.ndarray) -> float:
        """Twice its logarithm, but for a constant, with the scale of the (N, 1) variances that suits best."""
        volume = gains.shape[1] * np.log(variance).sum()
        return -gains.size * np.log((parts**2 / variance).mean() + _EXACT**2) - volume

    gains = gains - gains.mean(axis=0)
    likeliest, found = likelihood(gains, np.ones((len(gains), 1))) + 2 * np.log(gains.size), None
    for angle in _ANGLES:
        alike = np.exp((toward @ toward.T - 1) / np.radians(angle) ** 2)
        size, basis = np.linalg.eigh(alike)
        parts = basis.T @ gains
        for share in _SHARES:
            variance = (share * np.maximum(size, 0) + 1 - share)[:, None]
            if (value := likelihood(parts, variance)) > likeliest:
                likeliest, found = value, basis @ ((1 - share) * parts / variance)
    return (gains, False) if found is None else (found, True)


def _toward(seen: Observations) -> np.ndarray:
    """(N, 3) unit vectors to the cameras, from what they see in the mean."""
    sums = np.stack([np.bincount(seen.view, axis, seen.views) for axis in seen.toward.T], axis=1)
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)


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
