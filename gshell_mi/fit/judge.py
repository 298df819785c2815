"""The judge of the fit: does a change explain unseen views better? The same rays through before and after."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.stats import false_discovery_control, norm, t

from ..pixels import PixelPool, PixelSample
from ..radiance.contrast import Contrast
from ..radiance.lanes import chosen_lanes, joined_lanes
from ..radiance.shown import JUDGING, Mesh, Met, Part, Shown
from ..targets import Target
from ..views import PinholeViews

#: Pixels this near to a mask's outline do not judge: where a surface ends to a cell is found later.
_OUTLINE = 3

#: Side of the blocks of an image that are compared, too, in edges of the mesh: some wavelengths of what
#: colours at vertices can explain. Two of the T-shirt's openings are only told by them in noise of 0.05.
_BLOCK = 4.0

#: Chance that what is accepted is an accident: two standard errors where one place is judged.
_ACCIDENTS = float(norm.sf(2.0))

#: Errors of this size are none.
_EXACT = 1e-3

#: Logarithms of errors that are sums in single precision are equal up to this.
_ROUNDED = 1e-6

#: Views that have to tell of a place before their spread does.
FEWEST_VIEWS = 4


@dataclass(frozen=True)
class Verdict:
    """How much better a surface after a change explains unseen views, at P places.

    Attributes:
        before, after: (P,) mean error of a ray.
        gain: (P,) mean, over the unseen views, of the logarithm of the error before over that after, at the
            scale that tells more: what is dark, or seen by some views far better than by others, counts as
            much as the rest.
        noise: (P,) standard error of the gain; infinite where hardly a view tells. Views are independent of
            each other, rays of one view are not.
        views: (P,) how many views tell the noise; a view that hardly sees a place is hardly one.
        rejected: how many more places of the same proposal were rejected before.
    """

    before: np.ndarray
    after: np.ndarray
    gain: np.ndarray
    noise: np.ndarray
    views: np.ndarray | float = np.inf
    rejected: int = 0

    @property
    def accepted(self) -> np.ndarray:
        """(P,) whether the gain is no accident.

        Of many places one is better by chance. So of all that is accepted a fixed share may be accidents,
        however many places are asked for (Benjamini and Hochberg 1995): a place alone needs two standard
        errors, as the only one of 24 it needs three, and two again if all the others are better, too. Few
        views do not tell the noise well (Student 1908): eight need 2.4 standard errors instead of two.
        """
        told = np.isfinite(self.noise)
        freedom = np.broadcast_to(self.views, self.noise.shape)[told] - 1
        accident = t.sf(self.gain[told] / self.noise[told], freedom)
        accepted = np.zeros(len(self.gain), bool)
        family = false_discovery_control(np.append(accident, np.ones(self.rejected)))
        accepted[told] = family[: len(accident)] < _ACCIDENTS
        return accepted

    @property
    def reversed(self) -> Verdict:
        """On the change taken back."""
        return Verdict(self.after, self.before, -self.gain, self.noise, self.views, self.rejected)

    @classmethod
    def together(cls, verdicts: list[Verdict]) -> Verdict:
        """On all places of several verdicts, one after the other."""
        columns = zip(*(given._columns for given in verdicts), strict=True)
        before, after, gain, noise, views = (np.concatenate(column) for column in columns)
        return cls(before, after, gain, noise, views)

    def at(self, places: slice) -> Verdict:
        """On some of the places, as if no others had been asked for."""
        before, after, gain, noise, views = (column[places] for column in self._columns)
        return Verdict(before, after, gain, noise, views)

    @property
    def _columns(self) -> tuple[np.ndarray, ...]:
        views = np.broadcast_to(self.views, self.gain.shape)
        return self.before, self.after, self.gain, self.noise, views

    def facts(self) -> dict[str, list[float | None]]:
        """For ``metrics.json``: gain and noise of each place; no noise where hardly a view tells."""
        return {
            "gain": [round(float(value), 5) for value in self.gain],
            "noise": [round(float(value), 5) if np.isfinite(value) else None for value in self.noise],
        }


class Judge:
    """Decides on every discrete change of the surface, by one rule.

    Before and after, each mesh has the mean colour that some views show it in, of one side and of the other,
    times what all of it mirrors, and others judge. What neither can explain so, such as texture finer than
    the meshes, poses and noise, is in both errors. A change counts if the logarithm of their ratio, in the
    mean over the views, is above twice its standard error, or more if many places are asked for. Two scales
    are asked, pixels and the means of small blocks, and the one that tells more speaks: noise and fine
    texture hide what pixels tell, and means hide what is patterned.

    Args:
        views, targets: the images.
        splits: indices of the views that tell the colours, and of those that judge; one pair or more.
        batch: pixels per batch of rays.
        seed: of the random pixels.
        off_outline: pixels as near to a mask's outline as this do not judge.
        like: a judge of the same splits, whose pixels tell this one the colours, too.
    """

    def __init__(
        self,
        views: PinholeViews,
        targets: list[Target],
        splits: list[tuple[np.ndarray, np.ndarray]],
        *,
        batch: int,
        seed: int = 0,
        off_outline: int = _OUTLINE,
        like: Judge | None = None,
    ):
        self.views, self.targets, self.splits = views, targets, splits
        self.batch, self.seed, self.off_outline, self._like = batch, seed, off_outline, like

    @staticmethod
    def halves(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Splits of views: either half judges once what it has not told the colours of."""
        every = np.arange(count)
        return [(every[1::2], every[::2]), (every[::2], every[1::2])] if count > 1 else [(every, every)]

    @cached_property
    def _pools(self) -> list[tuple[PixelPool, PixelPool]]:
        """Pixels that tell the colours, and those that judge."""
        told = (self._like or self)._telling
        return [
            (pool, PixelPool(self.views, self.targets, unknown, self.off_outline))
            for pool, (_, unknown) in zip(told, self.splits, strict=True)
        ]

    @cached_property
    def _telling(self) -> list[PixelPool]:
        return [PixelPool(self.views, self.targets, known) for known, _ in self.splits]

    def shown(self, mesh: Mesh, like: Shown | None = None) -> Shown:
        """A mesh as the images show it, once for each of the splits; it may mirror what another one does."""
        return Shown(mesh, self.views, self._pools, batch=self.batch, seed=self.seed, like=like)

    def compare(
        self,
        before: Part,
        after: Part,
        label: np.ndarray | None = None,
        where: Shown | None = None,
        *,
        places: int | None = None,
    ) -> Verdict:
        """Judges a change.

        Args:
            before, after: the surface without and with the change.
            label: (V,) which change the vertices of a mesh tell of, from 0; -1 where of none. A ray judges
                the change at the vertex that it meets first. Default: all rays judge one change.
            where: that mesh; default: what ``before`` is a part of.
            places: how many there are; default: as many as ``label`` names, at least one.
        """
        places = places or (1 if label is None else max(int(label.max()) + 1, 1))
        where, counts = where or before.shown, self._blocks_per_view(before.shown, after.shown)
        sums = [dr.zeros(mi.Float, places * len(self.views)) for _ in range(5)]
        with dr.suspend_grad():
            for split in range(len(self.splits)):
                looks = [
                    _Look.of(
                        pixel,
                        place,
                        *(
                            part.look(pixel, split, first if part.shown is where else None)
                            for part in (before, after)
                        ),
                    )
                    for pixel, place, first in self._judging(split, label, where)
                ]
                if looks:
                    self._add_errors(sums, joined_lanes(looks), counts, split)
        rays, *errors = (total.numpy().reshape(places, -1) for total in sums)
        return verdict_of(rays, np.stack(errors[::2]), np.stack(errors[1::2]))

    def decide(self, before: Mesh, after: Mesh) -> Verdict:
        """Judges one change of the whole surface."""
        return self.compare(self.shown(before).whole, self.shown(after).whole)

    def _judging(
        self, split: int, label: np.ndarray | None, where: Shown
    ) -> Iterator[tuple[PixelSample, mi.UInt32, Met | None]]:
        """Pixels that judge, the place that they judge, and where their rays meet a mesh first if that tells
        which it is."""
        if label is None:
            for step in range(JUDGING):
                pixel = self._pools[split][1].sample(self.batch, seed=self.seed, step=step)
                yield pixel, dr.zeros(mi.UInt32, dr.width(pixel.view)), None
            return
        rays = where.judging[split]
        place = dr.gather(mi.Int32, mi.Int32(label.astype(np.int32)), rays.met.vertices[0] >> 1, rays.met.hit)
        lane = chosen_lanes(rays.met.hit & (place >= 0), place)
        if dr.width(lane):
            yield rays.pixel.at(lane), mi.UInt32(dr.gather(mi.Int32, place, lane)), rays.met.at(lane)

    def _blocks_per_view(self, *shown: Shown) -> mi.Vector2f:
        """Columns and rows of blocks in each view, with sides of ``_BLOCK`` edges in the middle of meshes."""
        edge = np.mean([mesh.edge for mesh in shown])
        middle = np.mean([mesh.middle for mesh in shown], axis=0)
        pixel = self.views.pixel_size(dr.arange(mi.UInt32, len(self.views))).numpy()
        side = np.maximum(_BLOCK * edge / (pixel * np.linalg.norm(self.views.origins - middle, axis=1)), 1)
        return mi.Vector2f(self.views.sizes.T / side)

    def _add_errors(self, sums: list[mi.Float], look: _Look, counts: mi.Vector2f, split: int) -> None:
        """Adds rays, and errors of pixels and of blocks, before and after, to those of places in views."""
        count, block = look.blocks(counts)
        rays = _group_sums(mi.Float(1), count, block)
        target, *seen = (
            _group_sums(value, count, block) / rays for value in (look.target, look.before, look.after)
        )
        at = look.place * dr.opaque(mi.UInt32, len(self.views)) + look.view
        one = dr.full(mi.Float, 1, dr.width(at))
        added = [
            one,
            *(self._error(split, value, look.target) for value in (look.before, look.after)),
            *(dr.gather(mi.Float, self._error(split, mean, target), block) for mean in seen),
        ]
        for total, value in zip(sums, added, strict=True):
            dr.scatter_reduce(dr.ReduceOp.Add, total, value, at)
        dr.eval(sums)

    def _error(self, split: int, seen: mi.Vector4f, target: mi.Vector4f) -> mi.Float:
        """How badly what is seen explains a target: radiance and coverage of both."""
        pixels = self._pools[split][1]
        tone = Contrast(pixels.mean_radiance())
        # Without masks all of an image is covered: who sees nothing there has explained nothing.
        coverage = dr.opaque(mi.Float, 3 * pixels.mask_weight(1.0) if pixels.has_alpha else 3.0)
        color = sum(dr.abs(tone(seen[channel]) - tone(target[channel])) for channel in range(3))
        return color + coverage * dr.abs(seen.w - target.w)


