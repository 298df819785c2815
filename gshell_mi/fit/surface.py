"""What one stage hands to the next: a surface on a lattice, and what was seen there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import mitsuba as mi
import numpy as np

from ..extraction.surface_mesh import SurfaceMesh
from ..fields import LatticeFields
from ..lattice import GRIDS, BlockLattice, Lattice
from ..material import ATTRIBUTES
from ..template.msdf import splat_to_lattice

#: Median reflectance that the first split of radiance into material and light assumes.
TYPICAL_REFLECTANCE = 0.5

#: Radiance, over that of the even light, that something may have: white paint reflects 0.8, and what faces
#: the sun or a window gets some 2.5 times the light that all of an object gets in the mean.
_WHITE = 0.8 * 2.5

#: Share of a surface that is not brighter than its brightest parts.
_BRIGHTEST = 0.98

#: Lattice fields that are always there, and those that some surfaces have.
_FIELDS, _OPTIONAL = ("sdf", "msdf", "deform"), ("weights", "blocks")

#: What is found of the views.
_OF_VIEWS = "gains", "ignored", "poses", "light_turns"


@dataclass(frozen=True)
class Seen:
    """What images show of a surface as long as there is neither light nor material.

    Attributes:
        radiance: (n, 3) at the lattice's vertices.
        known: (n,) which of these have one.
        light: brightness of an even light that explains it.
    """

    radiance: np.ndarray
    known: np.ndarray
    light: np.float32

    @classmethod
    def on(
        cls, lattice: Lattice | BlockLattice, template: SurfaceMesh, radiance: np.ndarray, light: np.float32
    ) -> Seen:
        """From (V, 3) radiance of a template's vertices."""
        spread, known = splat_to_lattice(mi.Float(radiance.ravel()), template, lattice)
        return cls(spread.numpy().reshape(-1, 3), known.numpy(), light)

    @staticmethod
    def even_light(radiance: np.ndarray) -> np.float32:
        """Brightness of the darkest even light that explains radiance, (V, 3), as of what is of a usual kind.

        Were it as dark as the median alone tells, white seams of something black could not be explained: no
        reflectance exceeds 1, and few bright places do not make the light brighter. Where nothing is seen it
        is 1.
        """
        if not len(radiance):
            return np.float32(1)
        typical = np.median(radiance.mean(axis=1)) / TYPICAL_REFLECTANCE
        return np.float32(max(typical, np.quantile(radiance.max(axis=1), _BRIGHTEST) / _WHITE))


