"""How lattice fields hang on what an optimiser changes."""

from .kinds import PARAMETRISATIONS, make_parametrisation
from .parametrisation import Parametrisation, StepRules

__all__ = ["PARAMETRISATIONS", "Parametrisation", "StepRules", "make_parametrisation"]
