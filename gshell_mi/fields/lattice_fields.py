"""The three fields of a G-Shell on a lattice, as they are kept in files."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from ..errors import UserError
from ..lattice import Lattice, make_lattice


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

    @classmethod
    def closed(cls, sdf: np.ndarray, grid: str = "tet") -> "LatticeFields":
        """Fields of a watertight surface: mSDF positive everywhere, no offsets."""
        sdf = np.asarray(sdf, np.float32).ravel()
        return cls(sdf, np.ones_like(sdf), np.zeros(3 * sdf.size, np.float32), grid)

    @property
    def lattice(self) -> Lattice:
        return make_lattice(self.grid, round(self.sdf.size ** (1 / 3)) - 1)

    def to_lattice(self, resolution: int) -> "LatticeFields":
        """The fields on a lattice of another resolution, interpolated trilinearly; neutral weights.

        Offsets are kept as lengths: they double in units of ``deform`` when the cells halve, and are
        clipped to what the new lattice allows.
        """
        old, new = self.lattice, make_lattice(self.grid, resolution)

        def zoom(values: np.ndarray) -> np.ndarray:
            volume = values.reshape((old.stride,) * 3)
            return ndimage.zoom(volume, new.stride / old.stride, order=1, mode="nearest").ravel()

        scale = old.max_offset / new.max_offset
        deform = np.stack([zoom(self.deform[axis::3]) for axis in range(3)], axis=-1) * scale
        clipped = np.clip(deform, -1, 1).astype(np.float32)
        return LatticeFields(zoom(self.sdf), zoom(self.msdf), clipped.ravel(), self.grid)

    def save(self, path: str | Path) -> None:
        """Writes a compressed .npz with the arrays ``sdf``, ``msdf``, ``deform`` and, if any, ``weights``."""
        weights = {} if self.weights is None else {"weights": self.weights}
        with open(path, "wb") as file:  # a file object, as NumPy would append .npz to other names
            np.savez_compressed(file, sdf=self.sdf, msdf=self.msdf, deform=self.deform, **weights)

    @classmethod
    def load(cls, path: str | Path, grid: str = "tet") -> "LatticeFields":
        """Reads what ``save`` wrote; without ``msdf`` it is 1 and without ``deform`` 0 everywhere.

        Args:
            grid: the kind of lattice; the fields at its vertices can be used with any, ``weights`` are left
                out where there are none.

        Raises:
            UserError: the file cannot be read, has no ``sdf`` or arrays that do not fit together.
        """
        try:
            with np.load(path) as archive:
                arrays = {k: np.asarray(archive[k], np.float32).ravel() for k in archive.files}
        except Exception as error:
            raise UserError(f"{path}: cannot be read as an .npz archive of fields ({error})") from error
        if "sdf" not in arrays:
            raise UserError(f"{path}: holds no array 'sdf' (it has {', '.join(arrays) or 'none'})")
        sdf = arrays["sdf"]
        stride = round(sdf.size ** (1 / 3))
        if stride**3 != sdf.size or stride < 2:
            raise UserError(f"{path}: sdf has {sdf.size} values, which is not (resolution + 1)^3")
        closed = cls.closed(sdf, grid)
        fields = cls(sdf, arrays.get("msdf", closed.msdf), arrays.get("deform", closed.deform), grid)
        if "weights" in arrays and fields.lattice.weight_count:
            fields = replace(fields, weights=arrays["weights"])
        sizes = {"msdf": sdf.size, "deform": 3 * sdf.size, "weights": fields.lattice.weight_count}
        for name, needed in sizes.items():
            size = getattr(fields, name).size if getattr(fields, name) is not None else needed
            if size != needed:
                raise UserError(f"{path}: {name} has {size} values, but sdf needs {needed} of them")
        return fields
