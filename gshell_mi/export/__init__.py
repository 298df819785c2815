"""What a fit leaves behind, in formats that other programs read."""

from .fit_folder import export_fit, write_metrics
from .output_folder import FitFolder, can_resume

__all__ = ["FitFolder", "can_resume", "export_fit", "write_metrics"]
