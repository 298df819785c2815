"""The gain of every view and channel, from what views see of the same places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...calibration.observations import REGIONS, Observations
from ...calibration.regression import EXACT, ColorModel
from ..judge import Verdict, verdict_of

#: Angles between views, in degrees, over which a look may change, and shares of a gain's variance that it may
#: be. Views of a capture are rarely nearer to each other than the least angle.
_ANGLES, _SHARES = (20.0, 30.0, 45.0, 60.0, 90.0), np.linspace(0.02, 0.98, 49)

#: Variance of the gains, as a multiple of that of their noise, above which they count.
_CLEAR = 2.0


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
    model = ColorModel(seen, prior)
    views = np.unique(seen.view)
    gains = np.zeros((seen.views, 3))
    gains[views], look = _without_look(model.gains()[views], _toward(seen)[views])
    with_gains, without = model.foretold(), model.foretold(exposed=False)
    verdict = verdict_of(with_gains.rays[None], without.errors[None], with_gains.errors[None])
    # The jackknife: sightings of one region err alike, those of different ones do not.
    noise = np.sqrt(REGIONS - 1) * with_gains.gains.std(axis=0)
    variance = min((gains**2 - noise**2).mean(), prior**2)
    if variance <= _CLEAR * (noise**2).mean():
        return Gains(np.zeros_like(gains), noise, look, verdict)
    gains = gains * variance / (variance + noise**2)
    return Gains(gains - gains.mean(axis=0), noise, look, verdict)


def _without_look(gains: np.ndarray, toward: np.ndarray) -> tuple[np.ndarray, bool]:
    """What of (N, 3) gains does not depend on where the views look from, and whether anything does.

    Angle and share are the likeliest ones, if they are worth two parameters (Schwarz 1978).
    """
    if not gains.size:
        return gains, False

    def likelihood(parts: np.ndarray, variance: np.ndarray) -> float:
        """Twice its logarithm, but for a constant, with the scale of the (N, 1) variances that suits best."""
        volume = gains.shape[1] * np.log(variance).sum()
        return -gains.size * np.log((parts**2 / variance).mean() + EXACT**2) - volume

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
