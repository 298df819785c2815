"""The fit: from a scene with targets to an open mesh, its material and its light."""

from .config import FitConfig
from .run import FitResult, fit_scene

__all__ = ["FitConfig", "FitResult", "fit_scene"]
