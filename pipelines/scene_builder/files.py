"""Writing an object as a scene: sensors, XML, PLY and EXR files."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh

FOV, SIZE = 42.0, 256
#: Half the extent of the object in the lattice's box [-1, 1]^3.
HALF_EXTENT = 0.9


@dataclass(frozen=True)
class SceneObject:
    """A true object: its surface, material and light."""

    mesh: trimesh.Trimesh
    """Faces turned outwards (for a sheet: to its upper side). Scaled and centred when written."""
    color: np.ndarray
    """Base colour per vertex, ``(n, 3)``, linear Rec. 709 in [0, 1]."""
    light: np.ndarray
    """Environment map, see ``lights``."""
    roughness: float = 0.8
    metallic: float = 0.0
    views: int = 48
    lowest_view: float = -1.0
    """Sine of the elevation of the lowest view: -1 for views from all around, 0 from above only."""
    resolution: int = 64


def centred(mesh: trimesh.Trimesh) -> np.ndarray:
    """Vertices moved and scaled to fill the box up to ``HALF_EXTENT``."""
    lo, hi = mesh.bounds
    return (np.asarray(mesh.vertices) - (lo + hi) / 2) * (2 * HALF_EXTENT / (hi - lo).max())


def fibonacci_sphere(n: int, turn: float = 0.0, lowest: float = -1.0) -> np.ndarray:
    """``n`` directions spread evenly over the sphere above y = ``lowest``, ``(n, 3)``: a golden-angle spiral
    about y."""
    k = np.arange(n)
    y = 1 - (1 - lowest) / 2 * (2 * k + 1) / n
    phi = k * np.pi * (3 - 5**0.5) + turn
    r = np.sqrt(1 - y * y)
    return np.stack([r * np.cos(phi), y, r * np.sin(phi)], 1)


def sensor_xml(name: str, origin: np.ndarray) -> str:
    """A perspective sensor at ``origin`` that looks at the centre."""
    return f"""    <sensor type="perspective" id="{name}">
        <float name="fov" value="{FOV:g}"/>
        <float name="near_clip" value="0.1"/> <float name="far_clip" value="20"/>
        <transform name="to_world">
            <lookat origin="{", ".join(f"{x:.6f}" for x in origin)}" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="{SIZE}"/> <integer name="height" value="{SIZE}"/>
            <string name="pixel_format" value="rgba"/> <rfilter type="gaussian"/>
        </film>
        <sampler type="independent"> <integer name="sample_count" value="$spp"/> </sampler>
    </sensor>
"""


def test_xml(distance: float, lowest: float = -1.0) -> str:
    """The document of twelve sensors that no fit sees, spread above y = ``lowest`` of the unit sphere."""
    directions = fibonacci_sphere(12, 1.0, lowest)
    return scene_xml(*(sensor_xml(f"test_{i:03}", distance * d) for i, d in enumerate(directions)), spp=256)


def whole_view_distance(vertices: np.ndarray, fov: float) -> float:
    """How far from the origin a camera sees all vertices (n, 3), with a margin; ``fov`` in degrees."""
    return 1.04 * np.linalg.norm(vertices, axis=1).max() / np.sin(np.radians(fov / 2))


def scene_xml(*parts: str, spp: int | None = None) -> str:
    """A scene document; ``spp`` sets the default of the sensors' ``$spp``."""
    default = "" if spp is None else f'    <default name="spp" value="{spp}"/>\n'
    return '<scene version="3.0.0">\n' + default + "".join(parts) + "</scene>\n"


def write_scene(name: str, item: SceneObject, folder: Path) -> None:
    """Writes ``NAME.xml`` and ``NAME/`` (sensors, reference, test views, truth, light) into ``folder``.

    Targets that were rendered there from an earlier truth are removed, so that the fit renders new ones.
    """
    inside = folder / name
    inside.mkdir(parents=True, exist_ok=True)
    for stale in inside.glob("view_*.exr"):
        stale.unlink()
    vertices = centred(item.mesh)
    distance = whole_view_distance(vertices, FOV)
    around = partial(fibonacci_sphere, lowest=item.lowest_view)

    def sensors(prefix: str, directions: np.ndarray) -> list[str]:
        return [sensor_xml(f"{prefix}_{i:03}", distance * d) for i, d in enumerate(directions)]

    (inside / "sensors.xml").write_text(scene_xml(*sensors("view", around(item.views))))
    (inside / "test.xml").write_text(test_xml(distance, item.lowest_view))
    (folder / f"{name}.xml").write_text(
        scene_xml(
            f"""    <!-- The unknown: fills the cube [-1, 1]^3. -->
    <shape type="gshell" id="subject">
        <integer name="resolution" value="{item.resolution}"/>
    </shape>
    <!-- The light that the fit starts from. -->
    <emitter type="constant" id="light"> <rgb name="radiance" value="0.5"/> </emitter>
    <include filename="{name}/sensors.xml"/>
""",
            spp=16,
        )
    )
    (inside / "reference.xml").write_text(
        reference_xml(item.roughness, item.metallic, '    <include filename="sensors.xml"/>\n')
    )
    write_ply(inside / "truth.ply", vertices, item.mesh.faces, item.color)
    light = mi.Bitmap(np.ascontiguousarray(item.light, dtype=np.float32))
    light.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float16, False).write(str(inside / "light.exr"))


def reference_xml(roughness: float, metallic: float, *parts: str) -> str:
    """The document of the truth: ``truth.ply`` with the colours of its vertices under ``light.exr``."""
    return scene_xml(
        f"""    <!-- The truth that the targets are rendered from; the fit never sees it. -->
    <integrator type="path">
        <integer name="max_depth" value="6"/> <boolean name="hide_emitters" value="true"/>
    </integrator>
    <shape type="ply" id="subject">
        <string name="filename" value="truth.ply"/>
        <bsdf type="twosided"> <bsdf type="principled">
            <texture type="mesh_attribute" name="base_color">
                <string name="name" value="vertex_color"/>
            </texture>
            <float name="roughness" value="{roughness:g}"/>
            <float name="metallic" value="{metallic:g}"/>
        </bsdf> </bsdf>
    </shape>
    <emitter type="envmap" id="light"> <string name="filename" value="light.exr"/> </emitter>
""",
        *parts,
        spp=256,
    )


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray, color: np.ndarray) -> None:
    """A binary PLY whose colours Mitsuba loads as the attribute ``vertex_color``."""
    mesh = mi.Mesh(path.stem, len(vertices), len(faces))
    mesh.add_attribute("vertex_color", 3, np.asarray(color, np.float32).ravel())
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.asarray(vertices, np.float32).ravel()
    params["faces"] = np.asarray(faces, np.uint32).ravel()
    params.update()
    mesh.write_ply(str(path))
