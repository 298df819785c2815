"""The three fields of a G-Shell on a lattice, as they are kept in files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import memory
from ..errors import UserError
from ..files import replacing
from ..lattice import MOST_CELLS, BlockLattice, Lattice, block_count, lattice_of, make_lattice
from ..lattice.sign_words import is_set

if TYPE_CHECKING:
    import mitsuba as mi

#: Steps that find the point an offset has brought somewhere; the error halves with each, or better.
_FIXED_POINT_STEPS = 4
#: What a file may hold; the first four are values, the rest say where they belong.
_ARRAYS = ("sdf", "msdf", "deform", "weights", "blocks", "block_resolution")


@dataclass(frozen=True)
class LatticeFields:
    """The fields on the host, float32, in the order of ``Lattice``'s vertices.

    >>> from gshell_mi.fields import sphere
    >>> from gshell_mi.lattice import TetLattice
    >>> fields = sphere(TetLattice(8))
    >>> fields.lattice
    TetLattice(resolution=8)
    """

    sdf: np.ndarray
    """Signed distance to the template in lattice units, (n,)."""
    msdf: np.ndarray
    """Manifold signed distance in lattice units, >= 0 on the surface, (n,)."""
    deform: np.ndarray
    """Offsets of the lattice vertices in [-1, 1], (3 n,): x0, y0, z0, x1, ..."""
    grid: str = "tet"
    """The kind of lattice, one of ``lattice.GRIDS``."""
    weights: np.ndarray | None = None
    """Weights of FlexiCubes (``Lattice.weight_count``); None for neutral ones."""
    blocks: np.ndarray | None = None
    """Ids of the blocks that the fields are stored in, see ``BlockLattice``; None for the whole lattice."""
    block_resolution: int = 0
    """Cells per side of the lattice that the ``blocks`` are taken from."""

    @classmethod
    def closed(cls, sdf: np.ndarray, grid: str = "tet") -> LatticeFields:
        """Fields of a watertight surface: mSDF positive everywhere, no offsets."""
        sdf = np.asarray(sdf, np.float32).ravel()
        return cls(sdf, np.ones_like(sdf), np.zeros(3 * sdf.size, np.float32), grid)

    @cached_property
    def lattice(self) -> Lattice | BlockLattice:
        if self.blocks is None:
            return lattice_of(self.grid, self.sdf.size)
        import mitsuba as mi  # blocks live on the device, of whichever variant is set

        def sdf(blocks: BlockLattice) -> mi.Float:
            if blocks.vertex_count != self.sdf.size:
                raise UserError(
                    f"sdf has {self.sdf.size} values, but its blocks have {blocks.vertex_count} vertices"
                )
            return mi.Float(self.sdf)

        return BlockLattice(make_lattice(self.grid, self.block_resolution), mi.UInt32(self.blocks), sdf)

    def to_lattice(self, resolution: int, grid: str | None = None) -> LatticeFields:
        """The fields interpolated on another lattice; neutral weights. Needs a variant.

        Offsets are kept as lengths: they double in units of ``deform`` when the cells halve. What of them
        the new lattice does not allow goes into the other fields, so that the surface stays in place.

        Args:
            resolution: cells per side.
            grid: the kind of lattice; default: the same.

        Raises:
            UserError: the fields are stored in blocks, hence unknown elsewhere.
        """
        if self.blocks is not None:
            raise UserError(
                "fields in blocks are known near their surface only and cannot be resampled; "
                "whole() makes fields of them that are known everywhere"
            )
        old, new = self.lattice, make_lattice(grid or self.grid, resolution)
        if new == old:
            return LatticeFields(self.sdf, self.msdf, self.deform, self.grid)
        import mitsuba as mi

        fields = self._resampler(new)(new.points(mi.Float))
        return LatticeFields(**{name: field.numpy() for name, field in fields.items()}, grid=new.grid)

    def in_blocks(self, resolution: int | None = None) -> LatticeFields:
        """The fields in blocks around their surface, of this lattice or, interpolated, of a finer one.

        As ``to_lattice``, but only the blocks are ever in memory. Needs a Mitsuba variant.
        """
        import mitsuba as mi

        old, new = self.lattice, make_lattice(self.grid, resolution or self.lattice.resolution)
        if new == old:
            given = {name: mi.Float(getattr(self, name)) for name in ("sdf", "msdf", "deform")}
            blocks = BlockLattice.around(new, given["sdf"])
            fields = {name: blocks.take(field) for name, field in given.items()}
        else:
            resampled = self._resampler(new)
            blocks = BlockLattice.around(new, lambda points: resampled(points)["sdf"], mi.Float)
            fields = resampled(blocks.points(mi.Float))
        return LatticeFields(
            **{name: field.numpy() for name, field in fields.items()},
            grid=self.grid,
            blocks=blocks.blocks.numpy(),
            block_resolution=new.resolution,
        )

    def whole(self) -> LatticeFields:
        """Fields in blocks on all of their lattice, with neutral weights: elsewhere as at the nearest stored
        vertex."""
        lattice = self.lattice
        if not isinstance(lattice, BlockLattice):
            return self
        import drjit as dr
        import mitsuba as mi

        sdf = mi.Float(self.sdf)
        # Values at the edge of the blocks may have drifted; on which side it is has not.
        inside = is_set(lattice.signs(sdf), dr.arange(mi.UInt32, lattice.vertex_count))
        sdf = dr.select(inside, -dr.abs(sdf), dr.abs(sdf))
        sdf, msdf, deform = (
            lattice.spread_out(field).numpy() for field in (sdf, mi.Float(self.msdf), mi.Float(self.deform))
        )
        return LatticeFields(sdf, msdf, deform, self.grid)

    def _resampler(self, lattice: Lattice) -> Callable[[mi.Point3f], dict[str, mi.Float]]:
        """From vertices of another lattice to its fields there, such that the surface stays in place."""
        import drjit as dr
        import mitsuba as mi

        from .interpolation import Interpolation

        own = self.lattice
        assert isinstance(own, Lattice), "what is stored in blocks is not resampled"
        at = {name: Interpolation(mi.Float(getattr(self, name)), own) for name in ("sdf", "msdf", "deform")}

        def offset(vertices: mi.Point3f) -> mi.Vector3f:
            return self.lattice.max_offset * mi.Vector3f(at["deform"].channels(vertices))

        def resampled(points: mi.Point3f) -> dict[str, mi.Float]:
            limited = dr.clip(offset(points) / lattice.max_offset, -1, 1)
            # Where the offset is cut short, the values are those of another point, found step by step.
            source, goal = mi.Point3f(points), points + lattice.max_offset * limited
            for _ in range(_FIXED_POINT_STEPS):
                source = goal - offset(source)
                dr.eval(source)
            return {"sdf": at["sdf"](source), "msdf": at["msdf"](source), "deform": dr.ravel(limited)}

        return resampled

    def save(self, path: str | Path) -> None:
        """Writes a compressed .npz with the arrays ``sdf``, ``msdf``, ``deform`` and, if any, the others."""
        others: dict[str, Any] = {} if self.weights is None else {"weights": self.weights}
        if self.blocks is not None:
            others |= {"blocks": self.blocks, "block_resolution": np.array(self.block_resolution)}
        # A file object, as NumPy would append .npz to other names.
        with replacing(Path(path)) as partial, open(partial, "wb") as file:
            np.savez_compressed(file, sdf=self.sdf, msdf=self.msdf, deform=self.deform, **others)

    @classmethod
    def load(cls, path: str | Path, grid: str = "tet") -> LatticeFields:
        """Reads what ``save`` wrote; without ``msdf`` it is 1 and without ``deform`` 0 everywhere.

        Args:
            grid: the kind of lattice; the fields at its vertices can be used with any, ``weights`` are left
                out where there are none.

        Raises:
            UserError: the file cannot be read, has no ``sdf``, values that are not finite, or arrays that do
                not fit together or into memory.
        """
        arrays = _arrays_of(path)
        sdf, blocks, block_resolution = arrays["sdf"], None, 0
        if "blocks" in arrays:
            blocks, block_resolution = _checked_blocks(arrays, grid, path)
        else:
            try:
                lattice_of(grid, sdf.size)
            except UserError as error:
                raise UserError(f"{path}: sdf does not fit: {error}") from None
        closed = cls.closed(sdf, grid)
        fields = cls(
            sdf,
            arrays.get("msdf", closed.msdf),
            arrays.get("deform", closed.deform),
            grid,
            blocks=blocks,
            block_resolution=block_resolution,
        )
        if "weights" in arrays and fields.lattice.weight_count:
            fields = replace(fields, weights=arrays["weights"])
        sizes = {"msdf": sdf.size, "deform": 3 * sdf.size, "weights": fields.lattice.weight_count}
        for name, needed in sizes.items():
            size = getattr(fields, name).size if getattr(fields, name) is not None else needed
            if size != needed:
                raise UserError(f"{path}: {name} has {size} values, but sdf needs {needed} of them")
        return fields


def _arrays_of(path: str | Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path) as archive:
            names = [name for name in _ARRAYS if name in archive.files]
            unpacked = sum(
                entry.file_size
                for entry in archive.zip.infolist()
                if entry.filename.removesuffix(".npy") in names
            )
            memory.require(2 * unpacked, memory.free_memory(), f"The archive {path}", "give another")
            arrays = {
                name: archive[name].ravel().astype(np.float32 if name in _ARRAYS[:4] else np.float64)
                for name in names
            }
            found = ", ".join(archive.files) or "none"
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"{path}: cannot be read as an .npz archive of fields ({error})") from error
    if "sdf" not in arrays:
        raise UserError(f"{path}: holds no array 'sdf' (it has {found})")
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise UserError(f"{path}: {name} holds NaN or infinity; write finite values")
    return arrays


def _checked_blocks(arrays: dict[str, np.ndarray], grid: str, path: str | Path) -> tuple[np.ndarray, int]:
    """The numbers of blocks and the cells per side of their lattice, for which nothing else may pass."""
    blocks, resolution = arrays["blocks"], arrays.get("block_resolution", np.zeros(1))
    if resolution.size != 1 or resolution[0] not in range(1, MOST_CELLS + 1):
        raise UserError(f"{path}: has blocks, but no block_resolution from 1 to {MOST_CELLS}")
    count = block_count(make_lattice(grid, int(resolution[0])))
    if (
        len(blocks) == 0
        or (np.diff(blocks) <= 0).any()
        or (blocks % 1).any()
        or blocks[0] < 0
        or (blocks[-1] >= count)
    ):
        raise UserError(f"{path}: its blocks are not ascending whole numbers below {count}")
    return blocks.astype(np.uint32), int(resolution[0])


def closed_at_border(sdf: np.ndarray, lattice: Lattice) -> np.ndarray:
    """A signed distance field made finite, and outside at the cube's faces: its template is watertight."""
    sdf, outside = np.clip(sdf, -1.0, 1.0).astype(np.float32), np.float32(0.5 * lattice.spacing)
    return np.where(lattice.on_border(), np.maximum(sdf, outside), sdf)
