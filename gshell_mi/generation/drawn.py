"""Pictures of truncated fields."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .contact_sheet import picture, write_sheet
from .fields import TruncatedFields

_EMPTY = np.full((128, 128, 3), 255, np.uint8)


def draw_fields(path: Path, fields: np.ndarray, labels: list[str]) -> None:
    """A page of the surfaces of (n, 2, N, N, N) fields. Needs a Mitsuba variant."""
    meshes = [TruncatedFields(*pair).surface(largest=True) for pair in fields]
    write_sheet(path, [picture(mesh) if len(mesh.faces) else _EMPTY for mesh in meshes], labels)
