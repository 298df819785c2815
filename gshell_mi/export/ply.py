"""Triangle meshes with vertex attributes as PLY files, in the naming that Mitsuba's ``ply`` shape reads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from ..errors import UserError, last_line
from ..files import replacing
from ..mesh_files import check_triangles


@dataclass(frozen=True)
class FittedMesh:
    """A mesh as a fit writes it.

    Attributes:
        vertices: (V, 3) world positions.
        faces: (F, 3) vertex indices.
        normals: (V, 3) unit normals.
        attributes: (V,) or (V, 3) arrays by name, such as ``color``, ``roughness``, ``metallic``, ``msdf``.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    attributes: dict[str, np.ndarray]


def write_ply(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    attributes: dict[str, np.ndarray],
) -> None:
    """Writes a mesh; the attribute ``vertex_color`` becomes the properties ``color_0`` and so on."""
    columns = {"x": vertices[:, 0], "y": vertices[:, 1], "z": vertices[:, 2]}
    columns |= {"nx": normals[:, 0], "ny": normals[:, 1], "nz": normals[:, 2]}
    for name, values in attributes.items():
        for channel, column in enumerate(np.atleast_2d(values.T)):
            columns[f"{name.removeprefix('vertex_')}_{channel}"] = column
    header = "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {len(vertices)}",
            *(f"property float {name}" for name in columns),
            f"element face {len(faces)}",
            "property list uchar int vertex_indices",
            "end_header",
            "",
        ]
    )
    table = np.empty((len(vertices), len(columns)), "<f4")
    for index, column in enumerate(columns.values()):
        table[:, index] = column
    rows = np.empty(len(faces), np.dtype([("count", "u1"), ("indices", "<i4", 3)]))
    rows["count"], rows["indices"] = 3, faces
    with replacing(path) as partial:
        partial.write_bytes(header.encode() + table.tobytes() + rows.tobytes())


def read_ply(path: Path) -> FittedMesh:
    """Reads what ``write_ply`` wrote.

    Raises:
        UserError: the file is missing or no such mesh, or values in it are not finite.
    """
    if not path.is_file():
        raise UserError(f"'{path}' does not exist; give the folder of a finished fit.")
    if b"\nelement face 0\n" in path.read_bytes()[:4096]:  # which trimesh takes for no mesh at all
        return FittedMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3)), {})
    attributes = {}
    try:
        mesh: Any = trimesh.load(path, process=False, force="mesh")
        table = mesh.metadata["_ply_raw"]["vertex"]["data"]
        columns = {name: np.ravel(table[name]) for name in table.dtype.names}
        stacked = {
            axes: np.stack([columns.pop(name) for name in names], axis=1)
            for axes, names in (("p", ("x", "y", "z")), ("n", ("nx", "ny", "nz")))
        }
        for name in sorted(columns):
            stem, _, channel = name.rpartition("_")
            attributes.setdefault(stem, []).append((int(channel), columns[name]))
        _check(mesh, stacked, columns, attributes)
    except Exception as error:
        raise UserError(
            f"'{path}' cannot be read as a fitted mesh ({last_line(error)}); run the fit again."
        ) from error
    return FittedMesh(
        stacked["p"],
        np.asarray(mesh.faces, np.int64),
        stacked["n"],
        {
            name: channels[0][1] if len(channels) == 1 else np.stack([c for _, c in sorted(channels)], axis=1)
            for name, channels in attributes.items()
        },
    )


def _check(
    mesh: trimesh.Trimesh,
    stacked: dict[str, np.ndarray],
    columns: dict[str, np.ndarray],
    attributes: dict[str, list[tuple[int, np.ndarray]]],
) -> None:
    for name, channels in attributes.items():
        if sorted(number for number, _ in channels) not in ([0], [0, 1, 2]):
            raise ValueError(f"its {name} has neither one channel nor three")
    check_triangles(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64))
    for name, values in [("position", stacked["p"]), ("normal", stacked["n"]), *columns.items()]:
        if not np.isfinite(values).all():
            raise ValueError(f"its {name} is NaN or infinite somewhere")
