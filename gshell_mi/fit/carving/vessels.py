"""Vessels: openings that lead into the hollow of something solid, such as a mug's mouth.

Where the hull's cap does not look like the object it is opened. What is seen through it then is the
back of the hull's walls, as if these were as thin as cloth. The inside of a mug is nearer than that, by the
thickness of its wall, so every view sees it elsewhere. Therefore each space behind openings is also tried as
a hollow: all of the hull goes but a wall. If that explains unseen views much better, the space is a hollow,
and the openings into it are none. Behind the openings of cloth such a wall explains them worse, by factors;
so one thickness tells, and only for a vessel is it varied, as is the hollow's depth. Each step counts only if
unseen views speak for it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from ...radiance.shown import Shown
from ...template.msdf import CERTAIN, msdf_from_template
from ...topology import equal_patches
from ..appearance import fitted_radiance
from ..stage import Fit
from ..surface import Seen, Surface
from ..template import Template, template_of
from .hollows import hollowed

#: Thickness of a wall, in cells, that tells vessels; those that are tried for them then.
_TELLING, _THINNER, _THICKER = 2.5, (1.5,), (4.0, 6.0, 9.0)

#: Depths that are tried, as fractions of the deepest.
_DEPTHS = 0.75, 0.5, 0.25

#: Vertices up to this many cells from an opening lie right behind it, and hollows are deeper than this.
_BEHIND, _SHALLOW = 1.5, 4.0


def hollowed_vessels(fit: Fit, surface: Surface) -> Surface | None:
    """Hollows a template out behind openings where that explains unseen views much better.

    Args:
        fit: the views.
        surface: with its hull, on a lattice whose vertices make a cube.

    Returns:
        The hollowed surface and what was seen of it; None if no opening leads into a hollow.
    """
    template = template_of(fit.scene.subject, surface)
    if template.solid.all() or not template.solid.any():
        return None
    vessel = _Trials(fit, surface, template).best()
    if vessel is None:
        return None
    carved, lattice = vessel.template, surface.lattice
    front, _ = fitted_radiance(fit, carved).radiance()
    msdf = msdf_from_template(carved.logits, carved.mesh, lattice)
    seen = Seen.on(lattice, carved.mesh, front, surface.sight.light)
    return replace(vessel.surface.with_fields(msdf=msdf.numpy()), seen=seen)


@dataclass(frozen=True)
class _Hollow:
    """A hollow behind openings.

    Attributes:
        mouth: (V,) which vertices of the template without it are these openings.
        thickness: of the wall, in cells.
        depth: of its deepest point below the openings, in cells.
        distance: (n,) signed distance on the lattice, in cells, positive inside; -inf outside of the hull.
        space: (V,) id of its connected part that a vertex's opening leads into.
    """

    mouth: np.ndarray
    thickness: float
    depth: float
    distance: np.ndarray
    space: np.ndarray


@dataclass(frozen=True)
class _Vessel:
    """A template with a hollow, on trial.

    Attributes:
        surface: what it comes from, but for the openings that are none.
        template: without the openings into the hollow.
        shown: to the judge.
    """

    hollow: _Hollow
    surface: Surface
    template: Template
    shown: Shown


class _Trials:
    """Tries hollows behind the openings of a template; arguments as of ``hollowed_vessels``."""

    def __init__(self, fit: Fit, surface: Surface, template: Template):
        self.fit, self.surface, self.template = fit, surface, template
        self.lattice, self._closed = surface.lattice, fit.judge.shown(template.closed)
        points = mi.Transform4f(fit.scene.subject.to_world) @ self.lattice.points(mi.Float)
        self._inside = surface.hull_distance < 0
        self._points = points.numpy().T[self._inside]

    def best(self) -> _Vessel | None:
        """The vessel that explains most; None if there is none."""
        opened = ~self.template.solid
        first = self._vessel(opened, _TELLING)
        if first is None:
            return None
        space = first.hollow.space
        place = np.where(opened, space, -1)
        before = self.fit.judge.shown(self.template.surface)
        verdict = self.fit.judge.compare(before.whole, first.shown.whole, place, self._closed)
        hollow = np.append(verdict.accepted, False)
        mouth = opened & hollow[place]
        if not mouth.any():
            return None
        if (mouth != opened).any():
            first = self._vessel(mouth, _TELLING)
            if first is None:
                return None
        best = self._better(first, ((thickness, np.inf) for thickness in _THICKER))
        if best is first:
            best = self._better(first, ((thickness, np.inf) for thickness in _THINNER))
        wall, depth = best.hollow.thickness, best.hollow.depth
        return self._better(best, ((wall, fraction * depth) for fraction in _DEPTHS))

    def _better(self, best: _Vessel, others: Iterable[tuple[float, float]]) -> _Vessel:
        """The last one of a sequence of walls and depths up to which each is better than the one before."""
        for thickness, depth in others:
            mouth = best.hollow.mouth
            other = self._vessel(mouth, thickness, depth)
            if (
                other is None
                or not self.fit.judge.compare(
                    best.shown.whole, other.shown.whole, np.where(mouth, 0, -1), self._closed
                ).accepted[0]
            ):
                break
            best = other
        return best

    def _vessel(self, mouth: np.ndarray, thickness: float, depth: float = np.inf) -> _Vessel | None:
        """The template with such a hollow; None if that is none."""
        hollow = self._hollow(mouth, thickness, depth)
        if hollow is None:
            return None
        surface = hollowed(self.surface, hollow.distance)
        closed = replace(self.template, logits=np.where(mouth, CERTAIN, self.template.logits))
        carved = template_of(self.fit.scene.subject, surface, like=closed)
        return _Vessel(hollow, surface, carved, self.fit.judge.shown(carved.surface))

    def _hollow(self, mouth: np.ndarray, thickness: float, depth: float) -> _Hollow | None:
        """What lies behind openings and deeper than a wall; None if that is nothing."""
        vertices, cell = self.template.vertices, self.fit.cell(self.surface)
        to_wall, to_mouth = (
            cKDTree(vertices[chosen]).query(self._points)[0] / cell for chosen in (~mouth, mouth)
        )
        # The wall ends at the opening's rim.
        within = np.maximum(to_wall - thickness, (to_wall - to_mouth) / np.sqrt(2))
        distance = np.full(self._inside.shape, -np.inf)
        distance[self._inside] = np.minimum(within, depth - to_mouth)
        part = ndimage.label((distance > 0).reshape((self.lattice.stride,) * 3))[0].ravel()
        owner = part[self._inside]
        nearest, deepest = (
            extremum(to_mouth, owner, range(1 + part.max()))
            for extremum in (ndimage.minimum, ndimage.maximum)
        )
        # Thick parts elsewhere are no hollows, nor are dents.
        hollow = (np.arange(1 + part.max()) > 0) & (nearest < _BEHIND) & (deepest > _SHALLOW)
        if not hollow.any():
            return None
        distance[(part > 0) & ~hollow[part]] = -np.inf
        inside = hollow[owner]
        space = owner[inside][cKDTree(self._points[inside]).query(vertices)[1]]
        # An opening leads into one of them.
        opening = equal_patches(mouth, self.template.faces)
        votes = np.zeros((1 + opening.max(), 1 + part.max()))
        np.add.at(votes, (opening[mouth], space[mouth]), 1)
        return _Hollow(mouth, thickness, to_mouth[inside].max(), distance, votes.argmax(axis=1)[opening])
