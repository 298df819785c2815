"""The lattice's values, and the weights of FlexiCubes with them."""

from __future__ import annotations

from ..parametrisation import ExplicitGrid


class FlexiCubesWeights(ExplicitGrid):
    """As ``explicit``, but the 21 weights per cube of FlexiCubes move, too (``flexicubes``).

    A step takes a tenth longer; fits came out no better.
    """

    moves_weights = True
