"""Binary glTF 2.0, with what trimesh's writer lacks: tangents and linear vertex colours."""

from __future__ import annotations

import io
import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from .. import __version__
from ..files import replacing

_FLOAT, _UINT = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
TRIANGLES, LINES = 4, 1

#: glTF's sampler codes: linear with mip-maps, and clamped at the edges.
_SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}


@dataclass
class Part:
    """One primitive of the file with its material; becomes a node of its own.

    Attributes:
        name: of the node, the mesh and the material.
        indices: (F, 3) triangles or (E, 2) lines.
        attributes: glTF's names (``POSITION`` in metres, ``NORMAL``, ``TANGENT``, ``TEXCOORD_0`` with v
            downwards, ``COLOR_0`` linear) to float arrays of shape (V, n).
        material: glTF's material object; textures are names of ``images``, e.g.
            ``{"pbrMetallicRoughness": {"baseColorTexture": "base_color"}}``.
        images: (h, w, 3) 8-bit images by name.
    """

    name: str
    indices: np.ndarray
    attributes: dict[str, np.ndarray]
    material: dict[str, Any] = field(default_factory=dict)
    images: dict[str, np.ndarray] = field(default_factory=dict)


def write_glb(path: Path, parts: list[Part]) -> None:
    """Writes the parts into one scene."""
    with replacing(path) as partial:
        partial.write_bytes(glb_bytes(parts))


def glb_bytes(parts: list[Part], base: bytes | None = None) -> bytes:
    """The file of ``write_glb``; the parts follow those of the file ``base``, which ``glb_bytes`` made."""
    binary = _Binary()
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"gshell_mi {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": []}],
        "nodes": [],
        "meshes": [],
        "materials": [],
    }
    if base:
        document, data = _split(base)
        binary.data, binary.views, binary.accessors = data, document["bufferViews"], document["accessors"]
    for number, part in enumerate(parts, start=len(document["nodes"])):
        document["scenes"][0]["nodes"].append(number)
        attributes = {
            name: binary.accessor(values.astype("<f4"), _ARRAY_BUFFER)
            for name, values in part.attributes.items()
        }
        indices = binary.accessor(part.indices.reshape(-1, 1).astype("<u4"), _ELEMENT_BUFFER)
        mode = LINES if part.indices.shape[1] == 2 else TRIANGLES
        document["nodes"].append({"name": part.name, "mesh": number})
        document["meshes"].append(
            {
                "name": part.name,
                "primitives": [
                    {"attributes": attributes, "indices": indices, "mode": mode, "material": number}
                ],
            }
        )
        numbers = {}
        for name, image in part.images.items():
            images = document.setdefault("images", [])
            numbers[name] = len(images)
            images.append(
                {
                    "name": f"{part.name} {name}",
                    "mimeType": "image/png",
                    "bufferView": binary.view(_png(image)),
                }
            )
        document["materials"].append({"name": part.name, **_with_textures(part.material, numbers)})
    if "images" in document:
        document["samplers"] = [_SAMPLER]
        document["textures"] = [{"source": i, "sampler": 0} for i in range(len(document["images"]))]
    document |= {
        "accessors": binary.accessors,
        "bufferViews": binary.views,
        "buffers": [{"byteLength": len(binary.data)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = b""
    for kind, data, pad in ((b"JSON", text, b" "), (b"BIN\0", bytes(binary.data), b"\0")):
        data += pad * (-len(data) % 4)
        chunks += struct.pack("<I", len(data)) + kind + data
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def read_part(data: bytes) -> Part:
    """Triangles and attributes of the first node of a file that ``glb_bytes`` made, without its material."""
    document, binary = _split(data)
    primitive = document["meshes"][0]["primitives"][0]

    def array(number: int) -> np.ndarray:
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        kind = "<u4" if accessor["componentType"] == _UINT else "<f4"
        return np.frombuffer(bytes(binary), kind, view["byteLength"] // 4, view["byteOffset"]).reshape(
            accessor["count"], -1
        )

    attributes = {name: array(number) for name, number in primitive["attributes"].items()}
    return Part(document["meshes"][0]["name"], array(primitive["indices"]).reshape(-1, 3), attributes)


def _split(data: bytes) -> tuple[dict[str, Any], bytearray]:
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), bytearray(data[28 + length :])


class _Binary:
    """The file's one buffer, and what describes its contents."""

    def __init__(self):
        self.data = bytearray()
        self.views: list[dict] = []
        self.accessors: list[dict] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.views.append(view | ({"target": target} if target else {}))
        self.data += data
        return len(self.views) - 1

    def accessor(self, values: np.ndarray, target: int) -> int:
        accessor = {
            "bufferView": self.view(values.tobytes(), target),
            "count": len(values),
            "componentType": _UINT if values.dtype.kind == "u" else _FLOAT,
            "type": _TYPES[values.shape[1]],
        }
        if target == _ARRAY_BUFFER and values.shape[1] == 3:  # required of positions, harmless elsewhere
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _png(image: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "PNG")
    return stream.getvalue()


def _with_textures(material: dict[str, Any], numbers: dict[str, int]) -> dict[str, Any]:
    """``material`` with names of images replaced by references to textures."""
    found = {}
    for key, value in material.items():
        if isinstance(value, dict):
            value = _with_textures(value, numbers)
        elif key.endswith("Texture"):
            value = {"index": numbers[value]}
        found[key] = value
    return found
