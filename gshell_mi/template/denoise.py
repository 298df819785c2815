"""Mesh denoising: of all surfaces that what is known allows, the one whose normals vary least."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import losses
from ..extraction import extract
from ..lattice import BlockLattice, Lattice
from ..outliers import trusted
from ..schedules import decay_at

#: Adam's steps, and how far the first goes, in cells, where the derivative is largest.
_STEPS, _RATE = 60, 0.1

#: No derivative counts as more than so many times their mean: those of slivers would hold up all others.
_MOST = 10.0


def denoised(
    sdf: np.ndarray,
    lattice: Lattice | BlockLattice,
    tolerance: float,
    deform: np.ndarray | None = None,
    weights: np.ndarray | None = None,
) -> np.ndarray:
    """Takes from a surface the bumps that are no larger than its error.

    The total variation of the normals (``losses.normal_variation``) is minimised over the distances, none of
    which may move by more than the error. So flat parts become flat, bends and creases stay, and what is
    thicker than twice the error stays whole, where diffusion would round all that is finer than its kernel.

    Args:
        sdf: (n,) signed distances at the vertices of ``lattice``, in its units.
        lattice: what they live on.
        tolerance: how far the surface may be off, in cells.
        deform: (3 n,) offsets of the vertices; None for none.
        weights: of FlexiCubes, as of ``extract``; None for equal ones.

    Returns:
        (n,) signed distances. Those of vertices beside no surface are as they were.
    """
    cells = mi.Float(sdf / lattice.spacing)
    offsets, of_cubes = (None if given is None else mi.Float(given) for given in (deform, weights))
    # One step size for all: where it is flat, the little that derivatives are would move whole sides.
    adam = mi.ad.Adam(lr=_RATE, uniform=True, params={"cells": cells})
    for step in range(_STEPS):
        mesh = extract(lattice, adam["cells"] * lattice.spacing, deform=offsets, weights=of_cubes)
        if mesh.is_empty:  # nothing was there, or all that was is noise
            break
        dr.backward(losses.normal_variation(mesh.vertex_normals(), mesh.faces))
        dr.set_grad(adam["cells"], trusted(dr.grad(adam["cells"]), _MOST))
        adam.set_learning_rate(_RATE * decay_at(step / _STEPS))
        adam.step()
        adam["cells"] = dr.clip(dr.detach(adam["cells"]), cells - tolerance, cells + tolerance)
    return lattice.spacing * adam["cells"].numpy()
