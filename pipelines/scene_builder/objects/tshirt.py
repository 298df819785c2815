"""A short-sleeved T-shirt as on an invisible mannequin: four openings, two-colour print."""

import numpy as np
import trimesh

from ..cloth import drape
from ..files import SceneObject
from ..lights import sunny_sky
from ..modelling import capsule, cut, isosurface, mirrored, relax, segment, smooth_step, smooth_union

CREAM, TEAL = np.array([0.80, 0.73, 0.60]), np.array([0.03, 0.23, 0.27])
ARMS_CUT, ARMS_WORN = 0.62, 0.95  # radians below the horizontal: as sewn, as draped
SHOULDER = np.array([0.40, 0.46, 0.0])


def _figure(p: np.ndarray, arm_angle: float, torso: float, sleeve: float, flare: float) -> np.ndarray:
    """Distance to trunk and arms, the arms ``arm_angle`` radians below the horizontal.

    ``torso`` and ``sleeve`` enlarge the figure to the cloth around it, ``flare`` widens it downwards.
    """
    q = mirrored(p)
    # An upright tube flattened front to back.
    flat = q * [1, 1, 1.7]
    d = capsule(flat, [0, 0.24, 0], [0, -1.5, 0], 0.42 + torso, 0.40 + torso + flare) / 1.25
    d = smooth_union(d, capsule(q, [0, 0.53, -0.01], SHOULDER, 0.115 + 0.3 * torso), 0.12)
    d = smooth_union(d, capsule(q, [0, 0.5, -0.02], [0, 1.2, 0.1], 0.13), 0.10)
    hand = SHOULDER + 0.9 * np.array([np.cos(arm_angle), -np.sin(arm_angle), 0])
    return smooth_union(d, capsule(q, SHOULDER, hand, 0.165 + sleeve, 0.15 + 1.3 * sleeve), 0.08)


def _pattern(p: np.ndarray) -> np.ndarray:
    """The closed template that the pattern is cut from, arms raised."""
    return _figure(p, ARMS_CUT, 0.05, 0.005, 0.12)


def _openings(p: np.ndarray, hem: float = -0.70) -> np.ndarray:
    """Positive on the cloth: above the hem, before the cuffs, outside the neck hole."""
    along = (mirrored(p) - SHOULDER) @ [np.cos(ARMS_CUT), -np.sin(ARMS_CUT), 0]
    neck = np.linalg.norm((p - [0, 0.70, 0.07]) / [0.21, 0.19, 0.20], axis=1) - 1
    cuff = np.maximum(0.40 - along, 0.05 - p[:, 1])  # the trunk's flank also lies beyond that plane
    collar = np.minimum(0.2 * neck, 0.75 - p[:, 1])  # and the neck goes on above the hole
    return np.minimum(np.minimum(p[:, 1] - hem, cuff), collar)


def _ghost(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Distance to the chest motif in pattern coordinates: a ghost about 0.4 tall."""
    p = np.stack([x, y, 0 * x], 1)
    body = segment(p, [0, 0.12, 0], [0, -0.08, 0])[0] - 0.15
    hem = -0.12 + 0.035 * np.cos(x * 6 * np.pi / 0.3 + np.pi) - y
    eyes = np.hypot((np.abs(x) - 0.055) / 0.8, y - 0.12) - 0.04
    return np.maximum(np.maximum(body, hem), -eyes)


def _colour(p: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Cream with teal collar, cuffs and chest motif, at rest positions ``p``."""
    trim = _openings(p, hem=-9.0)  # no trim at the hem
    ink = 1 - smooth_step(trim, 0.032, 0.052)
    front = smooth_step(normals[:, 2], 0.0, 0.2)
    motif = front * (1 - smooth_step(_ghost(p[:, 0], p[:, 1] - 0.08), -0.01, 0.01))
    ink = np.maximum(ink, motif)[:, None]
    return CREAM + ink * (TEAL - CREAM)


def cut_pattern(cell: float) -> trimesh.Trimesh:
    """The cloth before draping, with edges of about ``cell``."""
    closed = relax(isosurface(_pattern, [-1.3, -1.2, -0.7], [1.3, 1.1, 0.7], cell), _pattern, steps=5)
    return relax(cut(closed, _openings(np.asarray(closed.vertices))), _pattern, _openings, 30)


def _body(p: np.ndarray, t: float) -> np.ndarray:
    """The mannequin, which lowers its arms in the first half of the run."""
    return _figure(p, ARMS_CUT + (ARMS_WORN - ARMS_CUT) * min(1, t / 0.5), 0.0, 0.0, 0.02)


def build() -> SceneObject:
    """The draped shirt under a sunny sky."""
    pattern = cut_pattern(0.036)
    draped = drape(pattern, _body, ease=1.05, bending=1e-4, friction=0.1)
    # The same subdivision of both shapes gives the same vertices in the same order.
    shirt = trimesh.Trimesh(draped, pattern.faces, process=False).subdivide_loop(1)
    rest = pattern.subdivide_loop(1)
    color = _colour(np.asarray(rest.vertices), rest.vertex_normals)
    return SceneObject(shirt, color, sunny_sky(62, 42), roughness=0.85)
