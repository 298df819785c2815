"""Two surfaces of one object: of each place where they differ, what explains unseen views better.

A radiance volume shows gaps and windows that no hull does. But the mirror image of the surroundings lies
behind a surface, and there a volume puts it: what shines gets craters. Both are told apart place by place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh
from scipy import ndimage

from ...fields import LatticeFields
from ..judge import Verdict
from ..stage import Fit
from ..surface import Seen, Surface
from ..template import closed_template, lattice_index
from .shown import Mesh, Shown
from .volume_surface import without_specks

#: Cells by which a place has to be inside of one surface and outside of the other: what is less deep, the
#: joint stage finds, and the lattice draws thin things thicker than they are.
_DEEP = 1.5

#: Cells from such a place up to which a surface belongs to it: the surface itself is ``_DEEP`` away. Over as
#: many again one surface becomes the other.
_BESIDE = 2 * _DEEP


@dataclass(frozen=True)
class Merged:
    """A surface that has places from another one.

    Attributes:
        surface: that explains unseen views better than without these; None if none does.
        places: how many there are where the two differ.
        taken: how many of them are the other one's.
        verdict: on all that is the other one's; None if nothing is.
    """

    surface: Surface | None
    places: int
    taken: int
    verdict: Verdict | None

    def facts(self) -> dict[str, Any]:
        """For ``metrics.json``."""
        gain = self.verdict.facts() if self.verdict else {}
        return {"places": self.places, "taken": self.taken} | gain


def merged(fit: Fit, surface: Surface, other: Surface) -> Merged:
    """Takes of two surfaces what explains unseen views better.

    The start is the other one if it is better also where they agree up to ``_DEEP`` cells, else the first
    one. It keeps what it has of each place where they do not agree, unless that is surely worse.

    Args:
        fit: the views.
        surface: with or without openings.
        other: closed, on a lattice whose vertices make a cube, not coarser than that of ``surface``.
    """
    lattice, subject, length = other.lattice, fit.scene.subject, fit.cell(other)
    fields = surface.fields.to_lattice(lattice.resolution, lattice.grid)
    shape = (lattice.stride,) * 3
    inside, there = (_inside(values.reshape(shape)) for values in (fields.sdf, other.fields.sdf))
    differs = ((inside > 0) != (there > 0)) & (np.minimum(abs(inside), abs(there)) > _DEEP)
    label, count = ndimage.label(differs, np.ones((3, 3, 3)))
    away, nearest = ndimage.distance_transform_edt(label == 0, return_indices=True)
    owner = label[tuple(nearest)] - 1 if count else np.zeros(shape, int)
    beside = (away <= _BESIDE) & (count > 0)
    closed = _as_fine(subject.surface_of(surface.fields, template=True).to_numpy()[:2], length)
    index = np.rint(lattice_index(closed[0], subject.to_world, lattice.stride - 1)).astype(int)
    at = tuple(np.clip(index, 0, lattice.stride - 1))
    # What is beside no place is one more.
    place = np.where(beside[at], owner[at], count)
    now = fit.judge.shown(_as_fine(subject.surface_of(surface.fields).to_numpy()[:2], length))
    then = fit.judge.shown(subject.surface_of(other.fields).to_numpy()[:2])
    verdict = fit.judge.compare(now.whole, then.whole, place, fit.judge.shown(closed))
    better, worse = (
        np.append(told.accepted, np.zeros(count + 1, bool))[: count + 1]
        for told in (verdict, replace(verdict, gain=-verdict.gain))
    )
    taken = ~worse[:count] if better[count] else better[:count]
    if not (taken.any() or better[count]):
        return Merged(None, count, 0, None)
    if taken.all():
        found = other
    else:
        start = (other.fields, fields) if better[count] else (fields, other.fields)
        changed = (taken != better[count])[owner] * np.clip(2 - away / _BESIDE, 0, 1)
        mixed = _with_places(*start, changed.ravel().astype(np.float32))
        found = _with_colors(fit, mixed, surface.seen.light)
    mesh = subject.surface_of(found.fields).to_numpy()[:2]
    whole = fit.judge.compare(now.whole, fit.judge.shown(mesh).whole)
    return Merged(found if whole.accepted[0] else None, count, int(taken.sum()), whole)


def _inside(sdf: np.ndarray) -> np.ndarray:
    """Distances inwards of vertices from where the sign changes, in cells."""
    solid = sdf < 0
    return ndimage.distance_transform_edt(solid) - ndimage.distance_transform_edt(~solid)


def _with_places(fields: LatticeFields, other: LatticeFields, share: np.ndarray) -> LatticeFields:
    """Fields with a share of the distances of others, and as open as these are where it is all. Where places
    of both meet, specks are left, which go."""
    lattice = fields.lattice
    sdf = (1 - share) * fields.sdf + share * other.sdf
    cells = without_specks((sdf / lattice.spacing).reshape((lattice.stride,) * 3), 0.0)
    offsets = np.repeat(share, 3)
    return replace(
        fields,
        sdf=(lattice.spacing * cells.ravel()).astype(np.float32),
        msdf=np.where(share == 1, other.msdf, fields.msdf),
        deform=(1 - offsets) * fields.deform + offsets * other.deform,
    )


def _with_colors(fit: Fit, fields: LatticeFields, light: np.float32) -> Surface:
    """A surface of such fields, in the mean colours that images show it in."""
    mesh, vertices, faces = closed_template(fit.scene.subject, fields.sdf, fields.lattice)
    shown: Shown = fit.judge.shown((vertices, faces))
    front = np.mean([colors.numpy().reshape(-1, 2, 3)[:, 0] for colors in shown.whole.colors], axis=0)
    return Surface(fields, seen=Seen.on(fields.lattice, mesh, front, light))


def _as_fine(mesh: Mesh, length: float) -> Mesh:
    """A mesh whose edges are at most about as long as given: its colours are as fine as another one's."""
    vertices, faces = mesh
    edges = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    if len(faces) and np.median(np.linalg.norm(edges, axis=-1)) > 1.5 * length:
        return trimesh.remesh.subdivide(vertices, faces)
    return mesh
