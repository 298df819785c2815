"""The fit: from a scene with targets to an open mesh, its material and its light."""

from typing import TYPE_CHECKING

from ..preview import Preview
from .bookkeeping.observer import Observer
from .config import FitConfig

if TYPE_CHECKING:
    from .api import FitResult, fit_scene

__all__ = ["FitConfig", "FitResult", "Observer", "Preview", "fit_scene"]


def __getattr__(name: str) -> object:
    # Only who fits a whole scene needs what exports it and reports on it.
    if name in ("FitResult", "fit_scene"):
        from . import api

        return getattr(api, name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
