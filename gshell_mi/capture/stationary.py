"""Which features stand still while the object turns: those of the room around a turntable.

A room that keeps its place in all photographs and an object that turns are two contradicting motions;
structure from motion would believe the room, which has more texture. Between two photographs from (nearly)
the same place the room only shifts a little, as a whole. What an orbiting camera sees does so in neighbouring
photographs at most, for the far parts of a room sweep through the frame.
"""

from __future__ import annotations

import numpy as np

#: Largest shift of a room, as a share of the longer side: a tripod that was touched, frames cropped anew.
_SHIFT = 0.15
#: Matches agree on a shift up to this share of the longer side.
_TOLERANCE = 0.006
#: Fewer matches that agree on a shift are chance.
_ENOUGH = 12
#: A feature stands still if it does so towards so many other photographs, and towards this share of those
#: that its own was compared with.
_PARTNERS, _SHARE = 5, 0.12


def stationary_features(
    keypoints: dict[int, np.ndarray], matches: dict[tuple[int, int], np.ndarray], size: float
) -> dict[int, np.ndarray]:
    """Finds the features of a room that stands still.

    Args:
        keypoints: per image (n, 2) pixel positions.
        matches: per pair of images (m, 2) indices into their keypoints, wrong ones among them.
        size: longer side of the images in pixels.

    Returns:
        Per image (n,) booleans.

    >>> rng = np.random.default_rng(0)
    >>> room, turning = rng.uniform(0, 1000, (40, 2)), rng.uniform(0, 1000, (8, 30, 2))
    >>> points = {i: np.concatenate([room + 3 * i, turning[i]]) for i in range(8)}
    >>> pairs = {(i, j): np.stack([np.arange(70)] * 2, 1) for i in range(8) for j in range(i + 1, 8)}
    >>> still = stationary_features(points, pairs, 1000)
    >>> bool(still[0][:40].all()), int(still[0][40:].sum())
    (True, 0)
    """
    votes = {image: np.zeros(len(points), int) for image, points in keypoints.items()}
    partners = dict.fromkeys(keypoints, 0)
    for (first, second), pair in matches.items():
        partners[first] += 1
        partners[second] += 1
        shift = keypoints[first][pair[:, 0]] - keypoints[second][pair[:, 1]]
        together = _common_shift(shift, _SHIFT * size, _TOLERANCE * size)
        if together.sum() >= _ENOUGH:
            votes[first][pair[together, 0]] += 1
            votes[second][pair[together, 1]] += 1
    return {image: count >= max(_PARTNERS, _SHARE * partners[image]) for image, count in votes.items()}


def _common_shift(shift: np.ndarray, largest: float, tolerance: float) -> np.ndarray:
    """(m,) which of the shifts (m, 2) make up their densest cluster."""
    near = np.linalg.norm(shift, axis=1) < largest
    if not near.any():
        return near
    cells, count = np.unique(np.round(shift[near] / tolerance), axis=0, return_counts=True)
    center = cells[count.argmax()] * tolerance
    for _ in range(4):
        together = near & (np.linalg.norm(shift - center, axis=1) < tolerance)
        if not together.any():
            break
        center = np.median(shift[together], axis=0)
    return together
