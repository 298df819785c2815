"""How far cloth lies above the smooth body that it hangs on, in Dr.Jit arrays."""

from __future__ import annotations

import drjit as dr
import numpy as np

from ...arrays import Array3f, Float


def folds(p: Array3f, given: dict[str, Float]) -> Float:
    """Waves around the y axis, deeper towards the hem."""
    drop = dr.maximum(given["fold_top"] - given["fold_bottom"], 1e-3)
    deep = dr.clip((given["fold_top"] - p.y) / drop, 0, 1.2)
    turn = dr.atan2(p.z, p.x)
    phase = given["fold_count"] * turn + given["fold_phase"] + given["fold_turn"] * p.y
    # A second number of waves makes no two folds alike.
    second = dr.sin((dr.floor(given["fold_count"] / 2) + 1) * turn + given["fold_second_phase"])
    wave = dr.sin(phase + 0.7 * given["fold_second"] * second) * (1 + 0.5 * given["fold_second"] * second)
    return given["fold_depth"] * deep * dr.sqrt(deep) * wave


def wrinkles(p: Array3f, rng: np.random.Generator) -> Float:
    """A few long waves in random directions."""
    height = dr.zeros(type(p.x))
    for _ in range(4):
        direction = rng.normal(size=3)
        direction *= rng.uniform(4, 14) / np.linalg.norm(direction)
        size, phase, *wave = (
            dr.opaque(type(p.x), float(value))
            for value in (rng.uniform(0.001, 0.007), rng.uniform(0, 2 * np.pi), *direction)
        )
        height += size * dr.sin(dr.dot(p, type(p)(*wave)) + phase)
    return height
