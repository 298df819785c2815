"""Corrections of cameras that a surface's texture and outline ask for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...views import PinholeViews
from ..judge import Verdict, verdict_of
from .corrections import Corrections, projected
from .evidence import Evidence

#: Standard deviation of a rotation, in radians, and of a shift over the distance, before anything was seen.
_FIRST_GUESS = np.radians(0.3)

#: Side of the squares, in pixels, that images are parted into two halves by; residuals are alike within one.
_SQUARE = 24

#: Residuals beyond so many times their median are taken for those of something else.
_OUTLIER = 1.5

#: Rounds in which the spread of the corrections is found.
_EMPIRICAL_BAYES = 20

#: Median of chi squared with six degrees of freedom.
_CHI2_MEDIAN = 5.348

#: Step, in radians or parts of the distance, that tells the derivatives of what is seen.
_STEP = 1e-4


@dataclass(frozen=True)
class _Normal:
    """Normal equations of N views, of two halves of each image: of the six numbers of a correction.

    Attributes:
        matrix: (N, 2, 6, 6).
        right: (N, 2, 6).
        variance: of a residual.
    """

    matrix: np.ndarray
    right: np.ndarray
    variance: float


class Alignment:
    """Finds corrections by Gauss-Newton steps (Lucas and Kanade 1981), each view for itself.

    How far to go is told by the views together. Two halves of each image tell how much of a step is noise;
    what the steps vary by beyond that is how wrong cameras are, and each is corrected as far as its own
    evidence is better than that (empirical Bayes; James and Stein 1961). So exact cameras stay.

    Args:
        views: as given.
        distance: from the cameras to the object, about; the unit of shifts.
    """

    def __init__(self, views: PinholeViews, distance: float):
        self.given, self._distance = views, distance
        self.corrections = Corrections(np.zeros((len(views), 3)), np.zeros((len(views), 3)))
        self._spread = np.full(6, _FIRST_GUESS**2)
        self._noise: dict[int, float] = {}

    @property
    def views(self) -> PinholeViews:
        """Corrected so far."""
        return self.corrections.views(self.given)

    def step(self, kinds: Sequence[Sequence[Evidence]]) -> None:
        """One step, by one evidence or more of all views."""
        views = self.views
        now = self.corrections.to_array() / self._units
        information, pull = np.zeros((len(views), 6, 6)), np.zeros((len(views), 6))
        for kind, evidence in enumerate(kinds):
            normal = self._normal(evidence, views)
            noise = normal.variance * self._excess(kind, normal, now)
            information += normal.matrix.sum(axis=1) / noise
            pull += normal.right.sum(axis=1) / noise
        pull += np.einsum("nij,nj->ni", information, now)
        for _ in range(_EMPIRICAL_BAYES):
            posterior = np.linalg.inv(information + np.diag(1 / self._spread))
            mean = np.einsum("nij,nj->ni", posterior, pull)
            squares = (mean**2).mean(axis=0) + np.einsum("nii->ni", posterior).mean(axis=0)
            # One spread of rotations and one of shifts, whatever the direction.
            self._spread = np.maximum(squares.reshape(2, 3).mean(axis=1).repeat(3), 1e-12)
        self.corrections = Corrections.from_array(mean * self._units).as_given(self.given)

    def verdict(self, kinds: Sequence[Sequence[Evidence]]) -> Verdict:
        """Whether steps are worth it: what one half of each image asks for has to explain the other half."""
        views, count = self.views, len(self.given)
        rays, before, after = (np.zeros(count) for _ in range(3))
        for evidence in kinds:
            normal = self._normal(evidence, views)
            prior = normal.variance * np.diag(1 / self._spread)
            steps = np.linalg.solve(normal.matrix + prior, normal.right[..., None])[..., 0]
            for view, each in enumerate(evidence):
                jacobian, half = self._jacobian(each, views, view), _half(each)
                left = each.residuals + (jacobian * steps[view, 1 - half]).sum(axis=1)
                for total, residual in ((before, each.residuals), (after, left)):
                    total[view] += (each.weights * np.abs(residual)).sum() / np.sqrt(normal.variance)
                rays[view] += each.weights.sum()
        return verdict_of(rays[None], before[None], after[None])

    @property
    def _units(self) -> np.ndarray:
        return np.repeat([1.0, self._distance], 3)

    def _jacobian(self, evidence: Evidence, views: PinholeViews, view: int) -> np.ndarray:
        """(K, 6) derivatives of the residuals, in radians and parts of the distance."""
        offsets = evidence.offsets
        # What a camera turns away from goes round the other way in its image.
        moves = [-np.cross(axis, offsets) for axis in np.eye(3)]
        moves += [np.broadcast_to(-self._distance * axis, offsets.shape) for axis in np.eye(3)]
        flow = [
            (projected(offsets + _STEP * move, views, view) - projected(offsets - _STEP * move, views, view))
            / (2 * _STEP)
            for move in moves
        ]
        return np.stack([(evidence.slopes * each).sum(axis=1) for each in flow], axis=1)

    def _normal(self, evidence: Sequence[Evidence], views: PinholeViews) -> _Normal:
        everything = np.concatenate([np.abs(each.residuals) for each in evidence])
        scale = max(_OUTLIER * float(np.median(everything)) if len(everything) else 1.0, 1e-6)
        matrix, right = np.zeros((len(views), 2, 6, 6)), np.zeros((len(views), 2, 6))
        for view, each in enumerate(evidence):
            jacobian, half = self._jacobian(each, views, view), _half(each)
            # Cauchy's weights.
            weight = each.weights / (1 + (each.residuals / scale) ** 2)
            for part in range(2):
                chosen = half == part
                weighted = jacobian[chosen] * weight[chosen, None]
                matrix[view, part] = weighted.T @ jacobian[chosen]
                right[view, part] = -weighted.T @ each.residuals[chosen]
        return _Normal(matrix, right, scale**2)

    def _excess(self, kind: int, normal: _Normal, now: np.ndarray) -> float:
        """By how much the variance of a residual has to be larger for what two halves ask for to differ as it
        does: residuals that are beside each other are alike."""
        prior = np.diag(1 / self._spread) * normal.variance * self._noise.get(kind, 1.0)
        right = normal.right + np.einsum("nhij,nj->nhi", normal.matrix, now)
        inverse = np.linalg.inv(normal.matrix + prior)
        halves = np.einsum("nhij,nhj->nhi", inverse, right)
        covariance = normal.variance * np.einsum("nhij,nhjk,nhkl->nil", inverse, normal.matrix, inverse)
        told = [view for view, matrix in enumerate(covariance) if matrix.any()]
        apart = halves[told, 0] - halves[told, 1]
        squares = [
            difference @ np.linalg.pinv(covariance[view], rcond=1e-6, hermitian=True) @ difference
            for view, difference in zip(told, apart, strict=True)
        ]
        self._noise[kind] = max(float(np.median(squares)) / _CHI2_MEDIAN, 1.0) if squares else 1.0
        return self._noise[kind]


def _half(evidence: Evidence) -> np.ndarray:
    """(K,) which half of the image, 0 or 1, like the squares of a chessboard."""
    return (np.floor(evidence.pixels / _SQUARE).astype(int).sum(axis=1) % 2).astype(int)
