"""Openings grow where light and material show that there is nothing.

The ghost finds openings before anything is known of the light. A cap that lies right behind a rim, such as at
the end of a garment's pleat, it may leave: the radiance that it fits to a cap explains the few views that see
in as well as the one that it fits to the dark inside. A path tracer knows how dark that is. So once light and
material are known, it is asked what would be seen without the surface beside an opening. Where that is about
as good without anything having been fitted to it, the opening grows; after further steps it is kept if
the images are then explained better than with the cap.
"""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from ...extraction.surface_mesh import SurfaceMesh
from ...fields.smoothing import MeshDiffusion
from ...topology import equal_patches, mesh_edges, spread, topology
from ...triangles import positive_part
from ...views import PinholeViews
from ..bookkeeping.observer import Preview
from ..ghost.opening import also_opened, clean_opacity, rewritten
from ..ghost.pixels import PixelPool
from .joint import JointStage
from .seen_through import Explained, explained

#: Lambda that smooths errors along the template, and new rims.
_SMOOTHING = 3.0

#: Rays, smoothed, that a vertex must have met.
_RAYS = 3.0

#: What is to be opened is explained worse than most of the surface by this factor ...
_WORSE = 1.5

#: ... and what is behind it, which nothing was fitted to yet, worse than it by at most this one. Behind what
#: is really there it is dozens of times as bad.
_BEHIND = 4.0

#: Gaps of up to twice so many edges are grown over.
_GAP = 1

#: Vertices between openings that would meet, on either side of where they would.
_WALL = 2

#: Fewest vertices that an opening grows by in one place: less is the rim's own matter.
_FEWEST = 12

#: Size, in cells, of the new mSDF.
_SURE = 0.5

#: Of the names in a checkpoint.
_PREFIX = "widening/"

#: Vertices have the patch of what was nearest, up to this many cells away.
_REACH = 1.5


