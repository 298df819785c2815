"""The ``gshell`` shape plugin: a Mitsuba mesh that is extracted from fields on a lattice."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from . import compat, memory
from .arrays import ArrayT
from .conversion import from_mesh
from .errors import UserError
from .extraction import SurfaceMesh, extract
from .extraction.surface_mesh import gather
from .fields import LatticeFields, sphere
from .fields.carried import Carried
from .lattice import BlockLattice, make_lattice
from .timing import phase

_FIELDS = ("sdf", "msdf", "deform", "weights")
_LATTICE_PREFIX = "lattice_"
_UNMERGED = "vertex_unmerged"

#: Bytes per lattice vertex that constructing a shape takes, measured with 128 and 256 cells per side.
_BYTES_PER_VERTEX = 32
#: The same where a mesh is turned into fields, measured with 128 and 200.
_BYTES_OF_MESH = 150
#: Cells per side; smaller lattices fit anywhere.
_LARGE = 200


class GShell(mi.Mesh):
    """G-Shell (``gshell``): the surface ``{sdf = 0, msdf >= 0}`` of fields on a lattice.

    Plugin parameters:

    * ``resolution`` (int): cells per side of the lattice (default: that of the file, or 64).
    * ``grid`` (string, default ``tet``): ``tet``, ``cube``, ``flexicubes`` or ``bcc``, see ``lattice``.
    * ``to_world`` (transform): maps the lattice's cube [-1, 1]^3 to the world.
    * ``filename`` (string): initial fields: an .npz with ``sdf`` and, if wanted, ``msdf`` and ``deform``, or
      a mesh file in world space (default: a sphere of radius 0.5 in lattice units).
    * ``band`` (bool, default false): keep the fields in blocks around the surface only, so that memory grows
      with the square of the resolution.
    * ``face_normals`` (bool, default false): shade with face normals instead of smooth ones.
    * a nested ``bsdf``: the material.

    ``mi.traverse`` shows, beside the parameters of a mesh:

    * ``sdf``, ``msdf``: one value per lattice vertex, in lattice units; with ``band`` per stored vertex of
      ``lattice``, a ``BlockLattice``, and so the others.
    * ``deform``: three values per lattice vertex; 1 is the greatest offset that rules out self-intersection,
      beyond it they are clipped.
    * ``weights``: with ``flexicubes`` only: 21 values per cube, 0 is neutral, see ``extract``.
    * ``lattice_<name>``: the lattice field of the mesh attribute ``<name>``, after ``attach_attribute``.

    When any of them changes, ``params.update()`` extracts the mesh anew; derivatives of its vertices,
    normals and attributes lead back to the fields. Vertex and face buffers are padded to sizes from a
    geometric ladder, as the kernels of a renderer contain buffer sizes: trailing faces are ``(0, 0, 0)``
    and trailing vertices copies of the first. ``surface`` is the mesh without padding.

    ```xml
    <shape type="gshell" id="subject"> <integer name="resolution" value="64"/> </shape>
    ```

    >>> import mitsuba as mi
    >>> scene = mi.load_dict({"type": "scene", "subject": {"type": "gshell", "resolution": 16}})
    >>> params = mi.traverse(scene)
    >>> params["subject.sdf"] = params["subject.sdf"] - 0.25  # the radius grows to 0.75
    >>> _ = params.update()
    >>> bool(scene.ray_intersect(mi.Ray3f([0, 0, -3], [0, 0, 1])).t[0] < 2.26)
    True

    Raises:
        UserError: of an unknown grid, a bad resolution or a file that cannot be used.
    """

    surface: SurfaceMesh
    """The present mesh in world space, without padding; attached to the fields."""

    filename: str
    """The file of the initial fields, or an empty string."""

    grid_is_given: bool
    """Whether the parameters name the kind of lattice, or a file that has one."""

    def __init__(self, props: mi.Properties):
        grid = props.get("grid", "tet")
        resolution = int(props["resolution"]) if "resolution" in props else None
        self.filename = props.get("filename", "")
        self.grid_is_given = bool(self.filename) or "grid" in props
        smooth = not props.get("face_normals", False)
        band = props.get("band", False)
        self.to_world = compat.to_world(props)
        compat.init_mesh(self, props, has_vertex_normals=smooth)
        self._attributes: dict[str, tuple[mi.Float, int]] = {}
        self._mirrored = bool(np.linalg.det(np.array(self.to_world.matrix)[:3, :3]) < 0)
        self.set_fields(_initial_fields(self.filename, grid, resolution, self.to_world, band))
        # Mitsuba merges the meshes of a scene that have equal materials into plain ones, but for those with
        # attributes. So there is one until somebody looks.
        self.add_attribute(_UNMERGED, 1, dr.zeros(mi.Float, self.vertex_count()))

    def traverse(self, callback: mi.TraversalCallback) -> None:
        if self.has_attribute(_UNMERGED):
            self.remove_attribute(_UNMERGED)
        differentiable = mi.ParamFlags.Differentiable
        for name in self.field_names:
            callback.put(name, getattr(self, name), differentiable | mi.ParamFlags.Discontinuous)
        for name, (field, _) in self._attributes.items():
            callback.put(_LATTICE_PREFIX + name, field, differentiable)
        super().traverse(callback)

    def parameters_changed(self, keys: list[str]) -> None:
        if not keys or any(key in _FIELDS for key in keys):
            self._extract()
        elif any(key.startswith(_LATTICE_PREFIX) for key in keys):
            # The mesh stays, and so does the structure that rays are traced with.
            compat.write_parameters(self, self._mesh_attributes(_Padding(self.surface.vertex_count)))
        else:
            super().parameters_changed(keys)

    def attach_attribute(self, name: str, field: mi.Float) -> None:
        """Gives the mesh a vertex attribute that is interpolated from a lattice field.

        The field appears in ``mi.traverse`` as ``lattice_<name>`` and a ``mesh_attribute`` texture reads
        it by ``name``. An attribute attached before takes on the new field.

        Args:
            name: starts with ``vertex_``, e.g. ``vertex_color``.
            field: ``mi.Float`` of one value or, as (r0, g0, b0, r1, ...), three per lattice vertex.

        Raises:
            UserError: the name or the number of values does not fit.
        """
        if not name.startswith("vertex_"):
            raise UserError(f"the name of a vertex attribute starts with 'vertex_', unlike '{name}'")
        channels, rest = divmod(dr.width(field), self.lattice.vertex_count)
        if rest or channels not in (1, 3):
            raise UserError(
                f"the attribute '{name}' has {dr.width(field)} values, but the lattice needs "
                f"{self.lattice.vertex_count} or three times as many"
            )
        self._attributes[name] = (mi.Float(field), channels)
        if self.has_attribute(name):
            self.remove_attribute(name)
        self.add_attribute(name, channels, dr.zeros(mi.Float, channels * self.vertex_count()))
        self._write()

    def set_fields(self, fields: LatticeFields) -> None:
        """Replaces the lattice and all its fields, at any resolution; attached attributes are dropped.

        The parameters of an earlier ``mi.traverse`` are stale then, and a scene that holds the shape has to
        be told by ``scene.parameters_changed()``.
        """
        for name in self._attributes:
            self.remove_attribute(name)
        self._attributes = {}
        self.lattice = fields.lattice
        self.sdf, self.msdf, self.deform = (mi.Float(getattr(fields, name)) for name in _FIELDS[:3])
        weights = fields.weights
        self.weights = dr.zeros(mi.Float, self.lattice.weight_count) if weights is None else mi.Float(weights)
        self._extract()

    def shade_flat(self) -> None:
        """Shades with face normals from now on, as ``face_normals`` does from the start."""
        if self.has_vertex_normals():
            compat.drop_vertex_normals(self)

    def fields(self) -> LatticeFields:
        """A copy of the present fields on the host."""
        arrays: dict[str, Any] = {name: np.array(dr.detach(getattr(self, name))) for name in self.field_names}
        if isinstance(self.lattice, BlockLattice):
            arrays |= {"blocks": self.lattice.blocks.numpy(), "block_resolution": self.lattice.resolution}
        return LatticeFields(grid=self.lattice.grid, **arrays)

    def follow(self, *, rescan: bool = False) -> Carried | None:
        """With ``band``: lets the blocks follow the surface, to be called after ``params.update()``.

        Blocks are added when the surface has come near their edge. Parameters that an earlier
        ``mi.traverse`` has shown stay valid and have new sizes.

        Args:
            rescan: also drop the blocks that the surface has left.

        Returns:
            What brings an optimiser's state to the new blocks; None if the blocks stay.
        """
        before, cells = self.lattice, self.surface.cells
        if not isinstance(before, BlockLattice) or cells is None or (not rescan and before.covers(cells)):
            return None
        carried = Carried.following(before, cells, self.sdf, keep=not rescan)
        if carried.is_identity:
            return None
        params = mi.traverse(self)
        for name, field in self._fields().items():
            params[name] = carried.sdf(field) if name == "sdf" else carried.values(dr.detach(field))
        for name, (field, _) in self._attributes.items():
            params[_LATTICE_PREFIX + name] = carried.values(dr.detach(field))
        self.lattice = carried.after
        params.update()
        return carried

    def template(self) -> SurfaceMesh:
        """The watertight template of the present fields, in world space."""
        template = extract(self.lattice, **self._fields(), template=True).template
        assert template is not None, "it was asked for"
        return self._in_world(template)

    def surface_of(self, fields: LatticeFields, *, template: bool = False) -> SurfaceMesh:
        """The surface of other fields in this shape's place, in world space; the shape stays as it is.

        Args:
            fields: on any lattice.
            template: the watertight template instead.
        """
        lattice = fields.lattice
        values = {name: mi.Float(getattr(fields, name)) for name in _FIELDS[:3]}
        if lattice.weight_count:
            neutral, given = dr.zeros(mi.Float, lattice.weight_count), fields.weights
            values["weights"] = neutral if given is None else mi.Float(given)
        mesh = extract(lattice, **values, template=template)
        wanted = mesh.template if template else mesh
        assert wanted is not None, "it was asked for"
        return self._in_world(wanted)

    @property
    def cell_size(self) -> float:
        """Side of a cell in world units: the cube root of its volume."""
        return self.lattice.spacing * self.length_scale

    @property
    def length_scale(self) -> float:
        """World units per lattice unit: the cube root of the transform's volume ratio."""
        return float(abs(np.linalg.det(np.array(self.to_world.matrix)[:3, :3])) ** (1 / 3))

    @property
    def field_names(self) -> tuple[str, ...]:
        """The parameters that make the surface: ``weights`` are among them with FlexiCubes only."""
        return _FIELDS if self.lattice.weight_count else _FIELDS[:3]

    def _fields(self) -> dict[str, mi.Float]:
        return {name: getattr(self, name) for name in self.field_names}

    def _in_world(self, surface: SurfaceMesh) -> SurfaceMesh:
        if surface.is_empty:
            return surface
        p = mi.Transform4f(self.to_world) @ mi.Point3f(surface.vertices)
        a, b, c = surface.faces
        faces = type(surface.faces)(a, c, b) if self._mirrored else surface.faces
        return replace(surface, vertices=type(surface.vertices)(p), faces=faces)

    def _extract(self) -> None:
        with phase("extraction") as compute:
            self.surface = self._in_world(extract(self.lattice, **self._fields()))
            compute(self.surface.vertices)
        self._write()

    def _write(self) -> None:
        """Writes ``surface`` into the buffers of the mesh."""
        surface = self.surface
        vertices, faces = _Padding(surface.vertex_count), _Padding(surface.face_count)
        normals = None
        if self.has_vertex_normals():
            normals = dr.ravel(vertices.apply(surface.vertex_normals()))
        compat.write_mesh(
            self,
            dr.ravel(vertices.apply(surface.vertices)),
            dr.ravel(faces.apply(surface.faces, fill_with_zero=True)),
            normals,
            **self._mesh_attributes(vertices),
        )

    def _mesh_attributes(self, vertices: _Padding) -> dict[str, mi.Float]:
        return {
            name: dr.ravel(vertices.apply(self.surface.interpolate(field, channels)))
            for name, (field, channels) in self._attributes.items()
        }

    def to_string(self) -> str:
        return (
            f"GShell[resolution={self.lattice.resolution}, grid={self.lattice.grid}, "
            f"vertices={self.surface.vertex_count}, faces={self.surface.face_count}]"
        )


