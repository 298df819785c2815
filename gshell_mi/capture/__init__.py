"""Photographs or a video to a fit scene: ``python -m gshell_mi.capture SRC -o SCENE.xml``."""

from .camera import Camera, Distortion
from .config import CaptureConfig
from .formats import read_capture
from .frames import Capture, Frame
from .run import CaptureResult, import_capture

__all__ = [
    "Camera",
    "Capture",
    "CaptureConfig",
    "CaptureResult",
    "Distortion",
    "Frame",
    "import_capture",
    "read_capture",
]
