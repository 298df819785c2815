"""The entrance to extraction: checks the fields and hands them to the lattice's algorithm."""

import drjit as dr

from ..arrays import Field, Float
from ..errors import UserError
from ..lattice import BccLattice, BlockLattice, CubeLattice, FlexiCubesLattice, Lattice, TetLattice
from .bcc import BccExtraction
from .cubes import CubeExtraction
from .flexicubes import FlexiCubesExtraction
from .grid_extraction import GridExtraction
from .surface_mesh import SurfaceMesh
from .tetrahedra import TetExtraction

_ALGORITHMS: dict[str, type[GridExtraction]] = {
    TetLattice.grid: TetExtraction,
    CubeLattice.grid: CubeExtraction,
    FlexiCubesLattice.grid: FlexiCubesExtraction,
    BccLattice.grid: BccExtraction,
}


def extract(
    lattice: Lattice | BlockLattice,
    sdf: Float,
    msdf: Float | None = None,
    deform: Field | None = None,
    *,
    weights: Float | None = None,
    template: bool = False,
) -> SurfaceMesh:
    """The surface ``{sdf = 0, msdf >= 0}`` as a triangle mesh, differentiable in all three fields.

    A vertex is inside where ``sdf < 0``; faces point outwards. Where a field crosses 0 very close to a
    lattice vertex (or is exactly 0 there) the mesh vertex is kept a small fraction of the edge away, so
    that no triangle degenerates; derivatives are those of the formula at the shifted point. The surface
    ends in an open boundary where it leaves the lattice: a field that is positive on the border of the
    lattice has a watertight template. (In FlexiCubes the border counts as outside.)

    Args:
        lattice: the lattice of n vertices, whose docstring gives their order; or, as a narrow band, a
            ``BlockLattice`` of n stored vertices.
        sdf: signed distance in lattice units, Dr.Jit ``Float`` or tensor of n values. Its type decides
            the backend that everything is computed on.
        msdf: manifold signed distance (n values); None keeps the whole template.
        deform: offsets of the lattice vertices as ``Array3f`` of n or flat ``Float`` of 3 n values
            (x0, y0, z0, x1, ...), clipped to [-1, 1], where 1 is ``lattice.max_offset``; None for none.
        weights: for a ``FlexiCubesLattice``, 21 values per cube (``weight_count``). Any real number
            w stands for the positive weight 1 + 0.9 tanh(w); None for 0, which is neutral.
        template: also return the watertight template as ``SurfaceMesh.template``.

    Raises:
        UserError: a field has a wrong size or holds NaN or infinity; the sentence names it.

    >>> import drjit as dr, drjit.llvm.ad as d
    >>> lattice = TetLattice(16)
    >>> p = lattice.points(d.Float)
    >>> ball = extract(lattice, dr.norm(p) - 0.5)
    >>> ball.to_trimesh().is_watertight, ball.to_trimesh().euler_number
    (True, 2)
    >>> bowl = extract(lattice, dr.norm(p) - 0.5, -p.z)  # the half z <= 0
    >>> bowl.to_trimesh().euler_number
    1
    """
    sizes = {"sdf": lattice.vertex_count, "msdf": lattice.vertex_count, "deform": 3 * lattice.vertex_count}
    fields = {"sdf": sdf, "msdf": msdf, "deform": deform}
    if weights is not None:
        if not lattice.weight_count:
            raise UserError(
                f"weights belong to the grid 'flexicubes', not to '{lattice.grid}'; leave them out"
            )
        sizes["weights"], fields["weights"] = lattice.weight_count, weights
    checked = {name: _flat(name, field, sizes[name]) for name, field in fields.items() if field is not None}
    _check_finite(checked)
    algorithm = _ALGORITHMS[lattice.grid](lattice, type(checked["sdf"]))
    return algorithm.run(
        checked["sdf"], checked.get("msdf"), checked.get("deform"), template, checked.get("weights")
    )


def _flat(name: str, field: Field, count: int) -> Field:
    """The field as a flat array (``Array3f`` stays), checked for its size."""
    if dr.is_tensor_v(field):
        field = field.array
    size = dr.width(field) * (3 if dr.depth_v(field) == 2 else 1)
    if size != count:
        raise UserError(f"{name} has {size} values, but the lattice needs {count}")
    return field


def _check_finite(fields: dict[str, Field]) -> None:
    parts = {
        name: list(dr.detach(field)) if dr.depth_v(field) == 2 else [dr.detach(field)]
        for name, field in fields.items()
    }
    # A sum reads all fields once and is not finite if any value is not; should it have overflowed, look again
    # value by value.
    if dr.isfinite(sum(dr.sum(part) for each in parts.values() for part in each))[0]:
        return
    for name, each in parts.items():
        if not all(dr.all(dr.isfinite(part))[0] for part in each):
            raise UserError(f"{name} holds NaN or infinite values")
