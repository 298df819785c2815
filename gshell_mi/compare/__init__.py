"""Scores of results against references: ``python -m gshell_mi.compare``."""

from .compare import compare_fit, compare_folders, compare_meshes

__all__ = ["compare_fit", "compare_folders", "compare_meshes"]