@dataclass(frozen=True)
class _Look:
    """What images show, and what is seen before and after a change, along rays that judge a place.

    Attributes:
        view, film, place: of each ray.
        target, before, after: radiance and coverage.
    """

    view: mi.UInt32
    film: mi.Point2f
    place: mi.UInt32
    target: mi.Vector4f
    before: mi.Vector4f
    after: mi.Vector4f

    @classmethod
    def of(cls, pixel: PixelSample, place: mi.UInt32, *seen: tuple[mi.Color3f, mi.Float]) -> _Look:
        """Of pixels that judge places, and radiance and coverage seen before and after."""
        return cls(
            pixel.view,
            pixel.film,
            place,
            *(mi.Vector4f(*radiance, alpha) for radiance, alpha in ((pixel.radiance, pixel.alpha), *seen)),
        )

    def blocks(self, counts: mi.Vector2f) -> tuple[int, mi.UInt32]:
        """Groups of the rays of one view and place that go through one block; ``counts`` of these per view.

        Returns:
            How many groups there are, and the group of each ray.
        """
        column, row = self.film * dr.gather(mi.Vector2f, counts, self.view)
        numbers = np.stack([mi.UInt32(value).numpy() for value in (self.place, self.view, row, column)])
        key = np.ravel_multi_index(tuple(numbers.astype(np.int64)), tuple(numbers.max(axis=1) + 1))
        groups, group = np.unique(key, return_inverse=True)
        return len(groups), mi.UInt32(group.astype(np.uint32))


