"""What a fit leaves behind, in formats that other programs read."""

from .fit_folder import export_fit, write_metrics
from .output_folder import check_output_folder, make_output_folder

__all__ = ["check_output_folder", "export_fit", "make_output_folder", "write_metrics"]
