"""What has been found until now, to look at while it is improved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Preview:
    """What a fit has found until now.

    Attributes:
        vertices: (V, 3) world positions.
        faces: (F, 3) of the open mesh.
        colors: (V, 3) linear Rec.709: radiance of the front before the joint stage, base colour in it.
        template_vertices, template_faces: the watertight template.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    template_vertices: np.ndarray
    template_faces: np.ndarray
