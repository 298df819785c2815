"""``mesh.glb`` and OBJ: the fitted object for Blender, game engines and the web."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from .. import memory
from ..errors import UserError
from ..files import replacing
from ..own_folder import own_folder
from ..scene_files import load_scene
from .atlas import unwrap
from .bake import Textures, bake, project, vertex_tangents
from .gltf import Part, write_glb
from .ply import FittedMesh, read_ply, write_ply
from .remesh import edge_length_for, remesh, triangle_quality
from .stock_scene import up_axis

#: What ``AssetConfig.obj`` adds.
_OBJ_FILES = (
    "mesh.obj",
    "mesh.mtl",
    "mesh_base_color.png",
    "mesh_roughness.png",
    "mesh_metallic.png",
    "mesh_normal.png",
)

#: Bytes that a texel takes: its colour, roughness, metallic and normal, and what they are baked from.
_PER_TEXEL = 100

#: What to say of an object without textures.
NO_ATLAS = (
    "mesh.glb has its colours at the vertices and no textures: its UV atlas took longer than "
    "--unwrap-seconds, or failed; run gshell_mi.export again with more of them, or with a lower --face-count."
)

#: Seconds; what waits for another process counts no longer.
_LONGEST = 1_000_000


@dataclass(frozen=True)
class AssetConfig:
    """Settings of ``write_asset``."""

    face_count: int = 20000
    """Triangles of mesh.glb, about; the boundary keeps each of its edges. A mesh with fewer is taken as
    it is, and 0 takes any as it is."""
    texture_size: int = 1024
    """Pixels per side of the textures."""
    unwrap_seconds: float = 60.0
    """Time limit of the UV atlas, of the processors; beyond it the colours go to the vertices."""
    obj: bool = False
    """Also write mesh.obj with its material and textures."""
    remesh: float | None = None
    """Also write remeshed.ply with triangles of this edge length (world units), boundary included, for
    simulation."""
    min_quality: float = 0.3
    """No triangle of remeshed.ply is worse than this: 4 sqrt(3) area / sum of squared edge lengths, which is
    1 if equilateral."""

    def __post_init__(self) -> None:
        if self.texture_size < 16:
            raise UserError(f"--texture-size must be at least 16 pixels, not {self.texture_size}.")
        memory.require(
            _PER_TEXEL * self.texture_size**2,
            memory.free_memory(),
            f"Textures of {self.texture_size} pixels per side",
            "lower --texture-size",
        )
        if not 0 <= self.unwrap_seconds < _LONGEST:
            raise UserError(
                f"--unwrap-seconds lies between 0 and {_LONGEST}, unlike {self.unwrap_seconds:g}."
            )
        if self.face_count < 0:
            raise UserError(f"--face-count must not be negative, and is {self.face_count}.")
        if not 0 <= self.min_quality < 1:
            raise UserError(f"--min-quality lies between 0 and 1, unlike {self.min_quality:g}.")


def write_asset(folder: Path, config: AssetConfig | None = None) -> dict:
    """Writes ``mesh.glb``, and what else is asked for, from ``mesh.ply`` and the sensors of ``scene.xml``.

    Units are those of the scene (glTF takes them for metres), and the object's name is the folder's. The up
    axis of glTF is y; the object is turned so that the axis which is up in the views (``up_axis``) becomes y.

    Returns:
        Counts: ``faces``, ``charts`` (0: colours are at the vertices), and of ``remeshed.ply``
        ``remeshed_faces`` and ``remeshed_min_quality``.

    Raises:
        UserError: the folder holds no fit, its mesh is empty, remeshing failed, or a file is in the way that
            no run of ours wrote.
    """
    config = config or AssetConfig()
    fine = read_ply(folder / "mesh.ply")
    if len(fine.faces) == 0:
        raise UserError(f"'{folder / 'mesh.ply'}' is empty; there is nothing to export.")
    lacking = [
        name
        for name, axes in (("color", 2), ("roughness", 1), ("metallic", 1))
        if np.ndim(fine.attributes.get(name, 0)) != axes
    ]
    if lacking:
        raise UserError(f"'{folder / 'mesh.ply'}' has no {lacking[0]}; run the fit again, which writes it.")
    names = ["mesh.glb", *(_OBJ_FILES if config.obj else ())]
    if config.remesh is not None:
        names.append("remeshed.ply")
    turn = y_up_turn(folder)  # all is read before anything is written
    with own_folder(folder, "fit") as own:
        own.claim(*names)
        return _write(folder, fine, turn, config)


def _write(folder: Path, fine: FittedMesh, turn: np.ndarray, config: AssetConfig) -> dict:
    # First, as its settings may not suit the mesh.
    remeshed = (
        {} if config.remesh is None else _write_remeshed(folder, fine, config.remesh, config.min_quality)
    )
    fine = FittedMesh(fine.vertices @ turn.T, fine.faces, fine.normals @ turn.T, fine.attributes)
    vertices, faces = _simplified(fine, config.face_count)
    atlas = unwrap(vertices, faces, texture_size=config.texture_size, seconds=config.unwrap_seconds)
    normals = vertex_normals(vertices, faces)
    report = {"faces": len(faces), "charts": atlas.charts if atlas else 0} | remeshed
    name = folder.resolve().name
    if atlas:
        vertices, normals, faces = vertices[atlas.source], normals[atlas.source], atlas.faces
        tangents = vertex_tangents(vertices, normals, faces, atlas.uv)
        textures = bake(fine, vertices, normals, tangents, faces, atlas.uv, config.texture_size)
        part = textured_part(vertices, normals, tangents, faces, atlas.uv, textures, name)
        write_glb(folder / "mesh.glb", [part])
        if config.obj:
            _write_obj(folder, vertices, normals, faces, atlas.uv, textures, name)
    else:
        source = project(fine, vertices, normals)
        color, roughness, metallic = (
            source.interpolate(fine.faces, fine.attributes[name])
            for name in ("color", "roughness", "metallic")
        )
        write_glb(
            folder / "mesh.glb",
            [
                Part(
                    name,
                    faces,
                    {"POSITION": vertices, "NORMAL": normals, "COLOR_0": np.clip(color, 0, 1)},
                    {
                        "doubleSided": True,
                        "pbrMetallicRoughness": {
                            "roughnessFactor": float(np.clip(roughness.mean(), 0, 1)),
                            "metallicFactor": float(np.clip(metallic.mean(), 0, 1)),
                        },
                    },
                )
            ],
        )
        if config.obj:
            with replacing(folder / "mesh.obj") as partial:
                trimesh.Trimesh(vertices, faces, process=False).export(partial)
    return report


def textured_part(
    vertices: np.ndarray,
    normals: np.ndarray,
    tangents: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray,
    textures: Textures,
    name: str,
) -> Part:
    """The object as glTF wants it, both sides visible."""
    attributes = {
        "POSITION": vertices,
        "NORMAL": normals,
        "TANGENT": tangents,
        "TEXCOORD_0": np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1),
    }
    material = {
        "doubleSided": True,
        "normalTexture": "normal",
        "occlusionTexture": "occlusion_roughness_metallic",
        "pbrMetallicRoughness": {
            "baseColorTexture": "base_color",
            "metallicRoughnessTexture": "occlusion_roughness_metallic",
        },
    }
    kinds = "base_color", "occlusion_roughness_metallic", "normal"
    images = {kind: getattr(textures, kind) for kind in kinds}
    return Part(name, faces, attributes, material, images)


def _simplified(fine: FittedMesh, face_count: int) -> tuple[np.ndarray, np.ndarray]:
    if not face_count or len(fine.faces) <= face_count:
        return fine.vertices, fine.faces
    try:
        return remesh(fine.vertices, fine.faces, edge_length_for(fine.vertices, fine.faces, face_count))
    except UserError:  # its topology would change
        return fine.vertices, fine.faces


def _write_remeshed(folder: Path, fine: FittedMesh, edge: float, min_quality: float) -> dict:
    vertices, faces = remesh(fine.vertices, fine.faces, edge, resample_boundary=True, min_quality=min_quality)
    normals = vertex_normals(vertices, faces)
    source = project(fine, vertices, normals)
    attributes = {name: source.interpolate(fine.faces, values) for name, values in fine.attributes.items()}
    write_ply(folder / "remeshed.ply", vertices, faces, normals, attributes)
    worst = float(triangle_quality(vertices, faces).min())
    return {"remeshed_faces": len(faces), "remeshed_min_quality": math.floor(1000 * worst) / 1000}


def _write_obj(
    folder: Path,
    vertices: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray,
    textures: Textures,
    name: str,
) -> None:
    """``mesh.obj`` and ``mesh.mtl`` with the PBR extension of MTL (map_Pr, map_Pm, norm), v upwards."""
    orm = textures.occlusion_roughness_metallic
    images = {
        "base_color": textures.base_color,
        "roughness": orm[..., 1],
        "metallic": orm[..., 2],
        "normal": textures.normal,
    }
    for kind, image in images.items():
        with replacing(folder / f"mesh_{kind}.png") as partial:
            Image.fromarray(image).save(partial)
    with replacing(folder / "mesh.mtl") as partial:
        partial.write_text(
            f"newmtl {name}\nKd 1 1 1\nillum 2\nmap_Kd mesh_base_color.png\nmap_Pr mesh_roughness.png\n"
            "map_Pm mesh_metallic.png\nnorm mesh_normal.png\n",
            encoding="utf-8",
        )
    # Welded: one position per point, or simulators would tear the object along the atlas's seams.
    welded, index = np.unique(vertices, axis=0, return_inverse=True)
    index = index.ravel()
    lines = ["mtllib mesh.mtl", f"o {name}", f"usemtl {name}"]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in welded.tolist()]
    lines += [f"vt {u:.6g} {v:.6g}" for u, v in uv.tolist()]
    lines += [f"vn {x:.5g} {y:.5g} {z:.5g}" for x, y, z in normals.tolist()]
    corners = np.stack([index[faces], faces, faces], axis=-1) + 1
    lines += ["f " + " ".join(f"{p}/{t}/{n}" for p, t, n in face) for face in corners.tolist()]
    with replacing(folder / "mesh.obj") as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit normals; any direction where a vertex has no area."""
    normals = np.array(trimesh.Trimesh(vertices, faces, process=False).vertex_normals)
    normals[np.abs((normals**2).sum(1) - 1) > 1e-3] = [0, 1, 0]  # of vertices without area
    return normals


def y_up_turn(folder: Path) -> np.ndarray:
    """The rotation (3, 3) from the scene of the fit in ``folder`` to glTF's axes, y up; ``v @ turn.T``."""
    scene = folder / "scene.xml"
    return _to_y_up(up_axis(load_scene(scene).sensors()) if scene.is_file() else 1)


def _to_y_up(axis: int) -> np.ndarray:
    """The rotation (3, 3) that takes the axis (see ``up_axis``) to +y and keeps the next one in place."""
    if axis == 1:
        return np.eye(3)
    up = np.concatenate([np.eye(3), -np.eye(3)])[axis]
    side = np.eye(3)[(axis % 3 + 1) % 3] if axis != 4 else np.eye(3)[0]
    return np.stack([side, up, np.cross(side, up)])
