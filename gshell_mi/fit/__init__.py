"""The fit: from a scene with targets to an open mesh, its material and its light."""

from .bookkeeping.observer import Observer, Preview
from .config import FitConfig
from .run import FitResult, fit_scene

__all__ = ["FitConfig", "FitResult", "Observer", "Preview", "fit_scene"]
