"""A live view of a fit in the browser: ``python -m gshell_mi.fit --viewer``."""

from .viewer import Viewer

__all__ = ["Viewer"]
