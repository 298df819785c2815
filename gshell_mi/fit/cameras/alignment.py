"""Corrections of cameras that a surface's texture and outline ask for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.linalg import block_diag

from ...calibration.corrections import Corrections, projected
from ...calibration.evidence import Evidence
from ...views import PinholeViews
from ..judge import Verdict, verdict_of

#: Standard deviation of a rotation, in radians, and of a shift over the distance, before anything was seen.
_FIRST_GUESS = np.radians(0.3)

#: Side of the squares, in pixels, that images are parted into two halves by; residuals are alike within one.
_SQUARE = 24

#: Squares of an image before their spread tells of a single camera: of four, two standard errors are no rare
#: accident, and small images of exact cameras would be corrected.
_SQUARES = 12

#: Residuals beyond so many times their median are taken for those of something else.
_OUTLIER = 1.5

#: Degrees of freedom of the corrections, of Student's t: as of Cauchy's. Most cameras are off by about as
#: much, a few, such as the last ones of a tour around an object, by many times that.
_FREEDOM = 1

#: Rounds in which the spread of the corrections is found.
_EMPIRICAL_BAYES = 10

#: Median of chi squared with six degrees of freedom.
_CHI2_MEDIAN = 5.348

#: Places whose derivatives, 6 N numbers each, are in memory at once.
_ROWS = 4096

#: Keeps sums of weights from being 0.
_LEAST = 1e-9

#: Step, in radians or parts of the distance, that tells the derivatives of what is seen.
_STEP = 1e-4


@dataclass(frozen=True)
class _Normal:
    """Normal equations of N views, of one kind of evidence, of the six numbers of each correction.

    Attributes:
        evidence: of each view.
        residuals, weights, jacobians: of each view (K,), (K,) robust ones, and (K, 6).
        matrix: (N, 2, 6, 6) of two halves of each image, as if other views were right.
        right: (N, 2, 6).
        variance: of a residual.
    """

    evidence: Sequence[Evidence]
    residuals: list[np.ndarray]
    weights: list[np.ndarray]
    jacobians: list[np.ndarray]
    matrix: np.ndarray
    right: np.ndarray
    variance: float

    def joint(self) -> tuple[np.ndarray, np.ndarray]:
        """(6 N, 6 N) and (6 N,) of all views at once."""
        about = _about_means(self.evidence, self.weights)
        parts = zip(self.jacobians, self.weights, about, strict=True)
        right = [-(jacobian * weight[:, None]).T @ value for jacobian, weight, value in parts]
        matrix = block_diag(*self.matrix.sum(axis=1))
        return matrix - _shared(self.evidence, self.jacobians, self.weights), np.concatenate(right)


class Alignment:
    """Finds corrections of all views at once by Gauss-Newton steps (Lucas and Kanade 1981).

    What a place looks like is not known either, and is eliminated, as points are in bundle adjustment (Triggs
    et al. 2000); the surface stays where it is. How far to go is told by the views together. Two halves of
    each image tell how much of a step is noise; what the steps vary by beyond that is how wrong cameras are,
    and each is corrected as far as its own evidence is better than that (empirical Bayes; James and Stein
    1961). So exact cameras stay, while a few may be far more wrong than the others (Student's t, by
    expectation maximisation; Lange et al. 1989).

    Args:
        given: cameras, N.
        distance: from the cameras to the object, about; the unit of shifts.
        moving: (N,) which may move; default: all.

    Attributes:
        views: corrected so far, where they lie on the surface.
        precision: (N,) relative to the others: small for cameras that are far more wrong.
    """

    def __init__(self, given: PinholeViews, distance: float, moving: np.ndarray | None = None):
        self._given, self._distance = given, distance
        self.start(np.ones(len(given), bool) if moving is None else moving)

    def start(self, moving: np.ndarray) -> None:
        """From the given cameras; (N,) which may move."""
        self.views, self._moving = self._given, np.flatnonzero(moving)
        self._moved = np.zeros((len(moving), 6))
        self._spread = np.full(6, _FIRST_GUESS**2)
        self.precision = np.ones(len(moving))
        self._noise: dict[int, float] = {}

    @property
    def found(self) -> Corrections:
        """So far, of cameras that lie on the surface."""
        return Corrections.from_array(self._moved * np.repeat([1.0, self._distance], 3))

    @property
    def corrections(self) -> Corrections:
        """The same without what all have in common, in which cameras that are far more wrong hardly count;
        nothing is in common with cameras that may not move."""
        if len(self._moving) < len(self._given):
            return self.found
        return self.found.as_given(self._given, self.precision)

    def step(self, kinds: Sequence[Sequence[Evidence]]) -> None:
        """One step, by one evidence or more of all views."""
        count, now = len(self._given), self._moved.copy()
        information, pull = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
        for kind, evidence in enumerate(kinds):
            normal = self._normal(evidence)
            noise = normal.variance * self._excess(kind, normal, now)
            matrix, right = normal.joint()
            information += matrix / noise
            pull += right / noise
        moving = self._moving
        free = (6 * moving[:, None] + np.arange(6)).ravel()
        information = information[np.ix_(free, free)]
        pull = pull[free] + information @ now[moving].ravel()
        for _ in range(_EMPIRICAL_BAYES):
            prior = (self.precision[moving, None] / self._spread).ravel()
            posterior = np.linalg.inv(information + np.diag(prior))
            mean = (posterior @ pull).reshape(-1, 6)
            squares = mean**2 + posterior.diagonal().reshape(-1, 6)
            precision = (_FREEDOM + 6) / (_FREEDOM + (squares / self._spread).sum(axis=1))
            # One spread of rotations and one of shifts, whatever the direction.
            spread = (precision[:, None] * squares).mean(axis=0)
            self._spread = np.maximum(spread.reshape(2, 3).mean(axis=1).repeat(3), 1e-12)
            self._moved[moving], self.precision[moving] = mean, precision
        self.views = self.found.views(self._given)

    def verdicts(self, kinds: Sequence[Sequence[Evidence]]) -> tuple[Verdict, Verdict]:
        """Whether steps are worth it: what one half of each image asks for has to explain the other half.

        All kinds of evidence ask together, and each has as much of a say: gloss moves over a surface like
        the texture of a camera that turns, and outlines deny it, which few pixels tell of.

        Returns:
            That on all cameras, told by the views, and that on each, told by the squares of its image: of
            many, a single one that is wrong is seen only so.
        """
        columns, rows = np.ceil(self._given.sizes.max(axis=0) / _SQUARE).astype(int)
        normals = [self._normal(evidence) for evidence in kinds]
        matrix = np.sum([normal.matrix / normal.variance for normal in normals], axis=0)
        right = np.sum([normal.right / normal.variance for normal in normals], axis=0)
        steps = np.linalg.solve(matrix + np.diag(1 / self._spread), right[..., None])[..., 0]
        # Of each kind: rays, and errors before and after, of the squares of each view.
        sums = np.zeros((3, len(kinds), len(self._given), columns * rows))
        for kind, normal in enumerate(normals):
            for view, (each, residuals) in enumerate(zip(normal.evidence, normal.residuals, strict=True)):
                left = residuals + (normal.jacobians[view] * steps[view, 1 - _half(each)]).sum(axis=1)
                square = np.ravel_multi_index(tuple(_squares(each).T), (columns, rows), mode="clip")
                scale = each.weights / np.sqrt(normal.variance)
                for total, values in zip(
                    sums, (each.weights, scale * np.abs(residuals), scale * np.abs(left)), strict=True
                ):
                    total[kind, view] = np.bincount(square, values, columns * rows)
        typical = sums[0].sum(axis=(1, 2)) / np.maximum((sums[0] > 0).sum(axis=(1, 2)), 1)
        sums /= np.maximum(typical, _LEAST)[:, None, None]
        every = verdict_of(*_of_all_kinds(sums.sum(axis=3))[:, None])
        each = verdict_of(*sums.swapaxes(1, 2).reshape(3, len(self._given), -1))
        few = (sums[0].sum(axis=0) > 0).sum(axis=1) < _SQUARES
        return every, replace(each, noise=np.where(few, np.inf, each.noise))

    def _jacobian(self, evidence: Evidence, view: int) -> np.ndarray:
        """(K, 6) derivatives of the values, in radians and parts of the distance."""
        offsets, views = evidence.offsets, self.views
        # What a camera turns away from goes round the other way in its image.
        moves = [-np.cross(axis, offsets) for axis in np.eye(3)]
        moves += [np.broadcast_to(-self._distance * axis, offsets.shape) for axis in np.eye(3)]
        flow = [
            (projected(offsets + _STEP * move, views, view) - projected(offsets - _STEP * move, views, view))
            / (2 * _STEP)
            for move in moves
        ]
        return np.stack([(evidence.slopes * each).sum(axis=1) for each in flow], axis=1)

    def _normal(self, evidence: Sequence[Evidence]) -> _Normal:
        count, residuals = len(evidence), _residuals(evidence)
        everything = np.abs(np.concatenate(residuals))
        scale = max(_OUTLIER * float(np.median(everything)) if len(everything) else 1.0, 1e-6)
        jacobians = [self._jacobian(each, view) for view, each in enumerate(evidence)]
        # Cauchy's weights.
        weights = [
            each.weights / (1 + (residual / scale) ** 2)
            for each, residual in zip(evidence, residuals, strict=True)
        ]
        matrix, right = np.zeros((count, 2, 6, 6)), np.zeros((count, 2, 6))
        for view, (each, jacobian, weight) in enumerate(zip(evidence, jacobians, weights, strict=True)):
            half, weighted = _half(each), jacobian * weight[:, None]
            for part in range(2):
                chosen = half == part
                matrix[view, part] = weighted[chosen].T @ jacobian[chosen]
                right[view, part] = -weighted[chosen].T @ residuals[view][chosen]
        return _Normal(evidence, residuals, weights, jacobians, matrix, right, scale**2)

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


def _of_all_kinds(sums: np.ndarray) -> np.ndarray:
    """(3, N) rays, and errors before and after, of (3, K, N) those of K kinds in N views: all have one say.

    >>> _of_all_kinds(np.array([[[1.0], [1.0]], [[1.0], [1.0]], [[4.0], [0.25]]])).ravel()
    array([2., 2., 2.])
    """
    rays, *errors = sums
    told, total = rays > 0, rays.sum(axis=0)
    kinds = np.maximum(told.sum(axis=0), 1)
    logarithms = (np.log(error / np.maximum(rays, _LEAST) + _LEAST) * told for error in errors)
    return np.stack([total, *(total * np.exp(each.sum(axis=0) / kinds) for each in logarithms)])


def _sums(evidence: Sequence[Evidence], values: Sequence[np.ndarray]) -> list[np.ndarray]:
    """For each view (K,) what (K,) values of all views come to at its places."""
    where = np.concatenate([each.places for each in evidence])
    total = np.bincount(where, np.concatenate(values))
    return [total[each.places] for each in evidence]


def _about_means(evidence: Sequence[Evidence], weights: Sequence[np.ndarray]) -> list[np.ndarray]:
    """For each view (K,) values less their means over all views, if they have places."""
    if not evidence[0].shared:
        return [each.values for each in evidence]
    weighted = [weight * each.values for weight, each in zip(weights, evidence, strict=True)]
    sums = zip(evidence, _sums(evidence, weighted), _sums(evidence, weights), strict=True)
    return [each.values - total / np.maximum(weight, _LEAST) for each, total, weight in sums]


def _residuals(evidence: Sequence[Evidence]) -> list[np.ndarray]:
    """For each view (K,) values less the means over the other views, if they have places."""
    own = [each.weights for each in evidence]
    about = _about_means(evidence, own)
    if not evidence[0].shared:
        return about
    return [
        value * total / np.maximum(total - weight, _LEAST)
        for value, total, weight in zip(about, _sums(evidence, own), own, strict=True)
    ]


def _shared(
    evidence: Sequence[Evidence], jacobians: Sequence[np.ndarray], weights: Sequence[np.ndarray]
) -> np.ndarray:
    """(6 N, 6 N) by which views tell less together, as each of them helps to tell what a place looks like
    (Schur's complement)."""
    count = len(evidence)
    result = np.zeros((6 * count, 6 * count))
    if not evidence[0].shared:
        return result
    row = np.concatenate([each.places for each in evidence])
    column = np.repeat(np.arange(count), [len(each.places) for each in evidence])
    total = np.maximum(np.concatenate(_sums(evidence, weights)), _LEAST)
    data = np.concatenate(jacobians) * (np.concatenate(weights) / np.sqrt(total))[:, None]
    index = row.repeat(6), (6 * column[:, None] + np.arange(6)).ravel()
    matrix = sparse.csr_array((data.ravel(), index), shape=(int(row.max(initial=-1)) + 1, 6 * count))
    for start in range(0, matrix.shape[0], _ROWS):
        rows = matrix[start : start + _ROWS].toarray()
        result += rows.T @ rows
    return result


def _half(evidence: Evidence) -> np.ndarray:
    """(K,) which half of the image, 0 or 1, like the squares of a chessboard."""
    return _squares(evidence).sum(axis=1) % 2


def _squares(evidence: Evidence) -> np.ndarray:
    """(K, 2) column and row of the square of the image."""
    return np.floor(evidence.pixels / _SQUARE).astype(int)
