"""How lattice fields hang on what an optimiser changes."""

from .explicit import ExplicitGrid
from .kinds import make_parametrisation, parametrisation_named, register_parametrisation
from .parametrisation import Parametrisation, StepRules

__all__ = [
    "ExplicitGrid",
    "Parametrisation",
    "StepRules",
    "make_parametrisation",
    "parametrisation_named",
    "register_parametrisation",
]
