"""Openings are revised once light and material are known.

They are found before anything is known of the light. A cap that lies right behind a rim, such as at the end
of a garment's pleat, may be left: the radiance that is fitted to a cap explains the few views that see in as
well as the one that is fitted to the dark inside. A path tracer knows how dark that is. So it is asked
what would be seen without the surface beside an opening. Where that is about as good without anything having
been fitted to it, the opening grows. And a small opening through which nothing looks like the images, such as
one found in a bulge of the hull, is shut. After further steps each place is judged: it stays as it is
now if the images are explained better. Until then the mSDF rests inside of what has opened, as a cap whose
colours were fitted for long would win against what nothing has been fitted to yet. Loose parts
that are small sheets, such as islands of lace, are solid on one side only, whether they have come back so or
the template had both.
"""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from ...extraction.surface_mesh import SurfaceMesh
from ...fields.smoothing import MeshDiffusion
from ...pixels import PixelPool
from ...template.growth import grown, joined
from ...template.msdf import clean_opacity, reopened, rewritten
from ...template.small_sheets import small_sheets
from ...topology import boundary_edges, equal_patches, mesh_components, mesh_edges, spread, topology
from ...triangles import positive_part, vertex_areas
from ...views import PinholeViews
from ..bookkeeping.observer import Preview
from ..judge import Judge, places_of
from .joint import JointStage
from .residuals import Residuals, near_openings, residuals_of

#: Lambda that smooths errors along the template, and new rims.
_SMOOTHING = 3.0

#: An opening is doubtful if it is smaller than this fraction of the template ...
_SMALL = 0.05

#: ... and what is seen through it explained worse than the surface by this factor. Through true ones, such as
#: sleeves, it is 5 to 8.
_DOUBTFUL = 15.0

#: It is doubtful, too, if the error is that of covered pixels that show nothing at all: a loose part of the
#: object has been cut away.
_NOTHING = 3.0

#: Fewest rays by which an opening is doubted.
_ENOUGH = 100

#: Size, in cells, of the new mSDF.
_SURE = 0.5

#: Where the new mSDF is below minus this share of its size it rests: not at the rim, which is uncertain.
_CORE = 0.25

#: Longest way, in cells, between an opening and what opens apart from it.
_WAY = 14.0

#: Strips that part openings which have met are at most so many vertices wide on either side.
_STRIP = 2

#: Mean thickness, in cells, up to which a loose part is a sheet; lattices hold none thinner than one.
_SHEET = 1.5

#: Vertices have the patch of what was nearest, up to this many cells away.
_NEAR = 1.5


