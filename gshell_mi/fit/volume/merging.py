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
from ...radiance.shown import Mesh
from ...template.msdf import CERTAIN
from ...template.msdf_transfer import transfer_msdf
from ..judge import Verdict
from ..stage import Fit
from ..surface import Seen, Surface
from ..template import at_nearest, closed_template, lattice_index
from .volume_surface import without_floaters

#: Cells by which a place has to be inside of one surface and outside of the other: what is less deep, the
#: joint stage finds, and the lattice draws thin things thicker than they are.
_DEEP = 1.5

#: Cells from such a place up to which a surface belongs to it: the surface itself is ``_DEEP`` away. Over as
#: many again one surface becomes the other.
_BESIDE = 2 * _DEEP


@dataclass(frozen=True)
class Merged:
    """A surface that two others have given their places to.

    Attributes:
        surface: that; None if the first of the two is not surely worse.
        places: how many there are where the two differ.
        taken: how many of them are the other one's.
        elsewhere: on the other one, where both nearly agree.
        whole: on ``surface``; None if nothing of it is the other one's.
    """

    surface: Surface | None
    places: int
    taken: int
    elsewhere: Verdict
    whole: Verdict | None

    def facts(self) -> dict[str, Any]:
        """For ``metrics.json``."""
        gain = self.whole.facts() if self.whole else {}
        return {"places": self.places, "taken": self.taken, "elsewhere": self.elsewhere.facts()} | gain


def merged(fit: Fit, surface: Surface, other: Surface) -> Merged:
    """Takes of two surfaces what explains unseen views better.

    The start is the other one if it is better where they agree up to ``_DEEP`` cells, else the first one. It
    keeps what it has of each place where they do not agree, unless that is surely worse. Rays that meet the
    first one, its openings closed, tell of a place; so they do not of what only the other one has, far from
    there.

    Args:
        fit: the views.
        surface: with or without openings.
        other: closed, on a lattice whose vertices make a cube, not coarser than that of ``surface``.
    """
    lattice, subject, length = other.lattice, fit.scene.subject, fit.cell(other)
    fields = surface.fields.to_lattice(lattice.resolution, lattice.grid)
    fields = transfer_msdf(subject, surface.fields, fields)
    places = _Places.between(fields, other.fields)
    closed = _as_fine(subject.surface_of(surface.fields, template=True).to_numpy()[:2], length)
    now = fit.judge.shown(_as_fine(fit.mesh(surface), length))
    then = fit.judge.shown(fit.mesh(other))
    verdict = fit.judge.compare(
        now.whole,
        then.whole,
        places.at(lattice_index(closed[0], subject.to_world, lattice.stride - 1)),
        fit.judge.shown(closed),
        places=places.count + 1,
    )
    elsewhere, each = verdict.at(slice(places.count, None)), verdict.at(slice(places.count))
    from_other = bool(elsewhere.accepted[0])
    taken = ~each.reversed.accepted if from_other else each.accepted
    if not (from_other or taken.any()):
        return Merged(None, places.count, 0, elsewhere, None)
    if from_other and taken.all():
        found, shown = other, then
    else:
        start = (other.fields, fields) if from_other else (fields, other.fields)
        mixed = _with_places(*start, places.share(taken != from_other))
        found = _with_colors(fit, mixed, surface.sight.light)
        shown = fit.judge.shown(subject.surface_of(mixed).to_numpy()[:2])
    whole = fit.judge.compare(now.whole, shown.whole)
    kept = found if whole.accepted[0] else None
    return Merged(kept, places.count, int(taken.sum()), elsewhere, whole)


@dataclass(frozen=True)
class _Places:
    """Places where two surfaces on one lattice differ by more than ``_DEEP`` cells.

    Attributes:
        count: how many there are.
        owner: (N, N, N) number of the place that a lattice vertex is nearest to.
        away: (N, N, N) cells from there.
    """

    count: int
    owner: np.ndarray
    away: np.ndarray

    @classmethod
    def between(cls, fields: LatticeFields, other: LatticeFields) -> _Places:
        shape = (fields.lattice.stride,) * 3
        inside, there = (_inside(values.reshape(shape)) for values in (fields.sdf, other.sdf))
        differs = ((inside > 0) != (there > 0)) & (np.minimum(abs(inside), abs(there)) > _DEEP)
        label, count = ndimage.label(differs, np.ones((3, 3, 3)))
        if not count:
            return cls(0, np.zeros(shape, int), np.full(shape, np.inf))
        away, nearest = ndimage.distance_transform_edt(label == 0, return_indices=True)
        return cls(count, label[tuple(nearest)] - 1, away)

    def at(self, index: np.ndarray) -> np.ndarray:
        """(V,) places that points, at (3, V) indices, are beside; what is beside none is one more."""
        return at_nearest(np.where(self.away <= _BESIDE, self.owner, self.count), index)

    def share(self, chosen: np.ndarray) -> np.ndarray:
        """(N^3,) 1 beside the (P,) chosen places, P not 0, and falling to 0 over as many cells again."""
        share = chosen[self.owner] * np.clip(2 - self.away / _BESIDE, 0, 1)
        return share.ravel().astype(np.float32)


def _inside(sdf: np.ndarray) -> np.ndarray:
    """In cells: distances to the next vertex outside; of vertices outside, minus those to the next inside."""
    solid = sdf < 0
    return ndimage.distance_transform_edt(solid) - ndimage.distance_transform_edt(~solid)


def _with_places(fields: LatticeFields, other: LatticeFields, share: np.ndarray) -> LatticeFields:
    """Fields with a share of the distances of others. Where that is all, they are also open as these are.

    Where places of both meet, specks are left, which go.
    """
    spacing = fields.lattice.spacing
    sdf = (1 - share) * fields.sdf + share * other.sdf
    cells = without_floaters((sdf / spacing).reshape((fields.lattice.stride,) * 3))
    return replace(
        fields,
        sdf=np.where(share > 0, spacing * cells.ravel(), sdf).astype(np.float32),
        msdf=np.where(share == 1, np.minimum(other.msdf, CERTAIN * spacing), fields.msdf).astype(np.float32),
    )


def _with_colors(fit: Fit, fields: LatticeFields, light: np.float32) -> Surface:
    """A surface of such fields, in the mean colours that images show it in."""
    mesh, vertices, faces = closed_template(fit.scene.subject, fields.sdf, fields.lattice)
    shown = fit.judge.shown((vertices, faces))
    front = np.mean([colors.numpy().reshape(-1, 2, 3)[:, 0] for colors in shown.whole.colors], axis=0)
    return Surface(fields, seen=Seen.on(fields.lattice, mesh, front, light))


def _as_fine(mesh: Mesh, length: float) -> Mesh:
    """A mesh whose edges are at most about as long as given: its colours are as fine as another one's."""
    vertices, faces = mesh
    while len(faces):
        edges = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
        if np.median(np.linalg.norm(edges, axis=-1)) <= 1.5 * length:
            break
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)[:2]
    return vertices, faces
