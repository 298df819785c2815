"""Parts of a ball."""

import numpy as np
import trimesh


def cap(ball: trimesh.Trimesh, axis, share: float) -> np.ndarray:
    """Vertices in a cap with this share of the sphere's area."""
    return ball.vertices @ np.array(axis, float) > 1 - 2 * share
