"""Turntables of fitted objects: ``python -m gshell_mi.turntable``."""

from .turntable import TurntableConfig, render_turntable
from .video import write_video

__all__ = ["TurntableConfig", "render_turntable", "write_video"]