@dataclass(frozen=True)
class Moved:
    """Where a stage has moved the vertices of the surface's template.

    Attributes:
        stage: its name.
        positions: (V, 3) world positions.
        radiance: (V, 3) of the outer side.
        fitted: the radiance's optimiser, for a stage that goes on from there.
    """

    stage: str
    positions: np.ndarray
    radiance: np.ndarray
    fitted: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Surface:
    """A surface, immutable.

    Attributes:
        fields: its fields on a lattice.
        hull: (n,) the signed distance before thin parts were grown; None where none were.
        seen: what was seen there; None before anything was looked at.
        moved: where stages have moved its template, the best first.
        model: material, light and texture that later stages have left, flat arrays by name.
        settled: whether material and light were fitted to just this, as these cameras see it.
        gains: (N, 3) what each view's channels are multiplied by, as it was exposed; None if by nothing.
        ignored: pixels that tell nothing, of all views one after the other, eight to a byte; None for none.
        poses: (N, 6) corrections of the cameras, as of ``Corrections``; None if they are as given.
        light_turns: () whether the light turns with the camera; None if that is as the settings say.
    """

    fields: LatticeFields
    hull: np.ndarray | None = None
    seen: Seen | None = None
    moved: tuple[Moved, ...] = ()
    model: Mapping[str, np.ndarray] = field(default_factory=dict)
    settled: bool = False
    gains: np.ndarray | None = None
    ignored: np.ndarray | None = None
    poses: np.ndarray | None = None
    light_turns: np.ndarray | None = None

    @property
    def sight(self) -> Seen:
        """What was seen, for the stages after the one that looks first."""
        assert self.seen is not None, "something was looked at"
        return self.seen

    @property
    def hull_distance(self) -> np.ndarray:
        """(n,) signed distance of the hull, for the stages that follow it."""
        assert self.hull is not None, "it comes from a hull"
        return self.hull

    @property
    def lattice(self) -> Lattice | BlockLattice:
        """What the fields live on."""
        return self.fields.lattice

    def on_grid(self, grid: str) -> Surface:
        """The same values at the same vertices, drawn with another kind of cells."""
        return replace(self, fields=replace(self.fields, grid=grid))

    def tells_the_same(self, other: Surface) -> bool:
        """Whether the same was found of the views."""
        return all(getattr(self, name) is getattr(other, name) for name in _OF_VIEWS)

    def after(self, before: Surface) -> Surface:
        """The same, with what was found of the views before unless that has changed."""
        return replace(
            self, **{name: getattr(before, name) for name in _OF_VIEWS if getattr(self, name) is None}
        )

    def with_fields(self, **fields: np.ndarray) -> Surface:
        """The surface with some of its lattice fields replaced."""
        return replace(self, fields=replace(self.fields, **fields))

    def whole(self) -> Surface:
        """The surface with fields and material on all of their lattice, and neutral weights; what is not
        stored is as the nearest vertex of all that are."""
        lattice = self.lattice
        if not isinstance(lattice, BlockLattice):
            return self
        return replace(self, fields=self.fields.whole(), model=self._carried(lattice.spread_out))

    def in_blocks(self) -> Surface:
        """The surface with fields and material in blocks around it."""
        fields = self.fields.in_blocks()
        assert isinstance(fields.lattice, BlockLattice)
        return replace(self, fields=fields, model=self._carried(fields.lattice.take))

    def _carried(self, carry: Callable[[mi.Float], mi.Float]) -> dict[str, np.ndarray]:
        """The model, that of it which lies on the lattice carried to other vertices."""
        return {
            name: carry(mi.Float(values)).numpy() if name in ATTRIBUTES else values
            for name, values in self.model.items()
        }

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The surface as flat arrays, for ``from_arrays``."""
        arrays = {
            "grid": np.array(GRIDS.index(self.fields.grid)),
            "settled": np.array(self.settled),
            "block_resolution": np.array(self.fields.block_resolution),
        }
        optional = {name: getattr(self.fields, name) for name in (*_FIELDS, *_OPTIONAL)}
        optional |= {"hull": self.hull} | {name: getattr(self, name) for name in _OF_VIEWS}
        arrays |= {name: array for name, array in optional.items() if array is not None}
        if self.seen:
            arrays |= {name: getattr(self.seen, name) for name in ("radiance", "known", "light")}
        for index, moved in enumerate(self.moved):
            arrays |= {
                f"moved {index} {moved.stage} {name}": np.asarray(getattr(moved, name))
                for name in ("positions", "radiance")
            }
            arrays |= {
                f"moved {index} {moved.stage} fitted {name}": array for name, array in moved.fitted.items()
            }
        arrays |= {f"model {name}": array for name, array in self.model.items()}
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Surface:
        """What ``to_arrays`` gave."""
        fields = LatticeFields(
            **{name: arrays[name] for name in _FIELDS},
            grid=GRIDS[int(arrays["grid"])],
            **{name: arrays[name] for name in _OPTIONAL if name in arrays},
            block_resolution=int(arrays["block_resolution"]),
        )
        seen = None
        if "radiance" in arrays:
            seen = Seen(arrays["radiance"], arrays["known"], np.float32(arrays["light"]))
        stages = sorted({tuple(name.split(" ")[1:3]) for name in arrays if name.startswith("moved ")})
        moved = [_moved(stage, under(arrays, f"moved {index} {stage} ")) for index, stage in stages]
        return cls(
            fields,
            arrays.get("hull"),
            seen,
            tuple(moved),
            under(arrays, "model "),
            bool(arrays["settled"]),
            **{name: arrays.get(name) for name in _OF_VIEWS},
        )


def _moved(stage: str, arrays: Mapping[str, np.ndarray]) -> Moved:
    return Moved(stage, arrays["positions"], arrays["radiance"], under(arrays, "fitted "))


def under(arrays: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names have a prefix, without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
