"""The parametrisations by name."""

from __future__ import annotations

from collections.abc import Mapping

import mitsuba as mi

from ..errors import UserError
from ..lattice import BlockLattice, Lattice
from .explicit import ExplicitGrid
from .hashgrid import HashGridNetwork
from .multiresolution import MultiresolutionGrid
from .parametrisation import Parametrisation, StepRules
from .sinusoidal import SinusoidalNetwork

_GRIDS = {"explicit": ExplicitGrid, "multiresolution": MultiresolutionGrid}
_NETWORKS = {"hashgrid": HashGridNetwork, "sinusoidal": SinusoidalNetwork}

#: Names of the parametrisations.
PARAMETRISATIONS: tuple[str, ...] = (*_GRIDS, *_NETWORKS)


def make_parametrisation(name: str, start: Mapping[str, mi.Float], lattice: Lattice | BlockLattice,
                         rules: StepRules | None = None, *, seed: int = 0) -> Parametrisation:
    """The parametrisation ``name``, one of ``PARAMETRISATIONS``, of the fields of a lattice.

    Args:
        start: the fields to start from: flat ``sdf``, ``msdf``, ``deform`` and, for FlexiCubes, ``weights``.
        rules: how far a step may go.
        seed: of the networks and of their fit to the start.

    Raises:
        UserError: there is no such parametrisation.

    >>> import drjit as dr, mitsuba as mi
    >>> from gshell_mi.lattice import TetLattice
    >>> lattice = TetLattice(16)
    >>> ball = dr.norm(lattice.points(mi.Float)) - 0.5
    >>> start = {"sdf": ball, "msdf": dr.ones(mi.Float, 17**3), "deform": dr.zeros(mi.Float, 3 * 17**3)}
    >>> fields = make_parametrisation("multiresolution", start, lattice)
    >>> grow = dr.full(mi.Float, -1, 17**3)
    >>> gradients = {"sdf": -grow, "msdf": 0 * grow, "deform": dr.zeros(mi.Float, 3 * 17**3)}
    >>> fields.step(gradients, progress=0)
    >>> bool(dr.all(fields.fields()["sdf"] < ball)[0])
    True
    """
    rules = rules or StepRules()
    if name in _GRIDS:
        return _GRIDS[name](start, lattice, rules)
    if name in _NETWORKS:
        return _NETWORKS[name](start, lattice, rules, seed)
    raise UserError(f"field '{name}' is not available; choose one of {', '.join(PARAMETRISATIONS)}")