class _Padding:
    """Extends arrays to the next size of a ladder with steps of at most a quarter."""

    def __init__(self, count: int):
        self.count = count
        step = max(1 << max(count - 1, 0).bit_length() - 3, 16) if count > 4 else 16
        self.size = max(-(-count // step) * step, step)

    def apply(self, values: ArrayT, fill_with_zero: bool = False) -> ArrayT:
        if self.count == 0:
            return dr.zeros(type(values), self.size)
        index = dr.arange(mi.UInt32, self.size)
        exists = index < dr.opaque(mi.UInt32, self.count)
        padded = gather(type(values), values, dr.select(exists, index, 0))
        return dr.select(exists, padded, 0) if fill_with_zero else padded


def _initial_fields(
    filename: str, grid: str, resolution: int | None, to_world: mi.ScalarTransform4f, band: bool
) -> LatticeFields:
    lattice = make_lattice(grid, 64 if resolution is None else resolution)
    path = mi.file_resolver().resolve(filename) if filename else ""
    of_mesh = bool(filename) and not str(path).endswith(".npz")
    # A mesh needs the whole lattice, whatever is stored of it then.
    if lattice.resolution > _LARGE and (of_mesh or not band):
        memory.require(
            (_BYTES_OF_MESH if of_mesh else _BYTES_PER_VERTEX) * lattice.vertex_count,
            memory.free_memory() if of_mesh else memory.free_memory_of_variant(),
            f"A lattice of {lattice.resolution} cells per side",
            "lower its resolution",
        )
    if not filename:
        return sphere(lattice, in_blocks=band)
    if of_mesh:
        fields = from_mesh(str(path), lattice, to_world=np.array(to_world.matrix))
        return fields.in_blocks() if band else fields
    fields = LatticeFields.load(str(path), grid)
    if resolution not in (None, fields.lattice.resolution):
        raise UserError(
            f"{path}: holds fields of resolution {fields.lattice.resolution}, but the shape asks for "
            f"{resolution}; leave 'resolution' out or change it"
        )
    return fields.in_blocks() if band and fields.blocks is None else fields


mi.register_shape("gshell", lambda props: GShell(props))