class Widening:
    """A worker that lets the openings of the joint stage grow between its steps.

    Args:
        joint: does the steps; its fields are explicit.
        views, pixels: the targets.
        state: what ``state`` gave, where the stage goes on.
    """

    def __init__(self, joint: JointStage, views: PinholeViews, pixels: PixelPool,
                 state: Mapping[str, np.ndarray]):
        self.joint, self._views, self._pixels = joint, views, pixels
        config, count = joint.config, joint.config.iterations
        #: The steps before which openings grow and are judged.
        self._opens = round(config.widening * count)
        self._judges = (self._opens + count + 1) // 2
        if config.field != "explicit" or config.watertight or self._judges >= count:
            self._opens = count     # never
        self._state = {name: array for name, array in state.items() if name.startswith(_PREFIX)}

    def step(self, iteration: int) -> Mapping[str, float]:
        """One step of the joint stage, after what is to be done before it."""
        if iteration == self._opens:
            self._open(iteration)
        elif iteration == self._judges and f"{_PREFIX}points" in self._state:
            self._judge(iteration)
        return self.joint.step(iteration)

    def preview(self) -> Preview:
        """The joint stage's."""
        return self.joint.preview()

    def state(self) -> dict[str, np.ndarray]:
        """What a checkpoint keeps, so that a fit that goes on judges alike."""
        return dict(self._state)

    def finish(self) -> bool | None:
        """Ends the joint stage; returns whether openings have grown for good, None if none was tried.

        Growing must not change how many boundary loops there are. Rims that meet in the steps afterwards may
        do so: then all that was opened is surface again.
        """
        self.joint.finish()
        kept = self._state.get(f"{_PREFIX}kept")
        if kept is None or not kept.any():
            return None if kept is None else False
        vertices, faces, _ = self.joint.subject.surface.to_numpy()
        if topology(vertices, faces).boundary_loops == self._state[f"{_PREFIX}loops"]:
            return True
        self._close(kept)
        self.joint.finish()
        return False

    def _open(self, iteration: int) -> None:
        template, vertices, faces, values = self._template()
        if (values > 0).all() or (values <= 0).all():
            return
        found = self._explained(template, iteration)
        smooth = MeshDiffusion(faces, len(vertices), _SMOOTHING)
        scale = _SURE * self.joint.subject.lattice.spacing
        added = beside_openings(values, faces, found, smooth)
        if not added.any():
            return
        cleaned = clean_opacity(values, vertices, faces, self.joint.config.ghost_min_area)
        loops = topology(*positive_part(vertices, faces, cleaned)).boundary_loops
        cut, near = also_opened(values, added, smooth, scale)
        self._write(template, cut, near)
        patch = np.full(len(added), -1)
        patch[added] = np.unique(equal_patches(added, faces)[added], return_inverse=True)[1]
        self._state = {f"{_PREFIX}points": vertices, f"{_PREFIX}values": values, f"{_PREFIX}patch": patch,
                       f"{_PREFIX}errors": _errors(found, patch, values > 0),
                       f"{_PREFIX}loops": np.array(loops)}

    def _judge(self, iteration: int) -> None:
        template, vertices, _, values = self._template()
        patch, then = self._patches(vertices)[1], self._state[f"{_PREFIX}errors"]
        now = _errors(self._explained(template, iteration), patch, values > 0, len(then) - 1)
        # All of the surface has been explained better since.
        ratio = now[:-1] / then[:-1] * (then[-1] / now[-1])
        unjustified = ratio >= self.joint.config.widening_gain
        self._close(unjustified)
        self._state[f"{_PREFIX}kept"] = ~unjustified

    def _close(self, chosen: np.ndarray) -> None:
        """Gives back the surface of the patches that are chosen (P,)."""
        if not chosen.any():
            return
        template, vertices, _, values = self._template()
        nearest, patch = self._patches(vertices)
        closed = (patch >= 0) & chosen[patch]
        before = self._state[f"{_PREFIX}values"][nearest]
        self._write(template, np.where(closed, before, values), closed)

    def _patches(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of vertices (V, 3) of the present template the nearest ones of that which was opened, and their
        patches, -1 for none."""
        distance, nearest = cKDTree(self._state[f"{_PREFIX}points"]).query(vertices)
        near = distance < _REACH * self.joint.subject.cell_size
        return nearest, np.where(near, self._state[f"{_PREFIX}patch"][nearest], -1)

    def _template(self) -> tuple[SurfaceMesh, np.ndarray, np.ndarray, np.ndarray]:
        """The present template, its vertices (V, 3) and faces (F, 3), and the mSDF (V,) at the former."""
        self.joint.apply(geometry=True)
        template = self.joint.subject.template()
        vertices, faces, _ = template.to_numpy()
        return template, vertices, faces, template.interpolate(dr.detach(self.joint.subject.msdf)).numpy()

    def _explained(self, template: SurfaceMesh, iteration: int) -> Explained:
        return explained(template, self.joint.scene, self.joint.integrator, self._views, self._pixels,
                         self.joint.seed(iteration))

    def _write(self, template: SurfaceMesh, values: np.ndarray, changed: np.ndarray) -> None:
        """Gives the mSDF new values (V,) at those vertices of the template that have changed (V,)."""
        subject = self.joint.subject
        self.joint.geometry.replace("msdf", rewritten(dr.detach(subject.msdf), values, changed, template,
                                                      subject.lattice))


def beside_openings(values: np.ndarray, faces: np.ndarray, found: Explained,
                    smooth: MeshDiffusion) -> np.ndarray:
    """(V,) vertices beside openings without which the images would be explained about as well.

    Args:
        values: (V,) negative where the template is open.
        faces: (F, 3) of the template.
        found: how well the images are explained through each vertex.
        smooth: along the template.
    """
    solid = values > 0
    rays, now, without = (smooth(mi.Float(sums.astype(np.float32))).numpy()
                          for sums in (found.rays, found.now, found.without))
    met = solid & (rays > _RAYS)
    if not met.any():
        return met
    typical = np.median(now[met] / rays[met])
    empty = met & (now > _WORSE * typical * rays) & (without < _BEHIND * now)
    edges, _ = mesh_edges(faces)
    reached = ~solid | empty
    for _ in range(_GAP):
        reached = spread(reached, edges)
    for _ in range(_GAP):
        reached = ~spread(~reached, edges)
    ratio = np.where(empty, without / np.maximum(now, 1e-30), _BEHIND)
    blocked = reached & ~grown(~solid, reached, ratio, faces)
    # A rim moves: what parts two rims has to be wide enough to outlast that.
    for _ in range(_WALL):
        blocked = spread(blocked, edges)
    added = grown(~solid, reached & ~blocked, ratio, faces) & solid
    patch = equal_patches(added, faces)
    return added & (np.bincount(patch)[patch] >= _FEWEST)


def grown(opened: np.ndarray, allowed: np.ndarray, order: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Openings grown as far as they may without parting a surface or an opening, or joining two of them.

    A vertex may go if its neighbours, in a ring around it, are one run of open ones and one run of others
    (a simple point of digital topology): all loops and handles of the surface stay then.

    Args:
        opened: (V,) the openings.
        allowed: (V,) where they may grow.
        order: (V,) vertices with lower values go first.
        faces: (F, 3) of the watertight template.

    Returns:
        (V,) the openings afterwards.

    >>> upper = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]]
    >>> lower = [[5, 2, 1], [5, 3, 2], [5, 4, 3], [5, 1, 4]]
    >>> number = np.arange(6)
    >>> grown(number == 0, number < 4, number, np.array(upper + lower)).astype(int).tolist()
    [1, 1, 1, 1, 0, 0]
    """
    opened = opened.copy()
    edges, _ = mesh_edges(faces)
    here, there = np.concatenate([edges, edges[:, ::-1]]).T
    rank = np.empty(len(order), int)
    rank[np.argsort(order, kind="stable")] = np.arange(len(order))
    while True:
        changes = np.zeros(len(opened), int)
        for corner in range(3):
            before, after = faces[:, (corner + 1) % 3], faces[:, (corner + 2) % 3]
            differ = opened[before] != opened[after]
            changes += np.bincount(faces[:, corner][differ], minlength=len(opened))
        simple = allowed & ~opened & (changes == 2)
        if not simple.any():
            return opened
        # Whether one may go depends on its neighbours, so of neighbours one goes at a time.
        first = np.full(len(opened), len(opened))
        np.minimum.at(first, here, np.where(simple, rank, len(opened))[there])
        opened |= simple & (rank < first)


def _errors(found: Explained, patch: np.ndarray, solid: np.ndarray, count: int | None = None) -> np.ndarray:
    """(P + 1,) mean squared errors of the patches and of the remaining surface.

    Args:
        patch: (V,) patches from 0 to P - 1, or -1.
        solid: (V,) surface.
        count: P; default as many as there are in ``patch``.
    """
    count = patch.max(initial=-1) + 1 if count is None else count
    label, counted = np.where(patch < 0, count, patch), (patch >= 0) | solid
    rays, now = (np.bincount(label[counted], sums[counted], count + 1) for sums in (found.rays, found.now))
    return np.maximum(now, 1e-6 * rays) / np.maximum(rays, 1.0)