def _group_sums(values: mi.Float | mi.Vector4f, count: int, group: mi.UInt32) -> mi.Float | mi.Vector4f:
    """Sums of the values of each of ``count`` groups."""
    sums = dr.zeros(type(values), count)
    dr.scatter_reduce(dr.ReduceOp.Add, sums, values, group)
    return sums


def places_of(chosen: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """(V,) places for ``Judge.compare``: from 0 on for each patch that a chosen vertex is in, else -1.

    >>> places_of(np.array([True, False, True]), np.array([7, 7, 3])).tolist()
    [1, -1, 0]
    """
    place = np.full(len(chosen), -1)
    place[chosen] = np.unique(patch[chosen], return_inverse=True)[1]
    return place


def verdict_of(rays: np.ndarray, before: np.ndarray, after: np.ndarray) -> Verdict:
    """From (P, N) rays of each place and view, and sums of their errors, (P, N), or (S, P, N) at S scales."""
    before, after = (errors.reshape(-1, *rays.shape) for errors in (before, after))
    total, seen = rays.sum(axis=1), (rays > 0).sum(axis=1)
    mean = np.maximum(total / np.maximum(seen, 1), 1)[:, None]
    # A view that hardly sees a place has hardly a say; one that sees much of it has one voice.
    weight = np.minimum(rays / mean, 1)
    per_ray = np.maximum(rays, 1)
    change = np.log((before / per_ray + _EXACT) / (after / per_ray + _EXACT))
    voices = np.maximum(weight.sum(axis=1), 1e-12)
    gain = (weight * change).sum(axis=-1) / voices
    spread = (weight**2 * (change - gain[..., None]) ** 2).sum(axis=-1)
    noise = np.sqrt(spread * seen / np.maximum(seen - 1, 1)) / voices + _ROUNDED
    noise[:, seen < FEWEST_VIEWS] = np.inf
    # The scale that tells more of a place speaks for it.
    scale = np.argmax(np.abs(gain) / noise, axis=0)[None]
    gain, noise = (np.take_along_axis(values, scale, axis=0)[0] for values in (gain, noise))
    per_ray = np.maximum(total, 1)
    # The number of equal weights that would tell as much (Kish 1965).
    views = voices**2 / np.maximum((weight**2).sum(axis=1), 1e-12)
    return Verdict(before[0].sum(axis=1) / per_ray, after[0].sum(axis=1) / per_ray, gain, noise, views)