class TopologyRevision:
    """A worker that reconsiders the openings of the joint stage between its steps.

    Args:
        joint: does the steps; its fields are explicit.
        views, pixels: the targets.
        fit_judge: that of all stages. What it refuses does not grow: through holes, gloss is seen as if it
            were behind.
        state: what ``state`` gave where the stage goes on, or at the end of that on a coarser lattice, whose
            openings are looked after then.
    """

    def __init__(self, joint: JointStage, views: PinholeViews, pixels: PixelPool, fit_judge: Judge,
                 state: Mapping[str, np.ndarray]):
        self.joint, self._views, self._pixels, self._fit_judge = joint, views, pixels, fit_judge
        count = joint.iterations
        #: The steps before which openings change and are judged.
        self._changes = round(joint.stage.revision * count)
        self._judges = (self._changes + count + 1) // 2
        # What it renders has one light for all views.
        one_light = joint.config.light_frame == "world"
        if not (joint.geometry.is_explicit and one_light) or joint.config.watertight or self._judges >= count:
            self._changes = count     # never
        self._state = dict(state)
        if (frozen := self._state.pop("frozen", None)) is not None:
            joint.geometry.frozen = mi.Bool(frozen)

    def step(self, iteration: int) -> Mapping[str, float]:
        """One step of the joint stage, after what is to be done before it."""
        if iteration == self._changes:
            self._change(iteration)
        elif iteration == self._judges and "points" in self._state:
            self._judge(iteration)
        return self.joint.step(iteration)

    def preview(self) -> Preview:
        """The joint stage's."""
        return self.joint.preview()

    def state(self) -> dict[str, np.ndarray]:
        """What a checkpoint keeps, so that a fit that goes on judges alike."""
        frozen = self.joint.geometry.frozen
        return self._state | ({} if frozen is None else {"frozen": frozen.numpy()})

    def finish(self) -> bool | None:
        """Ends the joint stage; returns whether openings have changed for good, None if none was doubted.

        Growing must not change how many boundary loops there are. Where rims have met in the steps
        afterwards, a strip of the surface comes back. If that does not help, but undoing all does, all is
        undone. If nothing helps, as loops have come or gone elsewhere, what comes nearest stays. Loose sheets
        that have closed on the way, or have come back of themselves, open on one side.
        """
        changed = self._settle()
        if self._changes < self.joint.iterations:
            self._open_loose_sheets()
        # Last of all: looking at the template brings the specks back.
        self.joint.finish()
        return changed

    def _settle(self) -> bool | None:
        """Keeps or undoes what has changed, by the boundary loops that come of it; see ``finish``, which
        ends the stage."""
        kept = self._state.get("kept")
        if kept is None or not kept.any():
            return None if kept is None else False
        self._join(kept)
        self.joint.finish()
        tried = [(self._loops_off(kept), self._msdf())]
        for width in range(_STRIP + 1):
            if tried[-1][0] == 0:
                return True
            self._part(kept, width)
            self.joint.finish()
            tried.append((self._loops_off(kept), self._msdf()))
        off, msdf = min(tried, key=lambda attempt: attempt[0])
        if not off:
            return True
        self.joint.geometry.replace("msdf", tried[0][1])
        self._undo(kept)
        self.joint.finish()
        none = np.zeros_like(kept)
        if self._loops_off(none) < off:
            self._state["kept"] = none
            return False
        self.joint.geometry.replace("msdf", msdf)
        return True

    def _change(self, iteration: int) -> None:
        # First of all: while a sheet has both sides, either looks as if the images could do without it.
        self._open_loose_sheets()
        template, vertices, faces, values = self._template()
        # Specks would grow into openings of their own, apart from the one that they belong to.
        values = self._cleaned(vertices, faces, values)
        before = values <= 0
        if before.all() or not before.any():
            return
        found = self._explained(template, iteration)
        smooth = MeshDiffusion(faces, len(vertices), _SMOOTHING)
        shut = doubtful(values, vertices, faces, found)
        grows = near_openings(np.where(shut, self._scale, values), vertices, faces, found, smooth,
                              self._reach) & ~before
        grows &= ~self._refused(vertices, faces, values, grows)
        if not (grows | shut).any():
            return
        changed, near = reopened(values, (before | grows) & ~shut, smooth, self._scale)
        former = self._msdf()
        msdf = self._write(template, changed, near)
        self.joint.geometry.frozen = (msdf < -_CORE * self._scale) & (msdf != former)
        patch = places_of(grows | shut, equal_patches(np.where(grows, 1, np.where(shut, 2, 0)), faces))
        # Shutting an opening takes its loops away, growing none; a sheet that comes back brings one.
        solid = ~before
        loops = _loops(vertices, faces, solid)
        spent = [np.subtract(loops, _loops(vertices, faces, solid | (shut & (patch == index))))
                 for index in range(patch.max() + 1)]
        self._state = {"points": vertices, "values": values, "patch": patch,
                       "errors": _errors(found, patch, ~before),
                       "loops": np.array(loops), "spent": np.array(spent),
                       "cell": np.float64(self.joint.subject.cell_size)}

    def _refused(self, vertices: np.ndarray, faces: np.ndarray, values: np.ndarray,
                 grows: np.ndarray) -> np.ndarray:
        """(V,) which patches of what would open explain unseen views worse for certain."""
        if not grows.any():
            return grows
        place = places_of(grows, equal_patches(grows, faces))
        without, opened = (self._fit_judge.shown(positive_part(vertices, faces, logits)) for logits in (
            values, np.where(grows, -self._scale, values)))
        refused = self._fit_judge.compare(without, opened, ((vertices, faces), place)).refused
        return grows & refused[place]

    def _judge(self, iteration: int) -> None:
        template, vertices, _, values = self._template()
        patch, then = self._patches(vertices)[1], self._state["errors"]
        now = _errors(self._explained(template, iteration, behind=False), patch, values > 0, len(then) - 1)
        # All of the surface has been explained better since.
        ratio = now[:-1] / then[:-1] * (then[-1] / now[-1])
        unjustified = ratio >= self.joint.stage.revision_gain
        self.joint.geometry.frozen = None
        self._undo(unjustified)
        self._state["kept"] = ~unjustified
        self._open_sheets(~unjustified)
        self._join(~unjustified)

    def _open_loose_sheets(self) -> None:
        """Opens one side of each small part that is a closed sheet, unless the whole surface is closed."""
        template, vertices, faces, values = self._template()
        opened = self._openings(vertices, faces, values)
        if opened.any() and not opened.all():
            self._open_sides(template, vertices, faces, opened)

    def _open_sheets(self, kept: np.ndarray) -> None:
        """Opens one side of the sheets among the loose parts that have come back in kept patches (P,)."""
        template, vertices, faces, values = self._template()
        nearest, patch = self._patches(vertices)
        back = (patch >= 0) & kept[patch] & (self._state["values"][nearest] <= 0)
        part = mesh_components(faces, len(vertices))
        elsewhere = 2 * np.bincount(part, back) < np.bincount(part)
        side = self._open_sides(template, vertices, faces,
                                elsewhere[part] | self._openings(vertices, faces, values))
        for sheet in np.unique(part[side]):
            owner = np.bincount(patch[back & (part == sheet)]).argmax()
            self._state["spent"][owner] -= (1, 0)
        # From here on these are openings like those from before.
        self._state["patch"][nearest[side]] = -1

    def _open_sides(self, template: SurfaceMesh, vertices: np.ndarray, faces: np.ndarray,
                    others: np.ndarray) -> np.ndarray:
        """Opens one side (V,) of each small part without the others (V,) that is a closed sheet.

        What it borders of them must be small beside it, as a neck that has been cut, by which the template
        joins it to more than itself.
        """
        areas = vertex_areas(vertices, faces)
        whole, faces = areas.sum(), faces[~others[faces].any(axis=1)]
        part = mesh_components(faces, len(vertices))
        area = np.bincount(part, areas)
        start, end = boundary_edges(faces)[0].T
        rim = np.bincount(part[start], np.linalg.norm(vertices[end] - vertices[start], axis=1), len(area))
        # Any flat piece has twice that rim or more.
        left_out = ((area > _SMALL * whole) | (rim**2 >= np.pi * area))[part]
        left_out |= np.bincount(faces.ravel(), minlength=len(vertices)) == 0
        side = small_sheets(vertices, template.vertex_normals().numpy().T, faces, left_out,
                            _SHEET * self.joint.subject.cell_size)[0]
        if side.any():
            # Both sides hang on the same vertices of the lattice: without the other, it would open too.
            sheet = np.isin(part, part[side])
            self._write(template, np.where(side, -self._scale, self._scale), sheet)
        return side

    def _undo(self, chosen: np.ndarray) -> None:
        """Gives those patches that are chosen (P,) what they had before."""
        if not chosen.any():
            return
        template, vertices, _, _ = self._template()
        nearest, patch = self._patches(vertices)
        undone = (patch >= 0) & chosen[patch]
        before = self._state["values"][nearest]
        self._write(template, before, undone)

    def _loops_off(self, kept: np.ndarray) -> int:
        """By how much the surface's loops differ from those before but those of openings that were shut, and
        how many new pin-holes it has."""
        found = topology(*self.joint.subject.surface.to_numpy()[:2])
        loops, pinholes = self._state["loops"] - self._state["spent"][kept].sum(axis=0)
        return int(abs(found.boundary_loops - loops) + max(found.pinholes - max(pinholes, 0), 0))

    def _msdf(self) -> mi.Float:
        return mi.Float(dr.detach(self.joint.subject.msdf))

    def _join(self, kept: np.ndarray) -> None:
        """Opens a narrow way to what has opened in the patches that were kept and lies apart."""
        template, vertices, faces, values = self._template()
        inside, opened = self._inside(vertices, kept), values <= 0
        others = self._openings(vertices, faces, np.where(opened & ~inside, values, self._scale))
        place = equal_patches(opened, faces)
        apart = opened & ~np.isin(place, place[others])
        ways = joined(others, apart & inside, vertices, faces, self._reach) & ~opened
        self._write(template, -self._scale, ways)

    def _part(self, kept: np.ndarray, width: int) -> None:
        """Shuts strips, ``width`` vertices wide on either side, where openings have met."""
        template, vertices, faces, values = self._template()
        inside, opened = self._inside(vertices, kept), self._openings(vertices, faces, values)
        others = self._openings(vertices, faces, np.where(opened & ~inside, values, self._scale))
        strip = opened & ~grown(others, opened, values, faces)
        edges, _ = mesh_edges(faces)
        for _ in range(width):
            strip = spread(strip, edges)
        self._write(template, self._scale, strip)

    def _inside(self, vertices: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Which vertices (V, 3) of the present template are in those patches that are chosen (P,)."""
        patch = self._patches(vertices)[1]
        return (patch >= 0) & chosen[patch]

    def _patches(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of vertices (V, 3) of the present template the nearest ones of that which was changed, and their
        patches, -1 for none."""
        distance, nearest = cKDTree(self._state["points"]).query(vertices)
        near = distance < _NEAR * self._cell
        return nearest, np.where(near, self._state["patch"][nearest], -1)

    def _openings(self, vertices: np.ndarray, faces: np.ndarray, values: np.ndarray) -> np.ndarray:
        """(V,) what is open, but for what is too small to be meant."""
        return self._cleaned(vertices, faces, values) <= 0

    def _cleaned(self, vertices: np.ndarray, faces: np.ndarray, values: np.ndarray) -> np.ndarray:
        """The mSDF (V,) without the openings and the islands that are too small to be meant."""
        return clean_opacity(values, vertices, faces, self.joint.config.topology.min_area)

    @property
    def _reach(self) -> float:
        """Longest way to what opens apart, in world units."""
        return _WAY * self._cell

    @property
    def _cell(self) -> float:
        """Size of a cell of the lattice on which openings have changed, or shall."""
        cell = self._state.get("cell")
        return float(self.joint.subject.cell_size if cell is None else cell)

    @property
    def _scale(self) -> float:
        """Of the new mSDF, in lattice units."""
        return _SURE * self.joint.subject.lattice.spacing

    def _template(self) -> tuple[SurfaceMesh, np.ndarray, np.ndarray, np.ndarray]:
        """The present template, its vertices (V, 3) and faces (F, 3), and the mSDF (V,) at the former."""
        self.joint.apply(geometry=True)
        template = self.joint.subject.template()
        vertices, faces, _ = template.to_numpy()
        return template, vertices, faces, template.interpolate(dr.detach(self.joint.subject.msdf)).numpy()

    def _explained(self, template: SurfaceMesh, iteration: int, *, behind: bool = True) -> Residuals:
        return residuals_of(template, self.joint.scene, self.joint.integrator, self._views, self._pixels,
                            self.joint.seed(iteration), behind=behind)

    def _write(self, template: SurfaceMesh, values: np.ndarray | float, changed: np.ndarray) -> mi.Float:
        """Gives the mSDF new values, (V,) or one, at those vertices of the template that are chosen (V,)."""
        values = np.broadcast_to(values, changed.shape)
        msdf = rewritten(self._msdf(), values, changed, template, self.joint.subject.lattice)
        self.joint.geometry.replace("msdf", msdf)
        return msdf


def doubtful(values: np.ndarray, vertices: np.ndarray, faces: np.ndarray, found: Residuals) -> np.ndarray:
    """(V,) small openings through which the images are explained much worse than by the surface.

    Args:
        values: (V,) negative where the template is open.
        vertices, faces: (V, 3) and (F, 3) of the template.
        found: how well the images are explained through each vertex.
    """
    opened = values <= 0
    surface = found.now[~opened].sum() / max(found.rays[~opened].sum(), 1.0)
    patch, areas = equal_patches(opened, faces), vertex_areas(vertices, faces)
    area, rays, now = (np.bincount(patch, sums)[patch] for sums in (areas, found.rays, found.now))
    small = area < _SMALL * areas.sum()
    return opened & small & (rays > _ENOUGH) & (now > min(_DOUBTFUL * surface, _NOTHING) * rays)


def _loops(vertices: np.ndarray, faces: np.ndarray, solid: np.ndarray) -> tuple[int, int]:
    """Boundary loops and pin-holes of what is solid (V,) of a template."""
    found = topology(*positive_part(vertices, faces, np.where(solid, 1.0, -1.0)))
    return found.boundary_loops, found.pinholes


def _errors(found: Residuals, patch: np.ndarray, solid: np.ndarray, count: int | None = None) -> np.ndarray:
    """(P + 1,) mean squared errors of the patches and of the remaining surface.

    Args:
        patch: (V,) patches from 0 to P - 1, or -1.
        solid: (V,) surface.
        count: P; default as many as there are in ``patch``.
    """
    count = int(patch.max(initial=-1)) + 1 if count is None else count
    label, counted = np.where(patch < 0, count, patch), (patch >= 0) | solid
    rays, now = (np.bincount(label[counted], sums[counted], count + 1) for sums in (found.rays, found.now))
    return np.maximum(now, 1e-6 * rays) / np.maximum(rays, 1.0)
